"""The page of the rig's runs: a table of flights with and without edgevpr, and both tracks over the ground."""

import json
from pathlib import Path
from typing import Any

import cv2
import ground
import numpy as np
from figures import by_second, figures_of, read_table, worse_by
from run_sets import made_by
from scenarios import SCENARIOS
from simulator import VEHICLES

from edgevpr.core.text import markdown

RESULTS = Path(__file__).resolve().parents[1] / "results"
_SHOWN_PER_M = 0.4  # pixels of the ground in the picture
_TRUE, _WITH, _WITHOUT = "white", "#20e020", "#ff3030"

Row = dict[str, Any]


def write_page(work: Path) -> None:
    """Write rig.json, rig.md and rig.png of the newest run of each scenario."""
    found = {name: _runs(work / "runs", name) for name in SCENARIOS}
    found = {name: runs for name, runs in found.items() if runs}
    result = {**made_by(), "scenarios": found}
    (RESULTS / "rig.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / "rig.md").write_text(_page(result))
    _draw(work, list(found), RESULTS / "rig.png")
    print(_page(result))


def _runs(runs: Path, name: str) -> dict[str, Row]:
    """Return the figures of a scenario's runs: `with` edgevpr, and `without`."""
    folders = {"with": runs / name, "without": runs / f"{name}-control"}
    found = {which: figures_of(folder) for which, folder in folders.items() if _is_whole(folder)}
    if len(found) == 2:
        found["with"]["worse_by_m"] = worse_by(*(_seconds(folder) for folder in folders.values()))
    return found


def _is_whole(folder: Path) -> bool:
    return (folder / "run.json").exists()  # written at the end of a run


def _seconds(folder: Path) -> np.ndarray:
    run = json.loads((folder / "run.json").read_text())
    return by_second(read_table(folder / "track.csv"), run["marks_s"]["loss"])


def _page(result: Row) -> str:
    found = result["scenarios"]
    return f"""# Flights with a real ArduPilot

A real ArduPilot (4.7-dev, commit 90700977) flies in its own simulator, 100 m above ground that edgevpr generates; the
map was made on another day, from pictures every 30 m. A camera is rendered from the true pose, fixed to the airframe,
and edgevpr runs as a process between it and the autopilot. Then GPS is taken away. Each flight is made with and without
edgevpr. The scenarios are in benchmarks/rig/scenarios.py.

The autopilot's estimate against the true position, metres, from the loss on: median, 90 %, largest, and so many seconds
after the loss. Worse: the second at which the estimate was worst in comparison with the flight without edgevpr.

{_estimates(found)}

edgevpr's fixes against the true position of their own picture, by how far the aircraft banked, and the share of errors,
axis by axis, within one and two sigma of the accuracy that was claimed (asked: .68 and .95). Query: from the picture to
the answer, median and 99 %.

{_fixes(found)}

What was sent to the autopilot, after the loss, against the true position of the time that it was sent for:

{_sent(found)}

{_remarks(found)}

Flown with edgevpr at {_commits(found)}; {result["date"]}, {result["machine"]["cpu"]}. `make rig` makes this page.

![tracks](rig.png)

White: where the aircraft was, from the loss of GPS on. Green: where its autopilot took it to be, with edgevpr. Red:
where it took it to be without edgevpr, in another flight, whose own true track is dotted.
"""


def _commits(found: dict[str, dict[str, Row]]) -> str:
    """Return the commits of the flights with edgevpr, and which flights are of each."""
    flown: dict[str, list[str]] = {}
    for name, runs in found.items():
        if "with" in runs:
            flown.setdefault(runs["with"]["commit"] or "an unnoted commit", []).append(name)
    return "; ".join(f"{commit} ({', '.join(names)})" for commit, names in flown.items())


def _estimates(found: dict[str, dict[str, Row]]) -> str:
    head = ("flight", "edgevpr", "s", "median", "90 %", "max", "+10 s", "+30 s", "+60 s", "+300 s", "worse", "modes")
    table = []
    for name, runs in found.items():
        for which, run in runs.items():
            after, at = run["estimate"]["after"], run["estimate"]["at_s"]
            worse = run.get("worse_by_m")
            table.append(
                [
                    name,
                    which,
                    str(after["n"] // 10),
                    *(_number(after.get(key)) for key in ("median", "p90", "max")),
                    *(_number(at.get(key)) for key in ("10", "30", "60", "300")),
                    f"{worse[0]} at {worse[1]} s" if worse else "-",
                    _modes(name, run),
                ]
            )
    return markdown(head, table)


def _modes(name: str, run: Row) -> str:
    names = {number: word for word, number in VEHICLES[SCENARIOS[name].vehicle].modes.items()}
    told = [names.get(mode, str(mode)) + (f" at {t_s:.0f} s" if t_s > 1 else "") for t_s, mode in run["modes"]]
    return ", ".join(told)


def _fixes(found: dict[str, dict[str, Row]]) -> str:
    head = ("flight", "queries", "accepted", "answers", "median", "90 %", "max", "roll < 6", "6 to 20", "> 20",
            "claimed m", "within 1, 2 sigma", "query ms")  # fmt: skip
    table = []
    for name, runs in found.items():
        run = runs.get("with", {})
        if "fixes" not in run:
            continue
        fixes, error = run["fixes"], run["fixes"]["error"]
        by_roll = [each.get("median") for each in fixes.get("by_roll_deg", {}).values()] or [None] * 3
        table.append(
            [
                name,
                str(run["queries"]),
                str(run["accepted"]),
                ", ".join(f"{count} {answer}" for answer, count in run["answers"].items()) or "-",
                *(_number(error.get(key)) for key in ("median", "p90", "max")),
                *(_number(each) for each in by_roll),
                _number(fixes.get("claimed_m")),
                "{:.2f} / {:.2f}".format(*fixes["within"]) if "within" in fixes else "-",
                " / ".join(str(each) for each in run["query_ms"]) if run["query_ms"] else "-",
            ]
        )
    return markdown(head, table)


def _sent(found: dict[str, dict[str, Row]]) -> str:
    head = (
        "flight",
        "message",
        "a second",
        "median",
        "90 %",
        "max",
        "claimed m",
        "within 1, 2 sigma",
        "picture to wire",
    )
    table = []
    for name, runs in found.items():
        run = runs.get("with", {})
        for kind, each in run.get("sent", {}).items():
            table.append(
                [
                    name,
                    kind,
                    str(each["rate_hz"]),
                    *(_number(each["error"].get(key)) for key in ("median", "p90", "max")),
                    _number(each["claimed_m"]),
                    "{:.2f} / {:.2f}".format(*each["within"]),
                    "{:.0f} / {:.0f} ms".format(*run["wire_ms"]) if run["wire_ms"] else "-",
                ]
            )
    return markdown(head, table)


def _remarks(found: dict[str, dict[str, Row]]) -> str:
    lines = []
    for name, runs in found.items():
        for which, run in runs.items():
            told = []
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
                told.append(
                    f"GPS was doubted at {doubted}" if alarms_s else f"GPS was not doubted in {minutes:.0f} min"
                )
            if told:
                lines.append(f"* {name}, {which} edgevpr: {'; '.join(told)}.")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _draw(work: Path, names: list[str], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lit = ground.lit_ground(work, "later")
    size = round(ground.WIDTH_M * _SHOWN_PER_M), round(ground.DEPTH_M * _SHOWN_PER_M)
    shown = 0.6 * cv2.resize(lit, size, interpolation=cv2.INTER_AREA)[..., ::-1] / 255
    rows = -(-len(names) // 2)
    figure, axes = pyplot.subplots(rows, 2, figsize=(14, 5.4 * rows), squeeze=False)
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    for axis, name in zip(axes.flat, names, strict=False):
        axis.imshow(shown, extent=(0, ground.WIDTH_M, 0, ground.DEPTH_M))
        titles = [name]
        for folder, colour, style, word in (
            (work / "runs" / f"{name}-control", _WITHOUT, ":", "without"),
            (work / "runs" / name, _WITH, "-", "with"),
        ):
            if not _is_whole(folder):
                continue
            loss_s = json.loads((folder / "run.json").read_text())["marks_s"]["loss"]
            track = read_table(folder / "track.csv")
            after = track[track["t_s"] >= loss_s]
            axis.plot(after["est_east_m"], after["est_north_m"], color=colour, lw=1.2)
            axis.plot(after["east_m"], after["north_m"], color=_TRUE, lw=0.9, ls=style)
            if len(after):
                titles.append(f"{word}: median {np.median(after['error_m']):.0f} m, max {after['error_m'].max():.0f} m")
        axis.set(xlim=(-80, ground.WIDTH_M + 80), ylim=(-80, ground.DEPTH_M + 80), facecolor="0.25")
        axis.set_title("; ".join(titles), fontsize=10)
        axis.tick_params(labelsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=70)
