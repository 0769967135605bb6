"""`edgevpr profile`: what each technique costs a board in RAM and battery, estimated before take-off."""

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import add_json, add_keys, command, report, show, value_of
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import progress, require_picture

if TYPE_CHECKING:
    from edgevpr.power.boards import Board
    from edgevpr.runtime.preflight.estimate import FlightPlan
    from edgevpr.runtime.preflight.trial import Trial


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "profile", profile, "say before take-off what each technique costs in RAM and battery")
    parser.add_argument("--board", default="this", metavar="NAME", help="a board, or `this` (default); see --list")
    parser.add_argument("--list", action="store_true", help="list the boards")
    _add_plan(parser)
    parser.add_argument("--plot", metavar="FILE", help="draw recall against charge (.png, .pdf, .svg)")
    own = parser.add_mutually_exclusive_group()
    own.add_argument("--detect", action="store_true", help="say which board this is, and why; --out writes a profile")
    own.add_argument(
        "--measure",
        action="store_true",
        help="measure every technique here, and the power if there is a meter; keep it",
    )
    parser.add_argument("--out", metavar="FILE", help="where --detect (.yaml) or --measure (.json) write to")
    add_json(parser)


def _add_plan(parser: ArgumentParser) -> None:
    places = parser.add_mutually_exclusive_group()
    places.add_argument("--map", metavar="MAP", help="the map to fly with")
    places.add_argument("--places", type=int, metavar="N", help="the number of places to fly with")
    parser.add_argument("--flight-min", type=float, default=20.0, metavar="MIN", help="length of the flight (20)")
    add_keys(parser, "source.camera", "source.rate_hz", "memory.budget_mb", "battery.pack")
    parser.add_argument(
        "--min-recall", type=float, metavar="R", help="the cheapest with this recall@1 (default: the best)"
    )
    parser.add_argument("--hover-w", type=float, metavar="W", help="what the aircraft draws to hover: minutes lost")


def profile(args: Namespace) -> int:
    """Run `profile`: estimate what each technique costs in a flight; or list the boards that have a profile, say which
    board this is, or measure it."""
    from edgevpr.power.boards import board_names, load_board
    from edgevpr.runtime.preflight.choose import preferred
    from edgevpr.runtime.preflight.estimate import estimate
    from edgevpr.runtime.preflight.presentation import format_table, plot
    from edgevpr.runtime.preflight.stored import default_path, load, scaled_from
    from edgevpr.runtime.preflight.trial import try_each

    if args.list:
        for name in board_names():
            print(f"{name:<20} {load_board(name).title}")
        return 0
    if args.out and not (args.detect or args.measure):
        raise UsageError("--out is for --detect and --measure: name one of them too.")
    asked = args.map is not None or args.places is not None
    if args.detect:
        if asked or args.plot:
            raise UsageError("--detect says what this machine is: ask what a flight costs without it.")
        return _detect(args)
    if not asked and (args.plot or not args.measure):
        raise UsageError("Say how many places will be flown with: --map MAP, or --places N.")
    if args.plot:
        require_picture(Path(args.plot))
    board = load_board(args.board)
    preferred(board)  # raises if the profile names a technique that is not there
    plan, map_technique, wanted = _plan(args, board) if asked else (None, None, ())
    if args.measure:
        _measure(args, quiet=asked)
    if plan is None:
        return 0
    stored, refused = load(Path(args.out) if args.measure and args.out else default_path())
    if refused:
        report(refused)
    trials = try_each(wanted, board.threads, stored.of if stored else lambda offer: None)
    trials = progress(trials, len(wanted), "trying techniques")
    here = scaled_from(load_board("this"), board, stored)
    result = estimate(board, here, trials, plan, map_technique, stored.date if stored else None)
    if args.plot:
        plot(result, Path(args.plot))
    show(result, args.json, format_table(result))
    return 0


def _plan(args: Namespace, board: "Board") -> "tuple[FlightPlan, str | None, tuple[Trial, ...]]":
    """Make three things from the flags: the plan of the flight; the technique of --map (None: there is no --map); and
    the techniques to try, each in all its forms."""
    from edgevpr import techniques
    from edgevpr.core.config import load_config
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.equations import parse_pack
    from edgevpr.runtime.preflight.estimate import FlightPlan
    from edgevpr.runtime.preflight.pick import camera_setting
    from edgevpr.runtime.preflight.trial import offers

    places, map_technique, camera = args.places, None, value_of(args, "source.camera")
    settings: dict[str, dict[str, Any]] = {name: dict(camera_setting(name, camera)) for name in techniques.names()}
    if args.map:
        with PlaceMap.open(args.map) as place_map:
            places, map_technique = len(place_map), place_map.spec.name
            settings[map_technique] = place_map.spec.parameters
            camera = place_map.spec.parameters.get("camera", camera)
    rate_hz, budget_mb = value_of(args, "source.rate_hz"), value_of(args, "memory.budget_mb")
    battery = load_config(None, {"battery.pack": value_of(args, "battery.pack")}).battery
    plan = FlightPlan(
        places=places,
        rate_hz=board.rate_hz if rate_hz is None else rate_hz,
        flight_min=args.flight_min,
        pack=parse_pack(battery.pack),
        regulator_efficiency=battery.regulator_efficiency,
        budget_mb=board.budget_mb if budget_mb is None else budget_mb,
        hover_w=args.hover_w,
        camera=camera,
        min_recall=args.min_recall,
    )
    return plan, map_technique, offers(techniques.names(), settings=settings)


def _detect(args: Namespace) -> int:
    from edgevpr.power.boards import detect, own_profile
    from edgevpr.power.speed import micro_benchmark
    from edgevpr.runtime.preflight.stored import write_profile

    found = detect()
    show(found, args.json)
    if args.out:
        write_profile(Path(args.out), own_profile(micro_benchmark()))
        report(f"{args.out} is written: use it with --board {args.out}.")
    elif found["board"] is None:
        report("This board has no profile: --out FILE.yaml writes one.")
    return 0


def _measure(args: Namespace, quiet: bool) -> None:
    """Measure this machine, and store and print the results. With `quiet` and --json nothing is printed: an estimate
    follows, which prints JSON of its own."""
    from edgevpr import techniques
    from edgevpr.power.boards import load_board
    from edgevpr.power.speed import micro_benchmark
    from edgevpr.runtime.preflight import stored
    from edgevpr.runtime.preflight.trial import offers, try_each

    path = Path(args.out) if args.out else stored.default_path()
    stored.require_room(path)
    threads, wanted, speed = load_board("this").threads, offers(techniques.names()), micro_benchmark()
    trials = progress(try_each(wanted, threads), len(wanted), "measuring techniques")
    figures = stored.gathered(trials, threads, speed)
    stored.save(figures, path)
    try:
        own, power = stored.measured_profile(path, speed)
    except EdgevprError as error:
        own, power = None, str(error)
    if not (args.json and quiet):
        unusable = dict.fromkeys(trial.problem for trial in figures.trials if trial.problem)
        kept = f"{len(figures.trials)} trials are kept in {path}: `--places N` uses them."
        known = {**asdict(figures), "file": str(path), "profile": own and str(own), "power": power}
        show(known, args.json, "\n".join([*unusable, kept, power]))
