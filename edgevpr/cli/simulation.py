"""`edgevpr simulate` writes the images of a simulated flight; `edgevpr demo` demonstrates all steps from map to
match."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_command, add_group, parse_count, parse_positive
from edgevpr.core.errors import UsageError


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    simulations = add_group(commands, "simulate", "generate the images of flights")
    text = "generate the images and positions.csv of a flight"
    flight = add_command(simulations, "flight", run_simulate_flight, text)
    flight.add_argument("out", metavar="DIR")
    flight.add_argument("--which", choices=("map", "query"), help="map (default): mapping flight; query: later flight")
    text = "random seed of landscape and motion (default: 1)"
    flight.add_argument("--seed", type=parse_count, default=1, metavar="N", help=text)
    over = flight.add_argument_group("over an orthophoto")
    over.add_argument("--orthophoto", metavar="FILE", help="orthophoto, as for `map build` (needs rasterio)")
    over.add_argument(
        "--track", metavar="FILE", help="mission, or positions.csv with height_m[, yaw_deg, roll_deg, pitch_deg]"
    )
    text = "height above ground in metres (default: that of the track)"
    over.add_argument("--height-m", type=parse_positive, metavar="M", help=text)
    text = "distance between images of a mission in metres (default: 20)"
    over.add_argument("--every-m", type=parse_positive, default=20.0, metavar="M", help=text)
    text = "field of view across the image in degrees (default: 66)"
    over.add_argument("--fov-deg", type=parse_positive, default=66.0, metavar="DEG", help=text)
    demo = add_command(commands, "demo", run_demo, "map a generated flight, match a later one, and draw the result")
    demo.add_argument("--out", default="demo_out", metavar="DIR", help="folder to write (default: demo_out)")


def run_simulate_flight(args: Namespace) -> int:
    """Run `simulate flight`: write images and positions.csv of a flight over generated ground or an orthophoto."""
    if args.orthophoto is None:
        if args.track is not None:
            raise UsageError("--track applies only to --orthophoto: leave it out.")
        from edgevpr.lab.simulate.generated import write_generated_flight

        print(write_generated_flight(Path(args.out), args.which or "map", args.seed))
        return 0
    if args.track is None or args.which is not None:
        raise UsageError("A flight over an orthophoto needs --track and does not accept --which.")
    from edgevpr.core.text import progress
    from edgevpr.lab.simulate.overflight import read_shots, write_overflight
    from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or raises if it is missing

    shots = read_shots(args.track, args.height_m, args.every_m)
    taken = write_overflight(Path(args.out), Orthophoto(args.orthophoto), shots, args.fov_deg, args.seed)
    if not (written := sum(1 for _ in progress(taken, len(shots), "flying"))):
        raise UsageError(f"{args.orthophoto} does not cover any whole image along {args.track}: none was written.")
    print(f"{args.out}: {written} images in images/, their positions in positions.csv")
    if beyond := len(shots) - written:
        print(f"{beyond} left out: they would show ground beyond the orthophoto")
    return 0


def run_demo(args: Namespace) -> int:
    """Run `demo`: run the demonstration, and print its summary."""
    from edgevpr.lab.simulate import demo

    print(demo.run_demo(Path(args.out)))
    return 0
