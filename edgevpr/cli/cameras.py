"""`edgevpr calibrate-camera`: the calibration of a lens with distortion, from pictures of a chequerboard."""

import re
import time
from argparse import ArgumentTypeError, Namespace
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import add_json, command, exit_code, leave_out, positive, show
from edgevpr.core.errors import ImageError
from edgevpr.core.text import at_work, progress, waiting

if TYPE_CHECKING:
    from edgevpr.core.types import Frame
    from edgevpr.frames.chequerboard import CalibratedCamera

_FILM_STEP_S = 0.3  # between two pictures of a video that are searched
_READ_S = 0.25


def add(commands: Any) -> None:
    """Add the command and its flags."""
    text = "calibrate a camera with images of a chessboard"
    parser = command(commands, "calibrate-camera", calibrate_camera, text)
    parser.add_argument("source", metavar="SOURCE", help="folder of images of the board, a video of it, or a camera")
    parser.add_argument(
        "--board",
        type=_board,
        required=True,
        metavar="9x6",
        help="number of inner corners, where four squares meet: a board of 10x7 squares has 9x6",
    )
    parser.add_argument("--out", required=True, metavar="YAML", help="file to write, for `source: {lens: ...}`")
    parser.add_argument(
        "--fisheye", action="store_true", help="use the fisheye model, for lenses wider than about 100 degrees"
    )
    parser.add_argument(
        "--seconds",
        type=positive,
        default=90.0,
        metavar="S",
        help="maximum time to watch a camera, in seconds (default: 90)",
    )
    add_json(parser)


def calibrate_camera(args: Namespace) -> int:
    """Run `calibrate-camera`: write the calibration of a camera, and say how good it is."""
    from edgevpr.core.files import require_folder
    from edgevpr.frames.chequerboard import BoardViews, calibrate, write_lens

    require_folder(Path(args.out))
    views, unusable = BoardViews(args.board), list[ImageError]()
    for frame in _frames(args, unusable):
        try:
            views.add(frame)
        except ImageError as error:
            leave_out(error, unusable)
        if views.are_enough():
            break
        where = views.empty_cells()
        waiting(f"{len(views.found)} views that differ" + (f", none in {where[0]}" if where else ""))
    waiting("")
    with at_work("calibrating"):
        camera = calibrate(views, args.out, args.fisheye)
    write_lens(camera)
    show(camera, args.json, _text(camera))
    return exit_code(unusable)


def _board(text: str) -> tuple[int, int]:
    """Read "9x6", as the `type` of a flag. Raises ArgumentTypeError for other texts, and fewer corners than can be
    found."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    board = (int(found[1]), int(found[2])) if found else (0, 0)
    if min(board) < 3:
        raise ArgumentTypeError(f"`{text}` is no number of inner corners: write for example 9x6, at least 3x3")
    return board


def _frames(args: Namespace, unusable: list[ImageError]) -> "Iterator[Frame]":
    """Yield the frames of a recording to its end, or of a live source for as long as is asked for."""
    from edgevpr.frames.source import open_source, read_to_end

    with closing(open_source(args.source, step_s=_FILM_STEP_S, live=True)) as source:
        source.twins.stop()
        if not source.is_live:
            frames = read_to_end(source, lambda error: leave_out(error, unusable))
            yield from filter(None, progress(frames, source.total, "looking for the board"))
        end_s = time.monotonic() + args.seconds
        while not source.ended and time.monotonic() < end_s:
            if frame := source.read(_READ_S):
                yield frame


def _text(camera: "CalibratedCamera") -> Iterator[str]:
    lens, cells, (width, height) = camera.lens, camera.corners, camera.lens.size_px
    rows = (" ".join(map(str, cells[start : start + 3])) for start in (0, 3, 6))
    yield f"{lens.path}: of pictures of {width}x{height} pixels, or of another size and the same shape"
    yield f"  views       {camera.views} that differ, of {camera.pictures} pictures"
    yield f"  error       {camera.error_px:.2f} pixels, root mean square"
    yield f"  corners     {' / '.join(rows)}, in the nine parts of the picture"
    yield f"  lens        {camera.field_deg:.0f} degrees across, moves pixels by up to {camera.distortion_px:.0f}"
    yield from (f"  better      {sentence}" for sentence in camera.advice)
    yield f"Use it for maps and flights: source: {{lens: {lens.path}}}"
