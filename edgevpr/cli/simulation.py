"""`edgevpr simulate` and `demo`: a generated flight, a simulated flight controller, and a demonstration of the whole
job."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, command, group, print_json
from edgevpr.errors import UsageError


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    simulations = group(commands, "simulate", "a generated flight, a flight controller to talk to")
    autopilot = command(simulations, "autopilot", simulate_autopilot, "a flight controller that answers and counts")
    autopilot.add_argument("--link", default="udpin:127.0.0.1:14550", metavar="URL", help="(udpin:127.0.0.1:14550)")
    autopilot.add_argument("--duration-s", type=float, metavar="S", help="how long (default: until stopped)")
    autopilot.add_argument(
        "--track", metavar="CSV", help="a positions.csv with times to fly along, from when a companion is first heard"
    )
    add_json(autopilot)
    flight = command(simulations, "flight", simulate_flight, "write a generated flight: images and positions.csv")
    flight.add_argument("out", metavar="DIR")
    flight.add_argument("--which", choices=("map", "query"), default="map", help="the mapping flight, or a later one")
    flight.add_argument("--seed", type=int, default=1, metavar="N", help="another seed, another landscape (1)")
    demo = command(commands, "demo", run_demo, "the whole job on a generated flight, with a picture")
    demo.add_argument("--out", default="demo_out", metavar="DIR", help="(demo_out)")


def simulate_autopilot(args: Namespace) -> int:
    """Run a simulated flight controller, and print what it has received."""
    from edgevpr.simulate.autopilot import read_track, run_autopilot

    summary = run_autopilot(args.link, args.duration_s, track=read_track(args.track) if args.track else None)
    if args.json:
        print_json(asdict(summary))
    else:
        print(summary)
    return 0


def simulate_flight(args: Namespace) -> int:
    """Write a generated flight: images and positions.csv."""
    from edgevpr.simulate.flight import fly_and_write

    if args.seed < 0:
        raise UsageError(f"--seed is {args.seed}: give 0 or more.")
    print(fly_and_write(Path(args.out), args.which, args.seed))
    return 0


def run_demo(args: Namespace) -> int:
    """Run the demonstration, and print its summary."""
    from edgevpr.simulate import demo

    print(demo.run_demo(Path(args.out)))
    return 0
