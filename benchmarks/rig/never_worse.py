"""The sweep: set-ups and events, each flown with edgevpr and beside its control, by a real ArduPilot and a real PX4 in
their own simulators. `make never-worse` flies all that is not kept yet, and writes benchmarks/results/never-worse.md.

python benchmarks/rig/never_worse.py [--quick | --cells CELL ...] [--workers N] [--report]

The edgevpr that flies is that of the checkout EDGEVPR_CHECKOUT (this one). Rows are kept in
~/.cache/edgevpr-rig/never_worse, those with edgevpr by its commit: an interrupted sweep goes on, and controls without
edgevpr are flown once. Cells that are named are flown anew.
"""

import argparse
import fcntl
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import count
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

import base
import ground
import px4
import simulator
from cells import CELLS, SET_UPS, Flight
from rig import WORK
from trial import Trial
from verdicts import figures_of, judged, page

KEPT = WORK / "never_worse"
_FIRST_INSTANCE = 1  # of a simulator: the first ports are left to rig.py


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what was started ends
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--quick", action="store_true", help="the part of ten minutes before a release")
    parser.add_argument("--cells", nargs="+", metavar="CELL", help="these, anew")
    parser.add_argument("--list", action="store_true", help="print the names of the cells")
    parser.add_argument("--report", action="store_true", help="write the page of what is kept")
    parser.add_argument("--workers", type=int, default=2, help="flights side by side (2)")
    parser.add_argument("--flight", nargs=3, help=argparse.SUPPRESS)  # set-up, event, matches
    arguments = parser.parse_args()
    if arguments.flight:
        fly(Flight(*arguments.flight))
        return
    if arguments.list:
        print("\n".join(CELLS))
        return
    if unknown := set(arguments.cells or ()) - set(CELLS):
        parser.error(f"no cell {', '.join(sorted(unknown))}: --list names them")
    names = arguments.cells or [name for name, cell in CELLS.items() if cell.is_quick or not arguments.quick]
    if not arguments.report:
        require_simulators(names)
        fly_all(names, set(arguments.cells or ()), arguments.workers)
    rows = kept_rows()
    found = [row for row in judged(rows) if arguments.report or row["cell"] in names]
    for row in found:
        print(f"{row['cell']}: {row['verdict']}")
    if arguments.report or not (arguments.cells or arguments.quick):
        result = {**base.made_by(), "commit": base.program_commit(ground.CHECKOUT), "cells": found}
        base.write("never-worse", result, page(result))
    sys.exit(not all(row["is_right"] for row in found) or len(found) < len(names))


def require_simulators(names: list[str]) -> None:
    """End with a sentence where a simulator that these cells need is not built."""
    set_ups = [SET_UPS[CELLS[name].flight.set_up] for name in names]
    if any(each.is_px4 for each in set_ups) and px4.build() is None:
        sys.exit(f"never_worse: build PX4's simulator, and name its folder in {px4.VARIABLE}.")
    if any(simulator.tree(each.vehicle) is None for each in set_ups if not each.is_px4):
        sys.exit(f"never_worse: build ArduPilot's simulator, and name its folder in {simulator.VARIABLE}.")


def row_path(flight: Flight) -> Path:
    """Return where the figures of a flight are kept."""
    part = base.program_commit(ground.CHECKOUT).replace(" ", "-") if flight.has_edgevpr else "alone"
    return KEPT / part / f"{flight.name}.json"


def kept_rows() -> dict[str, base.Row]:
    """Return the figures that are kept, by the name of the flight."""
    flights = {each.name: each for cell in CELLS.values() for each in (cell.flight, cell.control)}
    return {name: json.loads(path.read_text()) for name, each in flights.items() if (path := row_path(each)).exists()}


def fly_all(names: list[str], anew: set[str], workers: int) -> None:
    """Make the flights of these cells, and their controls, that are not kept, so many side by side."""
    flights = {each.name: each for name in names for each in (CELLS[name].control, CELLS[name].flight)}
    due = [each for name, each in flights.items() if name in anew or not row_path(each).exists()]
    for height in {each.scenario().mapped_m for each in due}:  # made once, not by two flights at once
        ground.place_map(WORK, 100.0, height)

    def fly_one(flight: Flight) -> None:
        words = (flight.set_up, flight.event, flight.matches)
        ended = subprocess.run([sys.executable, __file__, "--flight", *words], check=False)
        if ended.returncode:
            print(f"never_worse: {flight.name} has ended with {ended.returncode}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(fly_one, due))


@contextmanager
def free_instance() -> Iterator[int]:
    """Take a number of a simulator that no other sweep on this machine has; it is free again after the block."""
    KEPT.mkdir(parents=True, exist_ok=True)
    for number in count(_FIRST_INSTANCE):
        with open(KEPT / f"instance-{number}.lock", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield number
            return


def fly(flight: Flight) -> None:
    """Make one flight, and keep its figures; a control that another sweep is flying is waited for."""
    path = row_path(flight)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_suffix(".lock"), "w") as lock, free_instance() as instance:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists() and not flight.has_edgevpr:
            return
        folder = Trial(WORK, path.with_suffix(""), flight, instance).fly()
        row = figures_of(folder, flight)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(base.rounded(row)))
    unfinished.replace(path)
    shown = {key: value for key, value in base.rounded(row).items() if key not in ("commit", "texts")}
    print(f"{flight.name}: {json.dumps(shown)}", flush=True)


if __name__ == "__main__":
    base.run(main)
