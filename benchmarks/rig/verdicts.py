"""The figures of a flight of the sweep, the verdict on each cell, and the page of all cells."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import base
import numpy as np
from base import Row
from cells import CELLS, EVENTS, SET_UPS, WATCH_S, Flight
from figures import read_table
from recording import EDGEVPR

from edgevpr.runtime.flight.flightlog import read_log

# Limits for how much worse than its control a flight with edgevpr may be.
MARGIN_M = 3.0
MARGIN_S = 5.0
MAX_CONTROLS = 3  # flights of a control, if a flight is worse than the first
FIRST_POSITION_S = 60.0  # after a start of the autopilot, which itself needs 25 s to get a position
_GPS_ERROR_M = 5.0  # the estimate uses GPS again once its error stays below this
_DISTANCES = {"strayed_m": "strays {:.0f} m", "sank_m": "sinks {:.0f} m", "error_m": "estimate {:.0f} m off"}
_COLUMNS = {
    "cell": "{cell}",
    "strays": "{with[strayed_m]:.1f}",
    "alone ": "{control[strayed_m]:.1f}",
    "sinks": "{with[sank_m]:.1f}",
    "alone  ": "{control[sank_m]:.1f}",
    "estimate off": "{with[error_m]:.1f}",
    "alone   ": "{control[error_m]:.1f}",
    "on GPS after s": "{with[on_gps_s]}",
    "alone    ": "{control[on_gps_s]}",
    "sent": "{with[sent]}",
    "accepted": "{with[accepted]}",
    "controls": "{control[flights]}",
    "verdict": "{verdict}",
}


def compute_flight_figures(folder: Path, flight: Flight) -> Row:
    """Return the figures of a flight from its folder: maxima over the watched time, counts, and the texts."""
    run, event = json.loads((folder / "run.json").read_text()), EVENTS[flight.event]
    marks_s, track = run["marks_s"], read_table(folder / "track.csv")
    texts = [text.removeprefix("edgevpr: ") for _, sender, text in run["texts"] if sender == EDGEVPR]
    row: Row = {"commit": run["commit"], "cannot": run["cannot"], "warnings": run["warnings"], "texts": texts}
    if run["cannot"]:  # figures start when the autopilot has a position
        placed_s = track["t_s"][(track["error_m"] < _GPS_ERROR_M) & (track["t_s"] >= marks_s.get("started", math.inf))]
        began_s = float(placed_s[0]) if len(placed_s) else math.inf
        row["error_m"] = float(track["error_m"][track["t_s"] >= began_s].max(initial=0.0))
    else:
        began_s = marks_s["event"]
        track = track[(track["t_s"] >= began_s) & (track["t_s"] <= began_s + WATCH_S)]
        after_s, error_m, height_m = track["t_s"] - began_s, track["error_m"], track["height_m"]
        points_m = np.stack((track["east_m"], track["north_m"]), axis=1)
        row["strayed_m"] = float(compute_distances(points_m, run["path_m"]).max())
        row["sank_m"] = float(height_m[0] - height_m.min())
        row["error_m"] = float(error_m.max())
        if event.gps_back_s is not None:
            row["on_gps_s"] = measure_recovery_s(after_s - event.gps_back_s, error_m)
    if flight.has_edgevpr:
        sent_s = read_table(folder / "sent.csv")["t_s"]
        row["sent"] = int(((sent_s >= began_s) & (bool(run["cannot"]) | (sent_s <= began_s + WATCH_S))).sum())
        if event.before:
            due_s = marks_s.get("started", math.inf) if SET_UPS[flight.set_up].sends_with_gps else began_s
            row["first_s"] = next((round(float(time_s - due_s), 1) for time_s in sent_s if time_s >= due_s), None)
        if event.silent_s is not None:
            row["sent_though_silent"] = int((sent_s >= began_s + event.silent_s).sum())
        # A restart begins a new log.
        queries = [line for log in folder.glob("flight*.jsonl") for line in read_log(log) if line["kind"] == "query"]
        row["accepted"] = f"{sum(query['accepted'] for query in queries)} of {len(queries)}"
    return row


def compute_distances(points_m: np.ndarray, path_m: list) -> np.ndarray:
    """Return the distance (N,) of each point (N, 2) from a path, a list of corners."""
    corners = np.array(path_m, float)
    distances_m = np.full(len(points_m), math.inf)
    for start, end in pairwise(corners):
        leg = end - start
        share = np.clip((points_m - start) @ leg / max(float(leg @ leg), 1e-9), 0.0, 1.0)
        distances_m = np.minimum(distances_m, np.hypot(*(points_m - start - share[:, None] * leg).T))
    return distances_m


def measure_recovery_s(after_s: np.ndarray, error_m: np.ndarray) -> float | None:
    """Return the time from which the error stays below `_GPS_ERROR_M`; None if it is larger at the end."""
    large = np.flatnonzero((error_m > _GPS_ERROR_M) & (after_s >= 0))
    if len(large) == 0:
        return 0.0
    return None if large[-1] == len(after_s) - 1 else round(float(after_s[large[-1] + 1]), 1)


def find_faults(figures: Row, control: Row) -> list[str]:
    """Return the faults of a flight as texts, from its figures and those of its control."""
    if control["cannot"]:
        return [f"no control: {control['cannot']}"]
    faults = [figures["cannot"]] if figures["cannot"] and not is_refused(figures) else []
    if figures["cannot"] and figures["error_m"] > control["error_m"] + MARGIN_M:
        faults.append(_DISTANCES["error_m"].format(figures["error_m"]))
    if not figures["cannot"] and not is_refused(figures):
        worse = [key for key in _DISTANCES if figures[key] > control[key] + MARGIN_M]
        faults += [_DISTANCES[key].format(figures[key]) for key in worse]
        back_s, control_s = figures.get("on_gps_s", 0.0), control.get("on_gps_s", 0.0)
        if control_s is not None and (back_s is None or back_s > control_s + MARGIN_S):
            faults.append("not on GPS again" if back_s is None else f"on GPS {back_s - control_s:.0f} s later")
    first_s = figures.get("first_s", 0.0)
    if first_s is None or first_s > FIRST_POSITION_S:
        faults.append("no position in time")
    if figures.get("sent_though_silent"):
        faults.append(f"{figures['sent_though_silent']} positions though paused")
    return faults


def combine_controls(rows: list[Row]) -> Row:
    """Return the largest figures of several flights of one control; None, which is never on GPS again, is larger."""
    numbers = {"flights": len(rows)}
    for key in (*_DISTANCES, "on_gps_s"):
        if values := [row[key] for row in rows if key in row]:
            numbers[key] = None if None in values else max(values)
    return rows[0] | numbers


def is_refused(figures: Row) -> bool:
    """Return True if edgevpr has warned, and has sent nothing in the watched time or the aircraft stayed on the ground.
    The message on a busy computer is a notice, not a warning."""
    return bool(figures["warnings"]) and (not figures.get("sent") or bool(figures["cannot"]))


def judge_cells(rows: Mapping[str, Row]) -> list[Row]:
    """Judge each cell of the table that was flown, as was its control. `rows`: figures of each flight, by its name."""
    judged = []
    for name, cell in CELLS.items():
        figures, control = rows.get(name), rows.get(cell.control.name)
        if figures and control:
            faults = find_faults(figures, control)
            verdict = "; ".join(faults) or ("refused" if is_refused(figures) else "right")
            fields = {"cell": name, "beside": cell.control.name, "verdict": verdict, "is_right": not faults}
            judged.append({**fields, "with": figures, "control": control})
    return judged


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    cells = result["cells"]
    wrong = [row for row in cells if not row["is_right"]]
    flown = [row for row in cells if is_refused(row["with"]) and not row["with"]["cannot"]]
    led = [row["cell"] for row in flown if any(row["with"][k] > row["control"][k] + MARGIN_M for k in _DISTANCES)]
    texts = "\n".join(f"* {row['cell']}: {'; '.join(row['with']['texts']) or 'none'}" for row in cells)
    with_edgevpr = [f"{row['cell']} (by {row['beside']})" for row in cells if CELLS[row["cell"]].control.has_edgevpr]
    commits = Counter(row["with"]["commit"] for row in cells)
    versions = ", ".join(f"{commit} ({count} cells)" for commit, count in commits.items())
    return f"""# Never worse than alone

A real ArduPilot or PX4 in its own simulator flies with edgevpr, and makes the same flight without it: {len(cells)} of
{len(CELLS)} cells of the table (benchmarks/rig/cells.py: set-up, event, and the matches of the camera) are flown,
{len(wrong)} of them worse than alone. A copter hovers at 100 m or flies a leg, a plane circles; then the event begins,
and {WATCH_S:.0f} s are watched.

Largest values of that time in metres, each followed by that of the control (alone): distance of the aircraft from its
planned path, loss of height, and error of the autopilot's estimate. Then the seconds from the return of GPS until this
error stays within {_GPS_ERROR_M:.0f} m, the number of positions sent, and the queries accepted in the whole flight.

A flight that is worse than its control is compared with the largest values of {MAX_CONTROLS} controls, because chance
moves a PX4 that lands without a position by tens of metres.

Right: compared with the controls, no distance is more than {MARGIN_M:.0f} m worse, and GPS is used again at most
{MARGIN_S:.0f} s later; positions come within {FIRST_POSITION_S:.0f} s of a start of the autopilot, none while paused.
Refused: edgevpr has warned, and it sends nothing or the aircraft does not arm. Of these, farther than alone, by chance
or because the aircraft flew by edgevpr alone, which then sent nothing: {", ".join(led) or "none"}.

{base.format_table(cells, _COLUMNS)}

Cells whose control also flies with edgevpr, but without a part of the event: {", ".join(with_edgevpr) or "none"}.

What edgevpr reported to the ground station:

{texts}

Flown with edgevpr at {versions}. {base.format_origin(result, "make never-worse")}
"""
