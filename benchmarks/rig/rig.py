"""Flights of edgevpr with a real ArduPilot, plane and copter, in ArduPilot's own simulator: `make rig` flies every
scenario, with and without edgevpr, and writes benchmarks/results/rig.md. README.md says how, and how it is built.

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
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started ends
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"of {', '.join(SCENARIOS)}; none: all, and the page"
    )
    parser.add_argument("--seconds", type=float, help="after the loss of GPS (the scenario's)")
    over = {"type": Path, "metavar": "FILE", "help": "a picture from space: of the map's day, and another's"}
    parser.add_argument("--ground", **over)
    parser.add_argument("--later", **over)
    parser.add_argument("--height", type=float, help=f"above that ground, metres ({HEIGHT_M:.0f})")
    parser.add_argument("--seeds", type=int, default=1, help="flights of each scenario with edgevpr, each of its own")
    parser.add_argument("--report", action="store_true", help="write the page of the flights that were made")
    arguments = parser.parse_args()
    if unknown := set(arguments.scenarios) - set(SCENARIOS):
        parser.error(f"no scenario {', '.join(unknown)}")
    if (arguments.ground is None) != (arguments.later is None) or (arguments.height and not arguments.ground):
        parser.error("--ground and --later go together, and --height only with them")
    if absent := [str(path) for path in (arguments.ground, arguments.later) if path and not path.exists()]:
        parser.error(f"{absent[0]} is not there")
    height_m = arguments.height or HEIGHT_M
    work = ground.make_raster_ground(WORK, arguments.ground, arguments.later, height_m) if arguments.ground else WORK
    folders = []
    if not arguments.report:
        for name in arguments.scenarios or SCENARIOS:
            scenario = SCENARIOS[name]
            if (px4.find_build if scenario.is_px4 else find_build)() is None:
                whose, variable = ("PX4", px4.VARIABLE) if scenario.is_px4 else ("ArduPilot", VARIABLE)
                sys.exit(f"rig: build {whose}'s simulator, and name its folder in {variable}.")
            changed = replace(scenario, off_s=arguments.seconds or scenario.off_s, height_m=height_m)
            flights = [(format_flight_name(name, seed), False) for seed in range(1, 1 + arguments.seeds)]
            for flight, is_control in [*flights, (name, True)][: arguments.seeds + scenario.is_compared]:
                try:
                    folder = Run(work, work / "runs" / f"{flight}{'-control' * is_control}", changed, is_control).fly()
                    print(f"{folder.name}: {json.dumps(compute_run_figures(folder))}", flush=True)
                    folders += [] if is_control else [folder]
                except RuntimeError as error:  # one that does not arm, for example: the page has the others
                    print(f"rig: {flight}: {error}", file=sys.stderr, flush=True)
    if folders:
        draw_claims(folders, work / "claims.jpg")
    if arguments.report or not (arguments.scenarios or arguments.ground):
        write_page(WORK)


if __name__ == "__main__":
    base.run(main)
