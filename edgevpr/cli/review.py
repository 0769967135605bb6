"""Commands for after a flight: `edgevpr report` and `edgevpr export`, which both read the flight's log."""

import logging
import sys
from argparse import ArgumentTypeError, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import command
from edgevpr.core.errors import MapError, UsageError

if TYPE_CHECKING:
    from edgevpr.review.logged import LoggedFlight
    from edgevpr.review.overhead import MapGround

_log = logging.getLogger(__name__)


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    report = command(commands, "report", run_report, "make a page of a flight from its log, for any browser, offline")
    _add_log(report)
    report.add_argument("--out", required=True, metavar="FILE", help="the page to write (.html)")
    report.add_argument("--map", metavar="MAP", help="draw over its ground (default: that of the log's first line)")
    for flag, text in (
        ("--images", "frames of this flight (those of its recording need none)"),
        ("--map-images", "the pictures that the map was made of"),
    ):
        report.add_argument(flag, action="append", default=[], metavar="DIR", help=f"folder with {text}; repeatable")
    export = command(commands, "export", run_export, "write matches, fixes and places of a flight, for a map viewer")
    _add_log(export)
    form = export.add_mutually_exclusive_group(required=True)
    for name in ("geojson", "csv", "kml"):
        form.add_argument(f"--{name}", metavar="FILE", help="file to write, - for standard output")


def _add_log(parser: Any) -> None:
    parser.add_argument("log", metavar="LOG")
    parser.add_argument("--flight", type=_number, metavar="N", help="the flight of the log, from 1 (default: the last)")


def _number(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"`{text}` is no number of a flight: give 1 or more")
    return int(text)


def run_report(args: Namespace) -> int:
    """Run `report`: write the HTML page of a flight."""
    from edgevpr.core.files import require_folder, write_whole
    from edgevpr.review.page import Album, page_of
    from edgevpr.runtime.flight.recording import frames_of, recording_of

    out = _out(args.out, args.log)
    require_folder(out)
    flight = _read(args)
    folder = recording_of(flight.recording, args.log)
    frames, references = Album(args.images, frames_of(folder) if folder else {}), Album(args.map_images)
    page = page_of(flight, _ground(args.map, flight), frames, references)
    write_whole(out, lambda unfinished: unfinished.write_text(page, "utf-8", "backslashreplace"))
    print(f"{out}: {len(flight.queries)} queries, flight {flight.number} of {flight.flights} in {args.log}")
    return 0


def run_export(args: Namespace) -> int:
    """Run `export`: write the points of a flight (matches, fixes, places) as GeoJSON, CSV or KML."""
    from edgevpr.core.files import require_folder, write_whole
    from edgevpr.review.export import WRITERS, features_of

    form, target = next((name, given) for name in WRITERS if (given := getattr(args, name)) is not None)
    features = features_of(_read(args))
    write = WRITERS[form]
    if target == "-":
        write(features, sys.stdout)
        return 0
    out = _out(target, args.log)
    require_folder(out)

    def written(unfinished: Path) -> None:
        with open(unfinished, "w", encoding="utf-8", errors="backslashreplace", newline="") as handle:
            write(features, handle)

    write_whole(out, written)
    print(f"{out}: {len(features)} points")
    return 0


def _read(args: Namespace) -> "LoggedFlight":
    from edgevpr.review.logged import read_flight

    flight = read_flight(args.log, args.flight)
    if flight.missing:
        _log.warning("%s", flight.missing)
    return flight


def _out(target: str, log: str) -> Path:
    out = Path(target)
    if out.exists() and Path(log).exists() and out.samefile(log):
        raise UsageError(f"{out} is the flight log itself: give another name.")
    return out


def _ground(given: str | None, flight: "LoggedFlight") -> "MapGround":
    """Read the places of the map `given` or, if that is None, of the map that the log names. That one may be missing on
    this machine: the result then says so."""
    from edgevpr.review.overhead import MapGround, read_ground

    if given:
        return read_ground(given)
    if flight.map_path is None:
        return MapGround(trouble="The log does not name a map: give it with --map.")
    try:
        return read_ground(flight.map_path)
    except (MapError, UsageError) as error:
        return MapGround(trouble=f"The map of the flight is not drawn: {error} Its place can be given with --map.")
