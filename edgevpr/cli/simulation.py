"""`edgevpr simulate` writes the images of a simulated flight; `edgevpr demo` shows all steps from map to match."""

from argparse import ArgumentTypeError, Namespace
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_command, add_group
from edgevpr.core.errors import UsageError

# Number flags of a flight over an orthophoto: (default, minimum, maximum, help text).
_NUMBER_FLAGS: dict[str, tuple[float | None, float, float, str]] = {
    "height_m": (None, 1.0, 10_000.0, "height above ground in metres (default: that of the track)"),
    "every_m": (20.0, 1.0, 1e6, "distance between images of a mission in metres (default: 20)"),
    "fov_deg": (66.0, 5.0, 120.0, "field of view across the image in degrees (default: 66)"),
}


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    simulations = add_group(commands, "simulate", "generate the images of flights")
    text = "generate the images and positions.csv of a flight"
    flight = add_command(simulations, "flight", run_simulate_flight, text)
    flight.add_argument("out", metavar="DIR")
    flight.add_argument("--which", choices=("map", "query"), help="map (default): mapping flight; query: later flight")
    text = "random seed for the landscape and motion (default: 1)"
    flight.add_argument("--seed", type=_parse_seed, default=1, metavar="N", help=text)
    orthophoto = flight.add_argument_group("over an orthophoto")
    orthophoto.add_argument("--orthophoto", metavar="FILE", help="orthophoto, as for `map build` (needs rasterio)")
    orthophoto.add_argument(
        "--track", metavar="FILE", help="mission, or positions.csv with height_m[, yaw_deg, roll_deg, pitch_deg]"
    )
    for name, (*_, text) in _NUMBER_FLAGS.items():
        orthophoto.add_argument(f"--{name.replace('_', '-')}", type=float, metavar="X", help=text)
    demo = add_command(commands, "demo", run_demo, "map a generated flight, match a later one, and draw the result")
    demo.add_argument("--out", default="demo_out", metavar="DIR", help="folder to write (default: demo_out)")


def _parse_seed(text: str) -> int:
    if not text.isdecimal():
        raise ArgumentTypeError(f"`{text}` is not a whole number of 0 or more")
    return int(text)


def run_simulate_flight(args: Namespace) -> None:
    """Run `simulate flight`: write images and positions.csv of a flight over generated ground or an orthophoto."""
    if args.orthophoto is None:
        if flags := [name for name in ("track", *_NUMBER_FLAGS) if getattr(args, name) is not None]:
            raise UsageError(f"--{flags[0].replace('_', '-')} applies only to --orthophoto: leave it out.")
        from edgevpr.lab.simulate.generated import write_generated_flight

        print(write_generated_flight(Path(args.out), args.which or "map", args.seed))
        return
    if args.track is None or args.which is not None:
        raise UsageError("A flight over an orthophoto needs --track and does not accept --which.")
    from edgevpr.core.text import progress
    from edgevpr.lab.simulate.overflight import read_shots, write_overflight
    from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or raises if it is missing

    numbers: dict[str, Any] = {}
    for name, (default, low, high, _) in _NUMBER_FLAGS.items():
        numbers[name] = value = default if getattr(args, name) is None else getattr(args, name)
        if value is not None and not low <= value <= high:  # false for NaN
            raise UsageError(f"--{name.replace('_', '-')} is {value:g}, but must be between {low:g} and {high:g}.")
    shots = read_shots(args.track, numbers["height_m"], numbers["every_m"])
    image_names = write_overflight(Path(args.out), Orthophoto(args.orthophoto), shots, numbers["fov_deg"], args.seed)
    if not (written := sum(1 for _ in progress(image_names, len(shots), "flying"))):
        raise UsageError(f"{args.orthophoto} covers no complete image along {args.track}: no images were written.")
    print(f"{args.out}: {written} images in images/, their positions in positions.csv")
    if beyond := len(shots) - written:
        print(f"{beyond} images left out: they would show ground beyond the orthophoto")


def run_demo(args: Namespace) -> None:
    """Run `demo`: run the demonstration, and print its summary."""
    from edgevpr.lab.simulate import demo

    print(demo.run_demo(Path(args.out)))
