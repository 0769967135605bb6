"""`edgevpr profile`: estimate, before take-off, how much RAM and battery each technique needs on a board."""

from argparse import Namespace
from collections.abc import Mapping
from typing import Any

from edgevpr.cli.shared import add_command, add_json, add_keys, make_config, parse_count, parse_positive, print_result
from edgevpr.core.text import progress


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = add_command(commands, "profile", run_profile, "estimate memory, rate and battery use before take-off")
    subject = parser.add_mutually_exclusive_group(required=True)
    subject.add_argument("--list", action="store_true", help="list the boards")
    subject.add_argument("--map", metavar="MAP", help="map of the flight: estimate the costs of its technique")
    subject.add_argument("--places", type=parse_count, metavar="N", help="number of places: estimate every technique")
    parser.add_argument("--board", default="this", metavar="NAME", help="board; see --list (default: this computer)")
    text = "flight length in minutes (default: 20)"
    parser.add_argument("--flight-min", type=parse_positive, default=20.0, metavar="MIN", help=text)
    add_keys(parser, "source.camera", "source.rate_hz", "memory.budget_mb", "battery.pack")
    add_json(parser)


def run_profile(args: Namespace) -> None:
    """Run `profile`: estimate the cost of techniques in a flight, in all their forms, or list the boards that have a
    profile. With --map, only the technique of the map is tried."""
    from edgevpr import techniques
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.boards import list_boards, load_board, resolve_board
    from edgevpr.power.equations import parse_pack
    from edgevpr.runtime.preflight.choose import FlightPlan
    from edgevpr.runtime.preflight.estimate import estimate_flight
    from edgevpr.runtime.preflight.pick import make_camera_setting
    from edgevpr.runtime.preflight.presentation import format_table
    from edgevpr.runtime.preflight.trial import list_trials, run_trials

    if args.list:
        for name in ("this", *list_boards()):
            print(f"{name:<20} {load_board(name).title}")
        return
    config = make_config(args)
    board = resolve_board(load_board(args.board), config.source, config.memory)
    places, camera = args.places, config.source.camera
    settings: dict[str, Mapping[str, Any]]
    if args.map:
        with PlaceMap.open(args.map) as place_map:
            places, spec = len(place_map), place_map.spec
        camera = str(spec.parameters["camera"]) if "camera" in spec.parameters else camera
        settings = {spec.name: spec.parameters}
    else:
        settings = {name: make_camera_setting(name, camera) for name in techniques.list_techniques()}
    plan = FlightPlan(
        places=places,
        rate_hz=board.rate_hz,
        flight_min=args.flight_min,
        pack=parse_pack(config.battery.pack),
        regulator_efficiency=config.battery.regulator_efficiency,
        budget_mb=board.budget_mb,
        camera=camera,
    )
    trials = list_trials(settings)
    results = progress(run_trials(trials, board.threads), len(trials), "running techniques")
    estimate = estimate_flight(board, results, plan)
    print_result(estimate, args.json, format_table(estimate))
