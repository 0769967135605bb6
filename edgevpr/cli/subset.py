"""`edgevpr map subset`: cut out the part of a map, or of a folder of maps, that one flight needs."""

from argparse import Namespace
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, describe_lost_calibration, format_fields, parse_positive, print_result
from edgevpr.core.text import progress

_MARGIN_M = 500.0


def add(add_to_map: Callable[..., Any]) -> None:
    """Add the command and its flags. `add_to_map` adds a `map` command whose first argument is a map."""
    parser = add_to_map("subset", run_map_subset, "cut out the part that a mission needs", "map, or folder of maps")
    parser.add_argument(
        "--mission",
        metavar="FILE",
        required=True,
        help="Mission Planner waypoints, QGroundControl .plan, or LAT,LON,RADIUS_M",
    )
    parser.add_argument("--out", metavar="MAP", required=True, help="map to write")
    parser.add_argument(
        "--margin-m",
        type=parse_positive,
        metavar="M",
        default=_MARGIN_M,
        help="margin around the mission in metres (default: %(default)g)",
    )
    parser.add_argument("--mb", type=parse_positive, metavar="MB", help="maximum file size in MB (default: no limit)")
    add_json(parser)


def run_map_subset(args: Namespace) -> int:
    """Run `map subset`: cut out the map of a mission, and print what is left out."""
    from edgevpr.mapmaking.missions import read_area
    from edgevpr.mapmaking.subset import make_subset
    from edgevpr.places.mapfiles import parse_map_path

    area, out = read_area(args.mission), parse_map_path(args.out)
    result = make_subset(Path(args.map), area, args.margin_m, out, args.mb and 1e6 * args.mb, progress)
    fields = {"map": str(out), **asdict(result)}
    text = [*format_fields(fields), *describe_lost_calibration(str(out), result.lost_calibration)]
    print_result(fields, args.json, text)
    return 0
