"""Makes folders of pictures from videos with positions, for data sets: each video is decoded once, and its pictures are
kept.

The positions of a video lie beside it, in a table of its name (later.csv of later.mp4). `frames.positions` explains its
columns. A side of a data set is its queries or its references.
"""

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.types import Frame
from edgevpr.frames.images import is_image, write_png
from edgevpr.frames.positions import MOST_GAP_S, GeoTag, find_track, write_positions
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.asking import Progress
from edgevpr.lab.evaluate.evaluate import all_frames
from edgevpr.lab.evaluate.provenance import key_of, stamp

_FORM = "time,lat,lon[,alt,yaw_deg,roll_deg,pitch_deg,height_m], `time` in seconds from its first frame"


def pictures_of(given: Path, kept: Path, rate_hz: float | None, progress: Progress[Any]) -> Path:
    """Return `given`, a side of a data set, if it is a folder of pictures, and of a video a folder of the pictures that
    have a position. From a video `rate_hz` pictures a second are taken (None: every frame) and kept below the folder
    `kept`; `progress` shows it. Raises UsageError for a video without positions, ImageError for a damaged one,
    SourceError for a file that is no video, and EdgevprError for a full disk."""
    if not given.is_file() or is_image(given.name):
        return given
    if (table := find_track(given)) is None:
        raise UsageError(f"{given} has no positions beside it: write {given.stem}.csv there ({_FORM}).")
    made = kept / key_of(given, stamp(given), stamp(table), rate_hz)
    if made.is_dir():
        return made
    source = open_source(str(given), step_s=1 / rate_hz if rate_hz else None, positions=table, live=False)
    try:
        kept.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", dir=kept) as unfinished:
            whole = Path(unfinished) / "made"
            whole.mkdir()
            _write(progress(all_frames(source), source.total, f"{given.name}: pictures"), whole)
            if not list(whole.glob("*.png")):
                raise UsageError(
                    f"No frame of {given} lies between two lines of {table} that are at most {MOST_GAP_S:g} s apart: "
                    "write `time` in seconds from its first frame."
                )
            whole.rename(made)
    except OSError as error:
        raise EdgevprError(
            f"{kept} takes no more pictures of {given} ({error.strerror}): make room, take fewer with --rate-hz, or "
            "name another folder with --out."
        ) from error
    finally:
        source.close()
    return made


def _write(frames: Iterable[Frame], folder: Path) -> None:
    """Write each frame that has a position to `folder`, as a PNG, and a positions.csv."""
    tags: dict[str, GeoTag] = {}
    for frame in frames:
        if frame.position:
            # Like frame_000006_t0.240_s.png: a space would separate names in a ground truth.
            name = frame.name.replace("=", "").replace(" ", "_") + ".png"
            tags[name] = GeoTag(
                position=frame.position,
                heading_deg=frame.heading_deg,
                roll_deg=frame.roll_deg,
                pitch_deg=frame.pitch_deg,
                height_m=frame.height_m,
            )
            write_png(folder / name, frame.image)
    write_positions(folder / "positions.csv", tags)
