"""`edgevpr profile`: what each technique costs a board in RAM and battery, estimated before take-off."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import add_json, add_keys, command, count, load_command_config, positive, report, show
from edgevpr.core.errors import UsageError
from edgevpr.core.text import progress

if TYPE_CHECKING:
    from edgevpr.power.boards import Board
    from edgevpr.runtime.preflight.estimate import FlightPlan
    from edgevpr.runtime.preflight.trial import Trial


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "profile", profile, "estimate memory, rate and battery use before take-off")
    asked = parser.add_mutually_exclusive_group(required=True)
    asked.add_argument("--list", action="store_true", help="list the boards")
    asked.add_argument("--detect", action="store_true", help="identify this board, and say why; see --out")
    asked.add_argument("--map", metavar="MAP", help="map of the flight: estimate its technique")
    asked.add_argument("--places", type=count, metavar="N", help="number of places: estimate every technique")
    parser.add_argument(
        "--board",
        default="this",
        metavar="NAME",
        help="board, or a list A,B,C to compare; see --list (default: this computer)",
    )
    parser.add_argument(
        "--flight-min", type=positive, default=20.0, metavar="MIN", help="length of the flight in minutes (default: 20)"
    )
    add_keys(parser, "source.camera", "source.rate_hz", "memory.budget_mb", "battery.pack")
    parser.add_argument(
        "--hover-w", type=positive, metavar="W", help="power to hover in watts, to estimate the flight time lost"
    )
    parser.add_argument(
        "--out",
        metavar="FILE.yaml",
        help=("with --detect: measure speed and, if there is a meter, power; write a profile"),
    )
    add_json(parser)


def profile(args: Namespace) -> int:
    """Run `profile`: estimate what techniques cost in a flight; or list the boards that have a profile, or say which
    board this is."""
    from edgevpr.power.boards import board_names, load_board
    from edgevpr.runtime.preflight.choose import list_preferred
    from edgevpr.runtime.preflight.estimate import estimate
    from edgevpr.runtime.preflight.presentation import format_boards, format_table
    from edgevpr.runtime.preflight.scale import with_comparable_score
    from edgevpr.runtime.preflight.trial import Trial, try_each

    if args.out and not args.detect:
        raise UsageError("--out is for --detect: name it too.")
    if args.list:
        for name in board_names():
            print(f"{name:<20} {load_board(name).title}")
        return 0
    if args.detect:
        return _detect(args)
    boards = [load_board(name.strip()) for name in args.board.split(",")]
    for board in boards:
        list_preferred(board)  # raises if the profile names a technique that is not there
    results = []
    tried: dict[int, list[Trial]] = {}  # by the number of threads for networks
    for board in boards:
        plan, wanted = _plan(args, board)
        if board.threads not in tried:
            trials = progress(try_each(wanted, board.threads), len(wanted), "trying techniques")
            tried[board.threads] = list(trials)
        here = with_comparable_score(load_board("this"), board)
        results.append(estimate(board, here, tried[board.threads], plan))
    if len(results) == 1:
        show(results[0], args.json, format_table(results[0]))
    else:
        show([asdict(each) for each in results], args.json, format_boards(results))
    return 0


def _plan(args: Namespace, board: "Board") -> "tuple[FlightPlan, tuple[Trial, ...]]":
    """Make two things from the flags: the plan of the flight, and the techniques to try in all their forms: that of
    --map, else every one."""
    from edgevpr import techniques
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.equations import parse_pack
    from edgevpr.runtime.preflight.estimate import FlightPlan
    from edgevpr.runtime.preflight.pick import camera_setting
    from edgevpr.runtime.preflight.trial import offers
    from edgevpr.runtime.recognise.opening import budget_mb

    config = load_command_config(args)
    places, camera = args.places, config.source.camera
    if args.map:
        with PlaceMap.open(args.map) as place_map:
            places, spec = len(place_map), place_map.spec
        camera = str(spec.parameters["camera"]) if "camera" in spec.parameters else camera
        wanted = offers((spec.name,), settings={spec.name: spec.parameters})
    else:
        wanted = offers(techniques.names(), settings={n: camera_setting(n, camera) for n in techniques.names()})
    plan = FlightPlan(
        places=places,
        rate_hz=config.source.rate_hz or board.rate_hz,
        flight_min=args.flight_min,
        pack=parse_pack(config.battery.pack),
        regulator_efficiency=config.battery.regulator_efficiency,
        budget_mb=budget_mb(config, board),
        hover_w=args.hover_w,
        camera=camera,
    )
    return plan, wanted


def _detect(args: Namespace) -> int:
    from edgevpr.power.boards import detect
    from edgevpr.power.calibrate import write_profile

    power = write_profile(Path(args.out)) if args.out else None
    found = detect()
    show(found, args.json)
    if power:
        report(power, f"{args.out} is written: use it with --board {args.out}.")
    elif found["board"] is None:
        report("This board has no profile: --out FILE.yaml writes one.")
    return 0
