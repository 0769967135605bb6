"""The page of the rig's runs: tables of flights with and without edgevpr, and pictures of their tracks and errors."""

import json
from collections.abc import Iterator
from pathlib import Path

import base
import cv2
import ground
import numpy as np
import px4
from base import RESULTS, Row
from figures import compare_estimates, compute_run_figures, max_per_second, read_table
from scenarios import SCENARIOS, parse_flight_name
from simulator import VEHICLES

from edgevpr.runtime.flight.flightlog import read_log

_PIXELS_PER_M = 0.3  # of the ground in the picture of tracks
# Suffix of a run's folder, colour of its estimate, line style of its true track, and its label.
_RUN_STYLES = (("-control", "#ff3030", ":", "without"), ("", "#20e020", "-", "with"))
_JPEG_OPTIONS = {"quality": 30, "optimize": True}
_ESTIMATES = {
    "flight": "{name}",
    "edgevpr": "{which}",
    "s": "{seconds}",
    "median": "{estimate[after][median]:.1f}",
    "90 %": "{estimate[after][p90]:.1f}",
    "max": "{estimate[after][max]:.1f}",
    **{f"+{after} s": "{estimate[at_s][%s]:.1f}".replace("%s", f"at{after}") for after in (10, 30, 60, 300)},
    "worse": "{worse_by_m[0]} at {worse_by_m[1]} s",
    "modes": "{mode_names}",
}
_FIXES = {
    "flight": "{name}",
    "queries": "{queries}",
    "accepted": "{accepted}",
    "answers": "{answer_counts}",
    "median": "{fixes[error][median]:.1f}",
    "90 %": "{fixes[error][p90]:.1f}",
    "max": "{fixes[error][max]:.1f}",
    "roll < 6": "{fixes[by_roll_deg][0-6][median]:.1f}",
    "6 to 20": "{fixes[by_roll_deg][6-20][median]:.1f}",
    "> 20": "{fixes[by_roll_deg][20-90][median]:.1f}",
    "claimed m": "{fixes[claimed_m]:.1f}",
    "within 1, 2 sigma": "{fixes[within][0]:.2f} / {fixes[within][1]:.2f}",
    "query ms": "{query_ms[0]} / {query_ms[1]}",
}
_SENT = {
    "flight": "{name}",
    "message": "{kind}",
    "Hz": "{rate_hz}",
    "median": "{error[median]:.1f}",
    "90 %": "{error[p90]:.1f}",
    "max": "{error[max]:.1f}",
    "claimed m": "{claimed_m:.1f}",
    "within 1, 2 sigma": "{within[0]:.2f} / {within[1]:.2f}",
    "picture to wire": "{wire_ms[0]:.0f} / {wire_ms[1]:.0f} ms",
}


def write_page(work: Path) -> None:
    """Write rig.json, rig.md and its pictures from the newest runs; keep the figures of runs without a folder."""
    names_flown = sorted(folder.name for folder in (work / "runs").iterdir() if "-" not in folder.name)
    new = {name: runs for name in names_flown if (runs := _compute_runs(work / "runs", name))}
    old, order = base.read("rig").get("scenarios", {}), [*SCENARIOS]
    names = [name for name in {*old, *new} if parse_flight_name(name)[0] in order]
    names.sort(key=lambda name: (order.index(parse_flight_name(name)[0]), name))
    result = {**base.describe_run(), "scenarios": {name: old.get(name, {}) | new.get(name, {}) for name in names}}
    base.write("rig", result, format_page(result))
    _draw_tracks(work, list(new), RESULTS / "rig.jpg")
    draw_claims([work / "runs" / name for name, runs in new.items() if "with" in runs], RESULTS / "rig-claims.jpg")


def _compute_runs(runs: Path, name: str) -> dict[str, Row]:
    """Return the figures of the complete runs of a flight: `with` edgevpr and `without`."""
    folders = {"with": runs / name, "without": runs / f"{name}-control"}
    figures = {which: compute_run_figures(folder) for which, folder in folders.items() if _is_complete(folder)}
    if len(figures) == 2:
        errors_m = (max_per_second(*_read_track(folder)) for folder in folders.values())
        figures["with"]["worse_by_m"] = compare_estimates(*errors_m)
    return figures


def _is_complete(folder: Path) -> bool:
    return (folder / "run.json").exists()  # written at the end of a run


def _read_track(folder: Path) -> tuple[np.ndarray, float]:
    """Return the track of a run and the time at which GPS was lost."""
    loss_s = json.loads((folder / "run.json").read_text())["marks_s"]["loss"]
    return read_table(folder / "track.csv"), loss_s


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    scenarios, machine = result["scenarios"], result["machine"]
    return f"""# Flights with a real ArduPilot

A real ArduPilot (4.7-dev, commit 90700977) or PX4 (px4_...) flies in its own simulator, 100 m above ground generated
by edgevpr. The map was made on another day, from pictures every 30 m. A camera fixed to the airframe is rendered from
the true pose, and edgevpr runs as a process between the camera and the autopilot. Then GPS is switched off. Each flight
is made with and without edgevpr. The scenarios are in benchmarks/rig/scenarios.py.

Error of the autopilot's estimate after the loss of GPS, in metres: median, 90th percentile, maximum, and after some
seconds. Worse: the largest excess over the error of the flight without edgevpr, and its second.

{base.format_table(_yield_rows(scenarios), _ESTIMATES)}

{_format_ranges(scenarios)}

Errors of edgevpr's fixes relative to the true position of their picture, also by roll angle, and the share of errors,
axis by axis, within one and two sigma of the claimed accuracy (ideal: 0.68, 0.95). Query: time from the picture to the
answer, median and 99th percentile.

{base.format_table([run for run in _yield_rows(scenarios, "with") if "fixes" in run], _FIXES)}

Errors of the positions sent to the autopilot after the loss, relative to the true position at their time:

{base.format_table(_yield_sent_rows(scenarios), _SENT)}

{_format_remarks(scenarios)}

Flown with edgevpr at {_format_commits(scenarios)}; {result["date"]}, {machine["cpu"]}. `make rig` makes this page.

![tracks](rig.jpg)

White: true track after the loss of GPS. Green: track estimated by the autopilot with edgevpr. Red: track estimated by
the autopilot in another flight without edgevpr; the true track of that flight is dotted.

![claims](rig-claims.jpg)

Metres over seconds after the loss. Blue: error of the autopilot's estimate. Dots: error of each position when it was
sent. Grey: twice its claimed accuracy. Below, green and red: accepted and rejected queries.
"""


def _format_commits(scenarios: dict[str, dict[str, Row]]) -> str:
    """Return the commits that flew with edgevpr, each with the names of its flights."""
    groups = base.group_rows(_yield_rows(scenarios, "with"), lambda run: run["commit"] or "an unrecorded commit")
    return "; ".join(f"{commit} ({', '.join(run['name'] for run in runs)})" for commit, runs in groups)


def _yield_rows(scenarios: dict[str, dict[str, Row]], only: str | None = None) -> Iterator[Row]:
    """Yield all runs (or `only` those "with" or "without"), with texts of their modes and answers for the tables."""
    for name, runs in scenarios.items():
        scenario = SCENARIOS[parse_flight_name(name)[0]]
        modes = px4.MODES if scenario.is_px4 else VEHICLES[scenario.vehicle].modes
        names = {number: mode for mode, number in modes.items()}
        for which, run in runs.items():
            if only in (None, which):
                modes = (names.get(m, str(m)) + (f" at {t_s:.0f} s" if t_s > 1 else "") for t_s, m in run["modes"])
                answers = ", ".join(f"{count} {answer}" for answer, count in run.get("answers", {}).items()) or "-"
                at_s = {f"at{after}": error_m for after, error_m in run["estimate"]["at_s"].items()}
                texts = {"mode_names": ", ".join(modes), "answer_counts": answers}
                estimate, seconds = {**run["estimate"], "at_s": at_s}, run["estimate"]["after"]["n"] // 10
                yield {**run, "name": name, "which": which, "estimate": estimate, **texts, "seconds": seconds}


def _yield_sent_rows(scenarios: dict[str, dict[str, Row]]) -> Iterator[Row]:
    for run in _yield_rows(scenarios, "with"):
        for kind, figures in run.get("sent", {}).items():
            yield {**figures, "name": run["name"], "kind": kind, "wire_ms": run["wire_ms"]}


def _format_ranges(scenarios: dict[str, dict[str, Row]]) -> str:
    """Return a line for each scenario that was flown several times, with the range of its figures."""
    lines = []
    rows = _yield_rows(scenarios, "with")
    for scenario, runs in base.group_rows(rows, lambda run: parse_flight_name(run["name"])[0]):
        errors = [run["estimate"]["after"] for run in runs]
        if len(errors) > 1:
            ranges = ", ".join(
                f"{word} {min(run[key] for run in errors):.1f} to {max(run[key] for run in errors):.1f} m"
                for key, word in (("median", "median"), ("p90", "90 %"), ("max", "maximum"))
            )
            lines.append(f"* {scenario}, {len(errors)} flights: {ranges}.")
    return "\n".join(lines)


def _format_remarks(scenarios: dict[str, dict[str, Row]]) -> str:
    lines = []
    for run in _yield_rows(scenarios):
        name, which, remarks = run["name"], run["which"], []
        if run["alarms"]:
            remarks.append("; ".join(f"{text} ({t_s} s)" for t_s, text in run["alarms"][:4]))
        if (gap := run.get("gap")) and gap["s"] > 30 and gap["off_m"] is not None:
            remarks.append(
                f"{gap['s']:.0f} s and {gap['way_m']} m without a match; the position sent {gap['told_s']:.0f} s after "
                f"the last match was {gap['off_m']} m off"
            )
        if name in ("plane_glitch", "plane_clean") and which == "with":
            alarms_s = run["gps_alarms_s"]
            minutes = run["estimate"]["after"]["n"] / 600
            times = ", ".join(f"{alarm_s} s" for alarm_s in alarms_s)
            remarks.append(f"GPS alarms at {times}" if alarms_s else f"no GPS alarm in {minutes:.0f} min")
        if remarks:
            lines.append(f"* {name}, {which} edgevpr: {'; '.join(remarks)}.")
    return "\n".join(lines)


def draw_claims(folders: list[Path], path: Path) -> None:
    """Draw the errors of each run over time, with the claimed accuracy and the accepted and rejected queries."""
    rows = -(-len(folders) // 2)
    figure, axes = base.make_panels(12, 3.0 * rows, len(folders), rows)
    for axis, folder in zip(axes, folders, strict=True):
        (track, loss_s), sent = _read_track(folder), read_table(folder / "sent.csv")
        track, sent = track[track["t_s"] >= loss_s], sent[sent["t_s"] >= loss_s]
        error_m = np.hypot(sent["east_m"] - sent["true_east_m"], sent["north_m"] - sent["true_north_m"])
        axis.fill_between(sent["t_s"] - loss_s, 0, 2 * sent["accuracy_m"], color="0.85", step="mid")
        axis.plot(track["t_s"] - loss_s, track["error_m"], color="#3060ff", lw=0.9)
        axis.plot(sent["t_s"] - loss_s, error_m, ".", color="black", ms=2)
        top_m = max(10.0, 1.3 * float(np.max(track["error_m"], initial=0)))
        queries = [line for line in read_log(folder / "flight.jsonl") if line["kind"] == "query"]
        for is_accepted, colour in ((True, "#20a020"), (False, "#ff3030")):
            times_s = np.array([q["t_frame_s"] - loss_s for q in queries if q["accepted"] == is_accepted])
            axis.plot(times_s, np.full(len(times_s), -0.04 * top_m), "|", color=colour, ms=4)
        axis.set(xlim=(0, None), ylim=(-0.08 * top_m, top_m))
        axis.set_title(folder.name, fontsize=9)
    figure.savefig(path, dpi=56, pil_kwargs=_JPEG_OPTIONS)


def _draw_tracks(work: Path, names: list[str], path: Path) -> None:
    """Draw the true and the estimated track of each run over the ground."""
    size = round(ground.WIDTH_M * _PIXELS_PER_M), round(ground.DEPTH_M * _PIXELS_PER_M)
    image = 0.6 * cv2.resize(ground.load_ground(work, "later"), size, interpolation=cv2.INTER_AREA)[..., ::-1] / 255
    rows = -(-len(names) // 2)
    figure, axes = base.make_panels(12, 4.6 * rows, len(names), rows)
    for axis, name in zip(axes, names, strict=True):
        axis.imshow(image, extent=(0, ground.WIDTH_M, 0, ground.DEPTH_M))
        titles = [name]
        for suffix, colour, style, word in _RUN_STYLES:
            if not _is_complete(work / "runs" / f"{name}{suffix}"):
                continue
            track, loss_s = _read_track(work / "runs" / f"{name}{suffix}")
            after = track[track["t_s"] >= loss_s]
            axis.plot(after["est_east_m"], after["est_north_m"], color=colour, lw=1.2)
            axis.plot(after["east_m"], after["north_m"], color="white", lw=0.9, ls=style)
            if len(after):
                titles.append(f"{word}: median {np.median(after['error_m']):.0f} m, max {after['error_m'].max():.0f} m")
        axis.set(xlim=(-80, ground.WIDTH_M + 80), ylim=(-80, ground.DEPTH_M + 80), facecolor="0.25")
        axis.set_title("; ".join(titles), fontsize=9)
        axis.grid(False)
    figure.savefig(path, dpi=48, pil_kwargs=_JPEG_OPTIONS)
