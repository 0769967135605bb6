"""The page of the rig's runs: a table of flights with and without edgevpr, and both tracks over the ground."""

import json
from collections.abc import Iterator
from pathlib import Path

import base
import cv2
import ground
import numpy as np
import px4
from base import RESULTS, Row
from figures import by_second, figures_of, read_table, worse_by
from scenarios import SCENARIOS, scenario_of
from simulator import VEHICLES

from edgevpr.runtime.flight.flightlog import read_log

_SHOWN_PER_M = 0.3  # pixels of the ground in the picture
_TRUE, _WITH, _WITHOUT = "white", "#20e020", "#ff3030"
_FEW_BYTES = {"quality": 30, "optimize": True}
_ESTIMATES = {
    "flight": "{name}",
    "edgevpr": "{which}",
    "s": "{seconds}",
    "median": "{estimate[after][median]:.1f}",
    "90 %": "{estimate[after][p90]:.1f}",
    "max": "{estimate[after][max]:.1f}",
    **{f"+{after} s": "{estimate[at_s][%s]:.1f}".replace("%s", f"at{after}") for after in (10, 30, 60, 300)},
    "worse": "{worse_by_m[0]} at {worse_by_m[1]} s",
    "modes": "{words}",
}
_FIXES = {
    "flight": "{name}",
    "queries": "{queries}",
    "accepted": "{accepted}",
    "answers": "{told}",
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
    "a second": "{rate_hz}",
    "median": "{error[median]:.1f}",
    "90 %": "{error[p90]:.1f}",
    "max": "{error[max]:.1f}",
    "claimed m": "{claimed_m:.1f}",
    "within 1, 2 sigma": "{within[0]:.2f} / {within[1]:.2f}",
    "picture to wire": "{wire_ms[0]:.0f} / {wire_ms[1]:.0f} ms",
}


def write_page(work: Path) -> None:
    """Write rig.json, rig.md and rig.jpg of the newest run of each scenario; figures of earlier runs without a folder
    stay as they were."""
    flown = sorted(folder.name for folder in (work / "runs").iterdir() if "-" not in folder.name)
    new = {name: runs for name in flown if (runs := _runs(work / "runs", name))}
    kept, order = base.read("rig").get("scenarios", {}), [*SCENARIOS]
    names = [name for name in {*kept, *new} if scenario_of(name)[0] in order]
    names.sort(key=lambda name: (order.index(scenario_of(name)[0]), name))
    result = {**base.made_by(), "scenarios": {name: kept.get(name, {}) | new.get(name, {}) for name in names}}
    base.write("rig", result, page(result))
    _draw(work, list(new), RESULTS / "rig.jpg")
    draw_claims([work / "runs" / name for name, runs in new.items() if "with" in runs], RESULTS / "rig-claims.jpg")


def _runs(runs: Path, name: str) -> dict[str, Row]:
    """Return the figures of a scenario's runs: `with` edgevpr, and `without`."""
    folders = {"with": runs / name, "without": runs / f"{name}-control"}
    found = {which: figures_of(folder) for which, folder in folders.items() if _is_whole(folder)}
    if len(found) == 2:
        found["with"]["worse_by_m"] = worse_by(*(by_second(*_track(folder)) for folder in folders.values()))
    return found


def _is_whole(folder: Path) -> bool:
    return (folder / "run.json").exists()  # written at the end of a run


def _track(folder: Path) -> tuple[np.ndarray, float]:
    """Return the track of a run, and when GPS was lost."""
    loss_s = json.loads((folder / "run.json").read_text())["marks_s"]["loss"]
    return read_table(folder / "track.csv"), loss_s


def page(result: Row) -> str:
    """Return the page for people."""
    found = result["scenarios"]
    return f"""# Flights with a real ArduPilot

A real ArduPilot (4.7-dev, commit 90700977) or PX4 (px4_...) flies in its own simulator, 100 m above ground that edgevpr
generates; the map was made on another day, from pictures every 30 m. A camera is rendered from the true pose, fixed to
the airframe, and edgevpr runs as a process between it and the autopilot. Then GPS is taken away. Each flight is made
with and without edgevpr. The scenarios are in benchmarks/rig/scenarios.py.

The autopilot's estimate against the true position, metres, from the loss on: median, 90 %, largest, and so many seconds
after the loss. Worse: the second at which the estimate was worst in comparison with the flight without edgevpr.

{base.table(_rows(found), _ESTIMATES)}

{_spread(found)}

edgevpr's fixes against the true position of their own picture, by how far the aircraft banked, and the share of errors,
axis by axis, within one and two sigma of the accuracy that was claimed (asked 0.68, 0.95). Query: from the picture to
the answer, median and 99 %.

{base.table([each for each in _rows(found, "with") if "fixes" in each], _FIXES)}

What was sent to the autopilot, after the loss, against the true position of the time that it was sent for:

{base.table(_sent(found), _SENT)}

{_remarks(found)}

Flown with edgevpr at {_commits(found)}; {result["date"]}, {result["machine"]["cpu"]}. `make rig` makes this page.

![tracks](rig.jpg)

White: where the aircraft was, from the loss of GPS on. Green: where its autopilot took it to be, with edgevpr. Red:
where it took it to be without edgevpr, in another flight, whose own true track is dotted.

![claims](rig-claims.jpg)

Metres over the seconds after the loss. Blue: the error of the autopilot's estimate. Dots: of each position when it was
sent. Grey: twice the accuracy that was claimed with it. Below, green and red: queries accepted and refused.
"""


def _commits(found: dict[str, dict[str, Row]]) -> str:
    """Return the commits of the flights with edgevpr, and which flights are of each."""
    flown = base.groups(_rows(found, "with"), lambda run: run["commit"] or "an unnoted commit")
    return "; ".join(f"{commit} ({', '.join(run['name'] for run in runs)})" for commit, runs in flown)


def _rows(found: dict[str, dict[str, Row]], only: str | None = None) -> Iterator[Row]:
    """Yield the runs (`only` those with or without edgevpr), with words for their modes and answers."""
    for name, runs in found.items():
        scenario = SCENARIOS[scenario_of(name)[0]]
        modes = px4.MODES if scenario.is_px4 else VEHICLES[scenario.vehicle].modes
        names = {number: word for word, number in modes.items()}
        for which, run in runs.items():
            if only in (None, which):
                modes = (names.get(m, str(m)) + (f" at {t_s:.0f} s" if t_s > 1 else "") for t_s, m in run["modes"])
                answers = ", ".join(f"{count} {answer}" for answer, count in run.get("answers", {}).items()) or "-"
                at_s = {f"at{after}": error_m for after, error_m in run["estimate"]["at_s"].items()}
                estimate, told = {**run["estimate"], "at_s": at_s}, {"words": ", ".join(modes), "told": answers}
                seconds = {"seconds": run["estimate"]["after"]["n"] // 10}
                yield {**run, "name": name, "which": which, "estimate": estimate, **told, **seconds}


def _sent(found: dict[str, dict[str, Row]]) -> Iterator[Row]:
    for run in _rows(found, "with"):
        for kind, each in run.get("sent", {}).items():
            yield {**each, "name": run["name"], "kind": kind, "wire_ms": run["wire_ms"]}


def _spread(found: dict[str, dict[str, Row]]) -> str:
    """Return a line for each scenario that was flown several times: the least and the largest of its figures."""
    lines = []
    for scenario, runs in base.groups(_rows(found, "with"), lambda run: scenario_of(run["name"])[0]):
        each = [run["estimate"]["after"] for run in runs]
        if len(each) > 1:
            told = ", ".join(
                f"{word} {min(run[key] for run in each):.1f} to {max(run[key] for run in each):.1f} m"
                for key, word in (("median", "median"), ("p90", "90 %"), ("max", "largest"))
            )
            lines.append(f"* {scenario}, {len(each)} flights: {told}.")
    return "\n".join(lines)


def _remarks(found: dict[str, dict[str, Row]]) -> str:
    lines = []
    for run in _rows(found):
        name, which, told = run["name"], run["which"], []
        if run["alarms"]:
            told.append("; ".join(f"{text} ({t_s} s)" for t_s, text in run["alarms"][:4]))
        if (gap := run.get("gap")) and gap["s"] > 30 and gap["off_m"] is not None:
            told.append(
                f"{gap['s']:.0f} s and {gap['way_m']} m without a match; what was sent {gap['told_s']:.0f} s after the "
                f"last one was {gap['off_m']} m off"
            )
        if name in ("plane_glitch", "plane_clean") and which == "with":
            alarms_s = run["gps_alarms_s"]
            minutes = run["estimate"]["after"]["n"] / 600
            doubted = ", ".join(f"{each} s" for each in alarms_s)
            told.append(f"GPS was doubted at {doubted}" if alarms_s else f"GPS was not doubted in {minutes:.0f} min")
        if told:
            lines.append(f"* {name}, {which} edgevpr: {'; '.join(told)}.")
    return "\n".join(lines)


def draw_claims(folders: list[Path], path: Path) -> None:
    """Draw the errors of each run over time, beside what was claimed, and which queries were accepted."""
    rows = -(-len(folders) // 2)
    drawn, axes = base.panels(12, 3.0 * rows, len(folders), rows)
    for axis, folder in zip(axes, folders, strict=True):
        (track, loss_s), sent = _track(folder), read_table(folder / "sent.csv")
        track, sent = track[track["t_s"] >= loss_s], sent[sent["t_s"] >= loss_s]
        off_m = np.hypot(sent["east_m"] - sent["true_east_m"], sent["north_m"] - sent["true_north_m"])
        axis.fill_between(sent["t_s"] - loss_s, 0, 2 * sent["accuracy_m"], color="0.85", step="mid")
        axis.plot(track["t_s"] - loss_s, track["error_m"], color="#3060ff", lw=0.9)
        axis.plot(sent["t_s"] - loss_s, off_m, ".", color="black", ms=2)
        top_m = max(10.0, 1.3 * float(np.max(track["error_m"], initial=0)))
        queries = [line for line in read_log(folder / "flight.jsonl") if line["kind"] == "query"]
        for is_accepted, colour in ((True, "#20a020"), (False, "#ff3030")):
            at_s = np.array([q["t_frame_s"] - loss_s for q in queries if q["accepted"] == is_accepted])
            axis.plot(at_s, np.full(len(at_s), -0.04 * top_m), "|", color=colour, ms=4)
        axis.set(xlim=(0, None), ylim=(-0.08 * top_m, top_m))
        axis.set_title(folder.name, fontsize=9)
    drawn.savefig(path, dpi=56, pil_kwargs=_FEW_BYTES)


def _draw(work: Path, names: list[str], path: Path) -> None:
    """Draw both tracks of each scenario over the ground."""
    size = round(ground.WIDTH_M * _SHOWN_PER_M), round(ground.DEPTH_M * _SHOWN_PER_M)
    shown = 0.6 * cv2.resize(ground.lit_ground(work, "later"), size, interpolation=cv2.INTER_AREA)[..., ::-1] / 255
    rows = -(-len(names) // 2)
    drawn, axes = base.panels(12, 4.6 * rows, len(names), rows)
    for axis, name in zip(axes, names, strict=True):
        axis.imshow(shown, extent=(0, ground.WIDTH_M, 0, ground.DEPTH_M))
        titles = [name]
        for end, colour, style, word in (("-control", _WITHOUT, ":", "without"), ("", _WITH, "-", "with")):
            if not _is_whole(work / "runs" / f"{name}{end}"):
                continue
            track, loss_s = _track(work / "runs" / f"{name}{end}")
            after = track[track["t_s"] >= loss_s]
            axis.plot(after["est_east_m"], after["est_north_m"], color=colour, lw=1.2)
            axis.plot(after["east_m"], after["north_m"], color=_TRUE, lw=0.9, ls=style)
            if len(after):
                titles.append(f"{word}: median {np.median(after['error_m']):.0f} m, max {after['error_m'].max():.0f} m")
        axis.set(xlim=(-80, ground.WIDTH_M + 80), ylim=(-80, ground.DEPTH_M + 80), facecolor="0.25")
        axis.set_title("; ".join(titles), fontsize=9)
        axis.grid(False)
    drawn.savefig(path, dpi=48, pil_kwargs=_FEW_BYTES)
