"""Flights of edgevpr with a real ArduPilot, plane and copter, in ArduPilot's own simulator.

A camera is rendered from the true pose over ground that edgevpr generates. edgevpr runs as a process between the camera
and the autopilot's MAVLink port, and GPS is taken away. Each flight is made with and without edgevpr.

The simulator is ArduPilot built from its public source (github.com/ArduPilot/ardupilot, 4.7-dev, commit 90700977) by
`./waf configure --board sitl && ./waf plane copter`; EDGEVPR_ARDUPILOT names the folder of that source.
`make rig`, or `python benchmarks/rig/rig.py --all`, flies every scenario and writes benchmarks/results/rig.md;
`python benchmarks/rig/rig.py plane_wind --control` flies one.
"""

import argparse
import json
import signal
import sys
from dataclasses import replace
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

import base
from figures import figures_of
from flying import Plan, Run
from page import write_page
from scenarios import SCENARIOS
from simulator import VARIABLE, tree

WORK = Path.home() / ".cache" / "edgevpr-rig"


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started ends
    arguments, words = parsed()
    if arguments.report:
        return write_page(arguments.work)
    if tree() is None:
        sys.exit(f"rig: build ArduPilot's simulator, and name its folder in {VARIABLE}.")
    if arguments.all:
        for name, scenario in SCENARIOS.items():
            for is_control in (False, True)[: 1 + scenario.is_compared]:
                try:
                    fly(plan(arguments, words, name, is_control))
                except RuntimeError as error:  # one that does not arm, for example: the page has the others
                    print(f"rig: {name}: {error}", file=sys.stderr, flush=True)
        return write_page(arguments.work)
    if arguments.scenario is None:
        sys.exit(f"rig: name a scenario ({', '.join(SCENARIOS)}), or --all.")
    try:
        print(json.dumps(fly(plan(arguments, words, arguments.scenario, arguments.control))))
    except RuntimeError as error:
        sys.exit(f"rig: {error}")


def parsed() -> tuple[argparse.Namespace, tuple[str, ...]]:
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n")[0], epilog="What follows -- goes to `edgevpr run`."
    )
    parser.add_argument("scenario", nargs="?", choices=SCENARIOS)
    parser.add_argument("--all", action="store_true", help="fly all of them, with and without edgevpr, and report")
    parser.add_argument("--report", action="store_true", help="write the report of the flights that were made")
    parser.add_argument("--control", action="store_true", help="fly without edgevpr")
    parser.add_argument("--seconds", type=float, help="after the loss of GPS (the scenario's)")
    parser.add_argument("--gps-seconds", type=float, help="before it (the scenario's)")
    parser.add_argument("--rate-hz", type=float, default=1.0, help="queries a second (1)")
    parser.add_argument("--instance", type=int, default=0, help="other ports, for flights side by side (0)")
    parser.add_argument("--name", help="folder of the run (the scenario's name, with -control)")
    parser.add_argument("--work", type=Path, default=WORK, help=f"folder of the ground, the map and the runs ({WORK})")
    return parser.parse_args(words[:cut]), tuple(words[cut + 1 :])


def plan(arguments: argparse.Namespace, words: tuple[str, ...], name: str, is_control: bool) -> Plan:
    scenario = SCENARIOS[name]
    if arguments.seconds is not None:
        scenario = replace(scenario, off_s=arguments.seconds)
    if arguments.gps_seconds is not None:
        scenario = replace(scenario, gps_s=arguments.gps_seconds)
    folder = arguments.name or (f"{name}-control" if is_control else name)
    return Plan(
        name=name,
        scenario=scenario,
        is_control=is_control,
        instance=arguments.instance,
        rate_hz=arguments.rate_hz,
        words=words,
        folder=arguments.work / "runs" / folder,
        work=arguments.work,
    )


def fly(plan: Plan) -> dict:
    """Make a run; return its figures."""
    with Run(plan) as run:
        run.fly()
        report = run.report()
    (plan.folder / "run.json").write_text(json.dumps(report))
    found = figures_of(plan.folder)
    (plan.folder / "figures.json").write_text(json.dumps(found, indent=1) + "\n")
    return found


if __name__ == "__main__":
    base.run(main)
