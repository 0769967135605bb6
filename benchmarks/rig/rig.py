"""Flights of edgevpr with a real ArduPilot or PX4, plane and copter, in its own simulator: `make rig` flies every
scenario with and without edgevpr and writes benchmarks/results/rig.md. README.md describes set-up and use.

python benchmarks/rig/rig.py [SCENARIO ...] [--seconds S] [--ground FILE --later FILE --height M] [--seeds N]
       [--report]
"""

import argparse
import json
import signal
import sys
from dataclasses import replace
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

import base
import ground
import px4
from figures import compute_run_figures
from flying import Run
from page import draw_claims, write_page
from scenarios import HEIGHT_M, SCENARIOS, format_flight_name
from simulator import VARIABLE, find_build

WORK = Path.home() / ".cache" / "edgevpr-rig"


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # exits normally, so that child processes end
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: all, and the page)"
    )
    parser.add_argument("--seconds", type=float, help="flight time after the loss of GPS (default: as in the scenario)")
    parser.add_argument("--ground", type=Path, metavar="FILE", help="satellite raster of the map's day")
    parser.add_argument("--later", type=Path, metavar="FILE", help="satellite raster of the flight's day")
    parser.add_argument("--height", type=float, help=f"height above that ground, metres ({HEIGHT_M:.0f})")
    parser.add_argument("--seeds", type=int, default=1, help="number of flights with edgevpr, each with its own seed")
    parser.add_argument("--report", action="store_true", help="fly nothing; write the page from existing flights")
    arguments = parser.parse_args()
    if unknown := set(arguments.scenarios) - set(SCENARIOS):
        parser.error(f"unknown scenario: {', '.join(unknown)}")
    if (arguments.ground is None) != (arguments.later is None) or (arguments.height and not arguments.ground):
        parser.error("--ground and --later need each other, and --height needs both")
    if missing := [str(path) for path in (arguments.ground, arguments.later) if path and not path.exists()]:
        parser.error(f"{missing[0]} does not exist")
    height_m = arguments.height or HEIGHT_M
    work = ground.make_raster_ground(WORK, arguments.ground, arguments.later, height_m) if arguments.ground else WORK
    folders = []
    if not arguments.report:
        for name in arguments.scenarios or SCENARIOS:
            scenario = SCENARIOS[name]
            if (px4.find_build if scenario.is_px4 else find_build)() is None:
                autopilot, variable = ("PX4", px4.VARIABLE) if scenario.is_px4 else ("ArduPilot", VARIABLE)
                sys.exit(f"rig: build {autopilot}'s simulator and set {variable} to its folder.")
            scenario = replace(scenario, off_s=arguments.seconds or scenario.off_s, height_m=height_m)
            flights = [(format_flight_name(name, seed), False) for seed in range(1, 1 + arguments.seeds)]
            for flight, is_control in [*flights, (name, True)][: arguments.seeds + scenario.is_compared]:
                try:
                    folder = Run(work, work / "runs" / f"{flight}{'-control' * is_control}", scenario, is_control).fly()
                    print(f"{folder.name}: {json.dumps(compute_run_figures(folder))}", flush=True)
                    folders += [] if is_control else [folder]
                except RuntimeError as error:  # for example: does not arm; the page has the other flights
                    print(f"rig: {flight}: {error}", file=sys.stderr, flush=True)
    if folders:
        draw_claims(folders, work / "claims.jpg")
    if arguments.report or not (arguments.scenarios or arguments.ground):
        write_page(WORK)


if __name__ == "__main__":
    base.run(main)
