"""Commands for use after a flight: `edgevpr report` makes a page of its log, `edgevpr replay` replays a recorded flight
on the ground."""

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from edgevpr.cli.shared import add_command, add_json, add_map_images, print_result, write_output
from edgevpr.cli.wording import format_replay
from edgevpr.core.errors import EdgevprError


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    report = add_command(commands, "report", run_report, "make an HTML page of a flight from its log")
    report.add_argument("log", metavar="LOG")
    report.add_argument("--out", required=True, metavar="FILE", help="page to write (.html)")
    report.add_argument("--map", metavar="MAP", help="map to draw (default: the map of the flight)")
    text = "folder of this flight's frames (repeatable), or its video; not needed if the flight was recorded"
    report.add_argument("--images", action="append", default=[], metavar="DIR", help=text)
    add_map_images(report)
    replay = add_command(commands, "replay", run_replay, "replay a recorded flight and compare log and packets")
    replay.add_argument("log", metavar="LOG", help="flight log; its last flight is replayed")
    replay.add_argument("--map", metavar="MAP", help="map of the flight (default: the path in the flight log)")
    add_json(replay)


def run_report(args: Namespace) -> None:
    """Run `report`: write the HTML page of a flight."""
    from edgevpr.core.types import Place
    from edgevpr.review.album import make_album, make_map_album
    from edgevpr.review.logged import get_text, read_flight
    from edgevpr.review.page import make_flight_page
    from edgevpr.review.webpage import read_located_places
    from edgevpr.runtime.flight.recording import find_recording, list_frames

    flight = read_flight(args.log)
    folder = find_recording(get_text(flight.start, "recording"), args.log)
    ground: list[Place] = []
    no_ground = "The log does not name a map: pass one with --map."
    if path := args.map or get_text(flight.start, "map"):
        try:
            ground, no_ground = read_located_places(path), ""
        except EdgevprError as error:
            if args.map:
                raise
            no_ground = f"The map of the flight is not drawn: {error} If it has moved, pass its path with --map."
    upright = not any(place.pose for place in ground)  # only maps of a camera that looks down have poses
    frames = make_album(args.images, list_frames(folder) if folder else {}, upright=upright)
    references = make_map_album(args.map_images, ground, upright=upright)
    write_output(args.out, args.log, make_flight_page(flight, ground, frames, references, no_ground))
    print(f"{args.out}: {len(flight.queries)} queries of {args.log}")


def run_replay(args: Namespace) -> int:
    """Run `replay`: replay a recorded flight, and print the comparison. The exit code is 1 if anything differs."""
    from edgevpr.review.compare import compare_lines
    from edgevpr.review.replay import replay

    result = replay(args.log, args.map)
    end = {"guessed": result.guessed, "why_ended": result.why_ended}
    lines, packets = compare_lines(result.flown, result.lines), result.packets
    has_all = not lines.after or result.why_ended is not None
    is_same = has_all and not (lines.others or packets.others)
    value = {"lines": asdict(lines), "packets": asdict(packets), **end, "is_same": is_same}
    print_result(value, args.json, format_replay(result, lines, packets))
    return 0 if is_same else 1
