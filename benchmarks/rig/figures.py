"""The figures of a run, from the files in its folder: the autopilot's estimate, edgevpr's fixes, what was answered."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.lab.simulate.camera import Camera, CameraPose, ground_to_pixel
from edgevpr.lab.simulate.generated import to_metres
from edgevpr.runtime.flight.flightlog import read_log

ROLL_DEG = ((0, 6), (6, 20), (20, 90))
AFTER_S = (10, 30, 60, 120, 180, 240, 300)
_TAKEN_WITHIN_S = 0.05  # a query belongs to the picture of its time
_ALARMS = ("failsafe", "variance", "stopped aiding", "crash", "emergency")

_POSE = ("east_m", "north_m", "height_m", "heading_deg", "roll_deg", "pitch_deg")

Row = dict[str, Any]


def spread(values: np.ndarray) -> Row:
    """Return number, median, 90 % and maximum of errors in metres."""
    if len(values) == 0:
        return {"n": 0}
    median, p90, largest = np.quantile(values, (0.5, 0.9, 1.0))
    found = {"median": median, "p90": p90, "max": largest}
    return {"n": len(values), **{name: round(float(value), 1) for name, value in found.items()}}


def read_table(path: Path) -> np.ndarray:
    """Return a file of comma-separated values, its columns by name."""
    return np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True))


def figures_of(folder: Path) -> Row:
    """Return the figures of the run in a folder."""
    run = json.loads((folder / "run.json").read_text())
    track, loss_s = read_table(folder / "track.csv"), run["marks_s"]["loss"]
    log = list(read_log(folder / "flight.jsonl")) if (folder / "flight.jsonl").exists() else []
    found: Row = {key: run.get(key) for key in ("commit", "scenario", "is_control", "rate_hz", "words", "edgevpr_exit")}
    found["estimate"] = _estimate(track, loss_s)
    found["modes"] = _modes(track, loss_s)
    found["alarms"] = [
        [round(t_s - loss_s, 1), text]
        for t_s, sender, text in run["texts"]
        if sender == 1 and any(word in text.lower() for word in _ALARMS)
    ]
    found["said"] = [[round(t_s - loss_s, 1), text] for t_s, sender, text in run["texts"] if sender != 1]
    if log:
        found["fixes"] = _fixes(_fix_rows(folder, log))
        found["sent"] = _sent(folder, loss_s)
        found["wire_ms"] = _wire_ms(folder, log)
        found["answers"] = dict(log[-1].get("mavlink", {}).get("acks", {}))
        queries = [line for line in log if line["kind"] == "query"]
        found["queries"] = len(queries)
        found["accepted"] = sum(line["accepted"] for line in queries)
        ages_s = np.array([line["t_mono_s"] - line["t_frame_s"] for line in queries])
        found["query_ms"] = [round(1e3 * float(each)) for each in np.quantile(ages_s, (0.5, 0.99))] if queries else None
        found["learnt"] = _learnt(folder, log, loss_s)
        found["gps_alarms_s"] = [
            round(line["t_mono_s"] - loss_s, 1) for line in log if line["kind"] == "gps" and line["is_wrong"]
        ]
    if "back" in run["marks_s"]:
        found["heard_again_s"] = round(run["marks_s"]["heard_again"] - run["marks_s"]["back"], 2)
    return found


def by_second(track: np.ndarray, loss_s: float) -> np.ndarray:
    """Return the largest error of the estimate in each second after the loss; NaN where there is no line."""
    seconds = np.floor(track["t_s"] - loss_s).astype(int)
    last = int(seconds.max(initial=-1))
    return np.array([track["error_m"][seconds == second].max(initial=-math.inf) for second in range(last + 1)])


def worse_by(with_edgevpr: np.ndarray, without: np.ndarray) -> tuple[float, int] | None:
    """Return by how many metres, at the worst second after the loss, the estimate is worse than in the flight without
    edgevpr, and that second."""
    length = min(len(with_edgevpr), len(without))
    if length == 0:
        return None
    beyond_m = with_edgevpr[:length] - without[:length]
    return round(float(beyond_m.max()), 1), int(beyond_m.argmax())


def _estimate(track: np.ndarray, loss_s: float) -> Row:
    after_s, error_m = track["t_s"] - loss_s, track["error_m"]
    over_s = after_s[-1] + 0.5
    at = {str(each): round(float(np.interp(each, after_s, error_m)), 1) for each in AFTER_S if each <= over_s}
    after = error_m[after_s >= 0]
    return {"before": spread(error_m[after_s < 0]), "after": spread(after), "at_s": at}


def _modes(track: np.ndarray, loss_s: float) -> list[list[float]]:
    """Return [seconds after the loss, number of the mode], at the loss and at each change after it."""
    after = track[track["t_s"] >= loss_s]
    changes = [0, *(np.flatnonzero(np.diff(after["mode"])) + 1)] if len(after) else []
    return [[round(float(after["t_s"][each] - loss_s), 1), int(after["mode"][each])] for each in changes]


def _fix_rows(folder: Path, log: list[Row]) -> list[Row]:
    """Return every accepted match with its error east and north, against the true place of its own picture."""
    pictures, rows = read_table(folder / "pictures.csv"), []
    for line in log:
        if line["kind"] != "query" or not line["accepted"] or not line["located"]:
            continue
        of = pictures[np.argmin(abs(pictures["t_s"] - line["t_frame_s"]))]
        if abs(of["t_s"] - line["t_frame_s"]) > _TAKEN_WITHIN_S:
            continue
        east_m, north_m = to_metres(line["located"]["lat_deg"], line["located"]["lon_deg"])
        var_east_m2, _, var_north_m2 = line["located"]["covariance_m2"]
        rows.append(
            {
                "east_m": east_m - of["east_m"],
                "north_m": north_m - of["north_m"],
                "roll_deg": abs(of["roll_deg"]),
                "claimed_m": line["accuracy_m"],
                "sd_m": (math.sqrt(var_east_m2), math.sqrt(var_north_m2)),
            }
        )
    return rows


def _fixes(rows: list[Row]) -> Row:
    if not rows:
        return {"error": spread(np.array([]))}
    off_m = np.array([(row["east_m"], row["north_m"]) for row in rows])
    roll_deg, claimed_m = (np.array([row[key] for row in rows]) for key in ("roll_deg", "claimed_m"))
    error_m, sd_m = np.hypot(*off_m.T), np.array([row["sd_m"] for row in rows])
    by_roll = {f"{low}-{high}": spread(error_m[(roll_deg >= low) & (roll_deg < high)]) for low, high in ROLL_DEG}
    return {
        "error": spread(error_m),
        "by_roll_deg": by_roll,
        "claimed_m": round(float(np.median(claimed_m)), 2),
        "within": _within(abs(off_m) / claimed_m[:, None]),
        "within_covariance": _within(abs(off_m) / sd_m),
    }


def _within(sigmas: np.ndarray) -> list[float]:
    """Return the shares of errors, axis by axis, within one and two standard deviations."""
    return [round(float((sigmas <= limit).mean()), 2) for limit in (1, 2)]


def _sent(folder: Path, loss_s: float) -> Row:
    """Return, by the name of the message, how well the positions that were sent after the loss are met by the true
    ones of their times."""
    sent, found = _sent_table(folder), {}
    for kind in np.unique(sent["kind"]):
        is_of = (sent["kind"] == kind) & (sent["t_s"] >= loss_s)
        if is_of.sum() < 2:
            continue
        rows = {name: column[is_of] for name, column in sent.items()}
        off_m = np.stack((rows["east_m"] - rows["true_east_m"], rows["north_m"] - rows["true_north_m"]), axis=1)
        found[str(kind)] = {
            "rate_hz": round(len(off_m) / float(np.ptp(rows["t_s"])), 1),
            "error": spread(np.hypot(*off_m.T)),
            "claimed_m": round(float(np.median(rows["accuracy_m"])), 2),
            "within": _within(abs(off_m) / np.maximum(rows["accuracy_m"], 1e-3)[:, None]),
        }
    return found


def _wire_ms(folder: Path, log: list[Row]) -> list[float] | None:
    """Return how long it takes from a picture to the bytes of its fix on the wire, median and 99 %."""
    sent = _sent_table(folder)
    sent_s = sent["t_s"][sent["kind"] == "COMMAND_INT"]
    queries = [(line["t_frame_s"], line["t_mono_s"]) for line in log if line["kind"] == "query"]
    took_ms = [
        1e3 * float(each - taken_s)
        for taken_s, logged_s in queries
        for each in sent_s[(sent_s > taken_s) & (sent_s <= logged_s)]
    ]
    return [round(float(each), 1) for each in np.quantile(took_ms, (0.5, 0.99))] if took_ms else None


def _sent_table(folder: Path) -> dict[str, np.ndarray]:
    with open(folder / "sent.csv", encoding="utf-8", newline="") as handle:
        lines = list(csv.DictReader(handle))
    columns = ("t_s", "east_m", "north_m", "accuracy_m", "true_east_m", "true_north_m")
    numbers = {name: np.array([float(line[name]) for line in lines]) for name in columns}
    return {"kind": np.array([line["kind"] for line in lines], str), **numbers}


def _learnt(folder: Path, log: list[Row], loss_s: float) -> Row | None:
    """Return the errors of the places learnt in flight, against the ground in the middle of their pictures, and how
    many were learnt after the loss."""
    taken_s = {line["query"]: line["t_frame_s"] for line in log if line["kind"] == "query"}
    places = [line for line in log if line["kind"] == "learnt" and line["query"] in taken_s]
    if not places:
        return None
    pictures, errors_m, after = read_table(folder / "pictures.csv"), [], 0
    for line in places:
        at_s = taken_s[line["query"]]
        seen_east_m, seen_north_m = _looked_at(pictures[np.argmin(abs(pictures["t_s"] - at_s))])
        east_m, north_m = to_metres(line["position"]["lat_deg"], line["position"]["lon_deg"])
        errors_m.append(math.hypot(east_m - seen_east_m, north_m - seen_north_m))
        after += at_s > loss_s
    return {"error": spread(np.array(errors_m)), "after_the_loss": after}


def _looked_at(picture: np.void) -> np.ndarray:
    """Return the point of the ground, east and north, in the middle of a picture."""
    camera = Camera()
    pose = CameraPose(**{name: float(picture[name]) for name in _POSE})
    middle = (camera.width - 1) / 2, (camera.height - 1) / 2, 1.0
    east, north, scale = np.linalg.solve(ground_to_pixel(pose, camera), middle)
    return np.array((east, north)) / scale
