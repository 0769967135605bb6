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
from scenarios import SCENARIOS
from simulator import VEHICLES

_SHOWN_PER_M = 0.3  # pixels of the ground in the picture
_TRUE, _WITH, _WITHOUT = "white", "#20e020", "#ff3030"
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
    """Write rig.json, rig.md and rig.jpg of the newest run of each scenario."""
    found = {name: _runs(work / "runs", name) for name in SCENARIOS}
    result = {**base.made_by(), "scenarios": {name: runs for name, runs in found.items() if runs}}
    base.write("rig", result, page(result))
    _draw(work, list(result["scenarios"]), RESULTS / "rig.jpg")


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

edgevpr's fixes against the true position of their own picture, by how far the aircraft banked, and the share of errors,
axis by axis, within one and two sigma of the accuracy that was claimed (asked: .68 and .95). Query: from the picture to
the answer, median and 99 %.

{base.table([each for each in _rows(found, "with") if "fixes" in each], _FIXES)}

What was sent to the autopilot, after the loss, against the true position of the time that it was sent for:

{base.table(_sent(found), _SENT)}

{_remarks(found)}

Flown with edgevpr at {_commits(found)}; {result["date"]}, {result["machine"]["cpu"]}. `make rig` makes this page.

![tracks](rig.jpg)

White: where the aircraft was, from the loss of GPS on. Green: where its autopilot took it to be, with edgevpr. Red:
where it took it to be without edgevpr, in another flight, whose own true track is dotted.
"""


def _commits(found: dict[str, dict[str, Row]]) -> str:
    """Return the commits of the flights with edgevpr, and which flights are of each."""
    flown = base.groups(_rows(found, "with"), lambda run: run["commit"] or "an unnoted commit")
    return "; ".join(f"{commit} ({', '.join(run['name'] for run in runs)})" for commit, runs in flown)


def _rows(found: dict[str, dict[str, Row]], only: str | None = None) -> Iterator[Row]:
    """Yield the runs (`only` those with or without edgevpr), with words for their modes and answers."""
    for name, runs in found.items():
        scenario = SCENARIOS[name]
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


def _remarks(found: dict[str, dict[str, Row]]) -> str:
    lines = []
    for run in _rows(found):
        name, which, told = run["name"], run["which"], []
        if run["alarms"]:
            told.append("; ".join(f"{text} ({t_s} s)" for t_s, text in run["alarms"][:4]))
        if run.get("learnt"):
            learnt = run["learnt"]
            error = learnt["error"]
            told.append(
                f"{error['n']} places learnt, {error['median']} m off, at most {error['max']} m; "
                f"{learnt['after_the_loss']} of them without GPS"
            )
        if run.get("heard_again_s") is not None:
            told.append(f"heard again {run['heard_again_s']} s after the autopilot was back")
        if name in ("plane_glitch", "plane_clean") and which == "with":
            alarms_s = run["gps_alarms_s"]
            minutes = run["estimate"]["after"]["n"] / 600
            doubted = ", ".join(f"{each} s" for each in alarms_s)
            told.append(f"GPS was doubted at {doubted}" if alarms_s else f"GPS was not doubted in {minutes:.0f} min")
        if told:
            lines.append(f"* {name}, {which} edgevpr: {'; '.join(told)}.")
    return "\n".join(lines)


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
    drawn.savefig(path, dpi=70)
