"""`edgevpr positions`: geotag pictures from a log, a track, subtitles or a table."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_command, add_json, print_result


def add(commands: Any) -> None:
    """Add the command and its flags."""
    text = "geotag images from an autopilot log, a GPS track, subtitles or a table"
    parser = add_command(commands, "positions", run_positions, text)
    parser.add_argument(
        "record",
        metavar="RECORD",
        help="ArduPilot .bin, .tlog, PX4 .ulg, DJI .SRT, .gpx, the flight log (.jsonl) of a recorded flight, or a "
        "table from exiftool, Pix4D, Metashape or OpenDroneMap",
    )
    parser.add_argument("--images", required=True, metavar="SOURCE", help="folder of images, or video file")
    text = "seconds to add to the camera's clock or to the times of subtitles (default: inferred time-zone offset)"
    parser.add_argument("--offset-s", type=float, metavar="S", help=text)
    text = "file to write (default: positions.csv in the folder, or VIDEO.csv)"
    parser.add_argument("--out", metavar="CSV", help=text)
    add_json(parser)


def run_positions(args: Namespace) -> None:
    """Run `positions`: write the table of positions that all other commands find next to the pictures."""
    from edgevpr.core.errors import UsageError
    from edgevpr.core.text import show_elapsed
    from edgevpr.frames.positions import write_positions, write_track
    from edgevpr.tracks.placing import find_rounding_m, place_pictures, place_video
    from edgevpr.tracks.record import read_record

    source, is_folder = Path(args.images), Path(args.images).is_dir()
    if not source.exists():
        raise UsageError(f"{source} does not exist: pass the folder of the images or the video file.")
    out = Path(args.out) if args.out else source / "positions.csv" if is_folder else source.with_suffix(".csv")
    if out.exists():
        raise UsageError(f"{out} already exists: move it away, or pass another file with --out.")
    with show_elapsed(f"reading {args.record}"):
        record = read_record(Path(args.record))
    placed = (place_pictures if is_folder else place_video)(record, source, args.offset_s)
    try:
        if placed.track:
            write_track(out, placed.track)
        else:
            write_positions(out, placed.tags)
    except OSError as error:
        raise UsageError(f"{out} cannot be written ({error.strerror}): pass another file with --out.") from error
    fields = {
        "record": record.kind,
        "how": placed.how,
        "offset_s": placed.offset_s,
        "placed": len(placed.track.t_s) if placed.track else sum(bool(tag.position) for tag in placed.tags.values()),
        "of": None if placed.track else placed.pictures,
        "rounded_m": find_rounding_m(placed),
        "out": str(out),
    }
    print_result(fields, args.json)
