"""The sweep: set-ups and events, each flown with edgevpr and compared with a control, by a real ArduPilot and a real
PX4 in their simulators. `make never-worse` flies all that has no result yet and writes results/never-worse.md.

python benchmarks/rig/never_worse.py [--quick | --cells CELL ...] [--workers N] [--report]

The code of edgevpr is that of the checkout EDGEVPR_CHECKOUT (default: this one). Results are kept in
~/.cache/edgevpr-rig/never_worse, those with edgevpr by its commit: an interrupted sweep continues, and controls without
edgevpr are flown only once. With --cells, these cells are flown again.
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
from dataclasses import astuple, replace
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
from verdicts import MAX_CONTROLS, combine_controls, compute_flight_figures, format_page, judge_cells

KEPT_FOLDER = WORK / "never_worse"
_FIRST_INSTANCE = 1  # of a simulator: instance 0 and its ports are left to rig.py


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # exits normally, so that child processes end
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--quick", action="store_true", help="fly only the part of ten minutes for a release")
    parser.add_argument("--cells", nargs="+", metavar="CELL", help="fly only these cells, even if they have results")
    parser.add_argument("--list", action="store_true", help="print the names of the cells")
    parser.add_argument("--report", action="store_true", help="fly nothing; write the page from the kept results")
    parser.add_argument("--workers", type=int, default=2, help="flights at the same time (default: 2)")
    parser.add_argument("--flight", nargs=4, help=argparse.SUPPRESS)  # set-up, event, matches, number
    arguments = parser.parse_args()
    if arguments.flight:
        set_up, event, matches, number = arguments.flight
        fly_and_keep(Flight(set_up, event, matches, int(number)))
        return
    if arguments.list:
        print("\n".join(CELLS))
        return
    if unknown := set(arguments.cells or ()) - set(CELLS):
        parser.error(f"unknown cells: {', '.join(sorted(unknown))} (--list prints all names)")
    names = arguments.cells or [name for name, cell in CELLS.items() if cell.is_quick or not arguments.quick]
    if not arguments.report:
        require_simulators(names)
        fly_cells(names, set(arguments.cells or ()), arguments.workers)
        worse = [row["cell"] for row in judge_cells(read_kept_rows()) if row["cell"] in names and not row["is_right"]]
        numbers = range(2, MAX_CONTROLS + 1)
        fly([replace(CELLS[name].control, number=number) for name in worse for number in numbers], arguments.workers)
    rows = read_kept_rows()
    cells = [row for row in judge_cells(rows) if arguments.report or row["cell"] in names]
    for row in cells:
        print(f"{row['cell']}: {row['verdict']}")
    if arguments.report or not (arguments.cells or arguments.quick):
        result = {**base.describe_run(), "commit": base.read_program_commit(ground.CHECKOUT), "cells": cells}
        base.write("never-worse", result, format_page(result))
    sys.exit(not all(row["is_right"] for row in cells) or len(cells) < len(names))


def require_simulators(names: list[str]) -> None:
    """Exit with a message if a simulator that these cells need is not built."""
    set_ups = [SET_UPS[CELLS[name].flight.set_up] for name in names]
    if any(set_up.is_px4 for set_up in set_ups) and px4.find_build() is None:
        sys.exit(f"never_worse: build PX4's simulator and set {px4.VARIABLE} to its folder.")
    if any(simulator.find_build(set_up.vehicle) is None for set_up in set_ups if not set_up.is_px4):
        sys.exit(f"never_worse: build ArduPilot's simulator and set {simulator.VARIABLE} to its folder.")


def find_row_path(flight: Flight) -> Path:
    """Return the path of the figures of a flight."""
    subfolder = base.read_program_commit(ground.CHECKOUT).replace(" ", "-") if flight.has_edgevpr else "alone"
    return KEPT_FOLDER / subfolder / f"{flight.name}.json"


def read_kept_rows() -> dict[str, base.Row]:
    """Return the kept figures by the name of the flight, of a control those of all its flights."""
    rows = {}
    for cell in CELLS.values():
        controls = [find_row_path(replace(cell.control, number=number)) for number in range(1, MAX_CONTROLS + 1)]
        for flight, paths in ((cell.flight, [find_row_path(cell.flight)]), (cell.control, controls)):
            if paths[0].exists():
                rows[flight.name] = combine_controls([json.loads(path.read_text()) for path in paths if path.exists()])
    return rows


def fly_cells(names: list[str], again: set[str], workers: int) -> None:
    """Fly these cells and their controls, `workers` at a time, but those with results only if in `again`."""
    flights = {flight.name: flight for name in names for flight in (CELLS[name].control, CELLS[name].flight)}
    fly([flight for name, flight in flights.items() if name in again or not find_row_path(flight).exists()], workers)


def fly(due: list[Flight], workers: int) -> None:
    """Make these flights, `workers` at a time."""
    for mapped_m in {flight.make_scenario().mapped_m for flight in due}:  # not by two flights at once
        ground.build_place_map(WORK, 100.0, mapped_m)

    def fly_one(flight: Flight) -> None:
        arguments = map(str, astuple(flight))
        process = subprocess.run([sys.executable, __file__, "--flight", *arguments], check=False)
        if process.returncode:
            print(f"never_worse: {flight.name} exited with code {process.returncode}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(fly_one, due))


@contextmanager
def reserve_instance() -> Iterator[int]:
    """Reserve, within the block, the number of a simulator instance that no other sweep on this machine uses."""
    KEPT_FOLDER.mkdir(parents=True, exist_ok=True)
    for number in count(_FIRST_INSTANCE):
        with open(KEPT_FOLDER / f"instance-{number}.lock", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield number
            return


def fly_and_keep(flight: Flight) -> None:
    """Make one flight and write its figures. If another process flies the same control, wait for its result."""
    path = find_row_path(flight)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_suffix(".lock"), "w") as lock, reserve_instance() as instance:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists() and not flight.has_edgevpr:
            return
        folder = Trial(WORK, path.with_suffix(""), flight, instance).fly()
        row = compute_flight_figures(folder, flight)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(base.round_floats(row)))
    unfinished.replace(path)
    figures = {key: value for key, value in base.round_floats(row).items() if key not in ("commit", "texts")}
    print(f"{flight.name}: {json.dumps(figures)}", flush=True)


if __name__ == "__main__":
    base.run(main)
