"""Figures of a run, computed from the files in its folder: the autopilot's estimate, edgevpr's fixes, the answers."""

import json
import math
from pathlib import Path

import numpy as np
from base import Row

from edgevpr.lab.simulate.generated import to_metres
from edgevpr.runtime.flight.flightlog import read_log

ROLL_DEG = ((0, 6), (6, 20), (20, 90))
AFTER_LOSS_S = (10, 30, 60, 120, 180, 240, 300)
_MAX_PICTURE_OFFSET_S = 0.05  # between a query and its picture
_ALARMS = ("failsafe", "variance", "stopped aiding", "crash", "emergency")


def summarise(values: np.ndarray) -> Row:
    """Return the number, median, 90th percentile and maximum of errors in metres."""
    if len(values) == 0:
        return {"n": 0}
    median, p90, maximum = np.quantile(values, (0.5, 0.9, 1.0))
    figures = {"median": median, "p90": p90, "max": maximum}
    return {"n": len(values), **{name: round(float(value), 1) for name, value in figures.items()}}


def read_table(path: Path) -> np.ndarray:
    """Read a CSV file into a structured array with a field per column, each a float except `kind`."""
    names, *lines = path.read_text("utf-8").splitlines()
    columns = [(name, "U32" if name == "kind" else float) for name in names.split(",")]
    return np.atleast_1d(np.genfromtxt(lines, columns, delimiter=",")) if lines else np.empty(0, columns)


def compute_run_figures(folder: Path) -> Row:
    """Return the figures of the run whose files are in `folder`."""
    run = json.loads((folder / "run.json").read_text())
    track, loss_s = read_table(folder / "track.csv"), run["marks_s"]["loss"]
    log = list(read_log(folder / "flight.jsonl")) if (folder / "flight.jsonl").exists() else []
    figures: Row = {"commit": run["commit"]}
    figures |= {"estimate": _score_estimate(track, loss_s), "modes": _list_modes(track, loss_s)}
    figures["alarms"] = [
        [round(t_s - loss_s, 1), text]
        for t_s, sender, text in run["texts"]
        if sender == 1 and any(word in text.lower() for word in _ALARMS)
    ]
    if log:
        pictures, sent = read_table(folder / "pictures.csv"), read_table(folder / "sent.csv")
        queries = [line for line in log if line["kind"] == "query"]
        figures["fixes"] = _score_fixes(pictures, queries)
        figures["sent"] = _score_sent(sent[sent["t_s"] >= loss_s])
        figures["wire_ms"] = _measure_wire_ms(sent, queries)
        figures["answers"] = dict(log[-1].get("mavlink", {}).get("acks", {}))
        figures["queries"] = len(queries)
        figures["accepted"] = sum(line["accepted"] for line in queries)
        ages_ms = [1e3 * (line["t_mono_s"] - line["t_frame_s"]) for line in queries]
        figures["query_ms"] = np.quantile(ages_ms, (0.5, 0.99)).round().astype(int).tolist() if queries else None
        figures["gap"] = _find_longest_gap(sent, pictures, [q["t_frame_s"] for q in queries if q["accepted"]], loss_s)
        figures["gps_alarms_s"] = [
            round(line["t_mono_s"] - loss_s, 1) for line in log if line["kind"] == "gps" and line["is_wrong"]
        ]
    return figures


def max_per_second(track: np.ndarray, loss_s: float) -> np.ndarray:
    """Return the largest error of the estimate in each second after the loss, metres; -inf where it has no row."""
    seconds = np.floor(track["t_s"] - loss_s).astype(int)
    last = int(seconds.max(initial=-1))
    return np.array([track["error_m"][seconds == second].max(initial=-math.inf) for second in range(last + 1)])


def compare_estimates(with_edgevpr: np.ndarray, without: np.ndarray) -> tuple[float, int] | None:
    """Return by how many metres the estimate is worse than in the flight without edgevpr, at the worst second after the
    loss, and that second; None if one of the flights has no second. Arguments: as from `max_per_second`."""
    length = min(len(with_edgevpr), len(without))
    if length == 0:
        return None
    excess_m = with_edgevpr[:length] - without[:length]
    return round(float(excess_m.max()), 1), int(excess_m.argmax())


def _score_estimate(track: np.ndarray, loss_s: float) -> Row:
    """Return the errors of the autopilot's estimate after the loss: summary, and interpolated at AFTER_LOSS_S."""
    after_s, error_m = track["t_s"] - loss_s, track["error_m"]
    end_s = after_s[-1] + 0.5
    times_s = [time_s for time_s in AFTER_LOSS_S if time_s <= end_s]
    at_s = {str(time_s): round(float(np.interp(time_s, after_s, error_m)), 1) for time_s in times_s}
    return {"after": summarise(error_m[after_s >= 0]), "at_s": at_s}


def _list_modes(track: np.ndarray, loss_s: float) -> list[list[float]]:
    """Return [seconds after the loss, mode number], at the loss and at each later change of mode."""
    after = track[track["t_s"] >= loss_s]
    changes = [0, *(np.flatnonzero(np.diff(after["mode"])) + 1)] if len(after) else []
    return [[round(float(after["t_s"][row] - loss_s), 1), int(after["mode"][row])] for row in changes]


def _score_fixes(pictures: np.ndarray, queries: list[Row]) -> Row:
    """Return the errors of accepted matches relative to the true positions of their pictures."""
    errors_m, roll_deg, claims_m = [], [], []
    for line in queries:
        picture = pictures[np.argmin(abs(pictures["t_s"] - line["t_frame_s"]))]
        is_tilted = line.get("view", {}).get("reason")  # too much: such fixes are not sent
        if not line["accepted"] or not line["located"] or is_tilted:
            continue
        if abs(picture["t_s"] - line["t_frame_s"]) > _MAX_PICTURE_OFFSET_S:
            continue
        east_m, north_m = to_metres(line["located"]["lat_deg"], line["located"]["lon_deg"])
        errors_m.append((east_m - picture["east_m"], north_m - picture["north_m"]))
        roll_deg.append(abs(picture["roll_deg"]))
        claims_m.append(line["accuracy_m"])
    if not errors_m:
        return {"error": summarise(np.array([]))}
    error_m, rolls_deg = np.hypot(*np.transpose(errors_m)), np.array(roll_deg)
    by_roll = {f"{low}-{high}": summarise(error_m[(rolls_deg >= low) & (rolls_deg < high)]) for low, high in ROLL_DEG}
    return {"error": summarise(error_m), "by_roll_deg": by_roll} | _score_claims(np.array(errors_m), np.array(claims_m))


def _score_claims(errors_m: np.ndarray, claimed_m: np.ndarray) -> Row:
    """Return the median claimed accuracy, and the shares of errors, axis by axis, within one and two claimed sigma.
    `errors_m`: (N, 2) east and north; `claimed_m`: (N,)."""
    sigmas = abs(errors_m) / np.maximum(claimed_m, 1e-3)[:, None]
    within = [round(float((sigmas <= limit).mean()), 2) for limit in (1, 2)]
    return {"claimed_m": round(float(np.median(claimed_m)), 2), "within": within}


def _score_sent(sent: np.ndarray) -> Row:
    """Return the rate, errors and claimed accuracies of sent positions, by the name of their message."""
    figures = {}
    for kind in np.unique(sent["kind"]):
        rows = sent[sent["kind"] == kind]
        if len(rows) < 2:
            continue
        errors_m = np.stack((rows["east_m"] - rows["true_east_m"], rows["north_m"] - rows["true_north_m"]), axis=1)
        rate_hz = round(len(rows) / float(np.ptp(rows["t_s"])), 1)
        claims = _score_claims(errors_m, rows["accuracy_m"])
        figures[str(kind)] = {"rate_hz": rate_hz, "error": summarise(np.hypot(*errors_m.T)), **claims}
    return figures


def _find_longest_gap(sent: np.ndarray, pictures: np.ndarray, accepted_s: list[float], loss_s: float) -> Row | None:
    """Return the longest time without an accepted match after the loss: its length in seconds, the distance flown, and
    the error in metres of the last position sent in that time (None: none was sent)."""
    bounds_s = np.array([loss_s, *(time_s for time_s in accepted_s if time_s > loss_s), pictures["t_s"][-1]])
    index = int(np.diff(bounds_s).argmax())
    from_s, to_s = bounds_s[index : index + 2]
    route = pictures[(pictures["t_s"] >= from_s) & (pictures["t_s"] <= to_s)]
    sent_in_gap = sent[(sent["t_s"] > from_s) & (sent["t_s"] <= to_s)]
    distance_m = float(np.hypot(np.diff(route["east_m"]), np.diff(route["north_m"])).sum())
    gap: Row = {"s": round(float(to_s - from_s), 1), "way_m": round(distance_m), "off_m": None}
    if len(sent_in_gap):
        last = sent_in_gap[-1]
        error_m = math.hypot(last["east_m"] - last["true_east_m"], last["north_m"] - last["true_north_m"])
        gap |= {"off_m": round(error_m, 1), "told_s": round(float(last["t_s"] - from_s), 1)}
    return gap


def _measure_wire_ms(sent: np.ndarray, queries: list[Row]) -> list[float] | None:
    """Return the delay from a picture to its fix on the wire in ms: median and 99th percentile; None without fixes."""
    sent_s = sent["t_s"][sent["kind"] == "COMMAND_INT"]
    delays_ms = [
        1e3 * float(time_s - line["t_frame_s"])
        for line in queries
        for time_s in sent_s[(sent_s > line["t_frame_s"]) & (sent_s <= line["t_mono_s"])]
    ]
    return [round(float(time_s), 1) for time_s in np.quantile(delays_ms, (0.5, 0.99))] if delays_ms else None
