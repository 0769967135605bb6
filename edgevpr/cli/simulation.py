"""`edgevpr simulate` and `edgevpr demo`: write the images of a generated flight, run a simulated flight controller, and
demonstrate all steps from map to match."""

import signal
from argparse import Namespace
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, add_parameters, command, group, parameters_of, show
from edgevpr.core.errors import UsageError

# The vehicles of edgevpr.lab.simulate.controller, which is not imported for a page of help.
_VEHICLES = ("arduplane", "arducopter", "px4-copter", "px4-plane")
_PARAMETER = "GPS2_TYPE=14"  # an example
# Number flags of a flight over an orthophoto: (default, least, greatest, help text).
_NUMBERS = {
    "height_m": (None, 1.0, 10_000.0, "over the ground (default: that of the track)"),
    "every_m": (20.0, 1.0, 1e6, "from picture to picture of a mission (20)"),
    "fov_deg": (66.0, 5.0, 120.0, "angle of view across the picture (66)"),
}


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    simulations = group(commands, "simulate", "a generated flight, a flight controller to talk to")
    autopilot = command(simulations, "autopilot", simulate_autopilot, "a flight controller that answers and counts")
    autopilot.add_argument("--link", default="udpin:127.0.0.1:14550", metavar="URL", help="(udpin:127.0.0.1:14550)")
    autopilot.add_argument(
        "--track", metavar="CSV", help="a positions.csv with times to fly along, from when a flight is first heard"
    )
    autopilot.add_argument("--vehicle", choices=_VEHICLES, default=_VEHICLES[0], help=f"({_VEHICLES[0]})")
    autopilot.add_argument(
        "--no-gps", action="store_true", help="it has lost GPS, as it always has without --track: then it takes fixes"
    )
    add_parameters(autopilot, f"a parameter of the vehicle, e.g. {_PARAMETER}, as if set before it was started")
    add_json(autopilot)
    text = "write a flight, generated or over an orthophoto: images and positions.csv"
    flight = command(simulations, "flight", simulate_flight, text)
    flight.add_argument("out", metavar="DIR")
    flight.add_argument("--which", choices=("map", "query"), help="the mapping flight (default), or a later one")
    flight.add_argument("--seed", type=int, default=1, metavar="N", help="another seed, another landscape and sway (1)")
    over = flight.add_argument_group("over an orthophoto")
    over.add_argument("--orthophoto", metavar="FILE", help="as for `map build`: needs rasterio")
    over.add_argument(
        "--track",
        metavar="FILE",
        help="a mission, or a positions.csv with height_m[, yaw_deg, roll_deg, pitch_deg]",
    )
    for name, (*_, text) in _NUMBERS.items():
        over.add_argument(f"--{name.replace('_', '-')}", type=float, metavar="X", help=text)
    demo = command(commands, "demo", run_demo, "the whole job on a generated flight, with a picture")
    demo.add_argument("--out", default="demo_out", metavar="DIR", help="(demo_out)")


def simulate_autopilot(args: Namespace) -> int:
    """Run `simulate autopilot`: run a simulated flight controller, and then print what it received."""
    from edgevpr.lab.simulate.autopilot import run_autopilot
    from edgevpr.lab.simulate.motion import read_track

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: it says what it has heard
    track = read_track(args.track) if args.track else None
    has_gps = track is not None and not args.no_gps
    parameters = parameters_of(args.param, _PARAMETER)
    show(run_autopilot(args.link, track=track, vehicle=args.vehicle, gps=has_gps, parameters=parameters), args.json)
    return 0


def simulate_flight(args: Namespace) -> int:
    """Run `simulate flight`: write images and positions.csv of a flight over generated ground or an orthophoto."""
    if args.seed < 0:
        raise UsageError(f"--seed is {args.seed}: give 0 or more.")
    if args.orthophoto is None:
        if said := [name for name in ("track", *_NUMBERS) if getattr(args, name) is not None]:
            raise UsageError(f"--{said[0].replace('_', '-')} goes with --orthophoto: leave it out.")
        from edgevpr.lab.simulate.generated import fly_and_write

        print(fly_and_write(Path(args.out), args.which or "map", args.seed))
        return 0
    if args.track is None or args.which is not None:
        raise UsageError("A flight over an orthophoto needs its --track, and has no --which.")
    print(_fly_over(args))
    return 0


def _fly_over(args: Namespace) -> str:
    from edgevpr.core.text import progress
    from edgevpr.lab.simulate.rehearsal import ground_under, read_shots, write_rehearsal
    from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or says that it is missing

    numbers: dict[str, Any] = {}
    for name, (usual, least, most, _) in _NUMBERS.items():
        numbers[name] = value = usual if getattr(args, name) is None else getattr(args, name)
        if value is not None and not least <= value <= most:  # false for NaN
            raise UsageError(f"--{name.replace('_', '-')} is {value:g}: give {least:g} to {most:g}.")
    shots = read_shots(args.track, numbers["height_m"], numbers["every_m"])
    orthophoto = Orthophoto(args.orthophoto, ground_under(shots, numbers["fov_deg"]))
    taken = write_rehearsal(Path(args.out), orthophoto, shots, numbers["fov_deg"], args.seed)
    written = sum(1 for _ in progress(taken, len(shots), "flying"))
    beyond = f" ({len(shots) - written} left out: they would show ground beyond the orthophoto)"
    return (
        f"{args.out}: {written} images in images/, where they were taken in positions.csv"
        f"{beyond if written < len(shots) else ''}"
    )


def run_demo(args: Namespace) -> int:
    """Run `demo`: run the demonstration, and print its summary."""
    from edgevpr.lab.simulate import demo

    print(demo.run_demo(Path(args.out)))
    return 0
