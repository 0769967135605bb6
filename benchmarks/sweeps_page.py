"""Page and picture of `sweeps.py`."""

from pathlib import Path

from run_sets import TUNED_ON, write_rows
from sweep_changes import SWEEPS

from edgevpr.core.text import markdown

COLOURS = {
    "cohog": "tab:orange",
    "hog": "tab:blue",
    "calc": "tab:purple",
    "alexnet": "tab:brown",
    "amosnet": "tab:pink",
    "hybridnet": "tab:grey",
    "netvlad": "tab:green",
    "rmac": "tab:olive",
    "region_vlad": "tab:cyan",
    "cross_region_bow": "black",
}


def write(out: Path, found: list[dict], text: str) -> None:
    """Write what has been measured so far as sweeps.json, sweeps.md and sweeps.png; `text` says how."""
    write_rows(out, "sweeps", found, lambda content: _page(content, text), _draw)


def _page(content: dict, text: str) -> str:
    parts = ["# How far off the map", text.partition("\n\n")[2].partition("What is measured")[0]]
    parts.append("![recall@1 and accepted queries against each change](sweeps.png)")
    names = list(dict.fromkeys(row["set"] for row in content["rows"]))
    for name in names:
        rows = [row for row in content["rows"] if row["set"] == name]
        parts.append(f"## {name} ({'tuned on' if name in TUNED_ON else 'report'})")
        parts.append("recall@1; in brackets accepted and, of these, wrong.")
        parts.append(markdown(("change", "level", "asked", "shown", *(row["technique"] for row in rows)), _lines(rows)))
    made = f"Commit {content['commit']}, {content['date']}, {content['machine']['cpu']}. Made by `make sweeps`."
    return "\n\n".join(part.strip() for part in (*parts, made)) + "\n"


def _lines(rows: list[dict]) -> list[list[str]]:
    lines = []
    for levels in zip(*(row["levels"] for row in rows), strict=True):
        sweep = SWEEPS[levels[0]["sweep"]]
        what = [f"{sweep.title}, {sweep.unit}", f"{levels[0]['level']:g}", str(levels[0]["asked"])]
        lines.append([*what, f"{levels[0]['shown']:.2f}", *map(_cell, levels)])
    return lines


def _cell(level: dict) -> str:
    if level["recall_at_1"] is None:
        return "-"
    return f"{level['recall_at_1']:.2f} ({level['accepted']}, {level['accepted_wrong']})"


def _draw(path: Path, found: list[dict]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row["set"] for row in found))
    columns = -(-len(SWEEPS) // 2)  # two lines of panels a set
    figure, axes = plt.subplots(
        2 * len(names),
        columns,
        figsize=(2.5 * columns, 5 * len(names)),
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    panels = dict(zip(names, axes.reshape(len(names), 2 * columns), strict=True))
    for row in found:
        for axis, sweep in zip(panels[row["set"]], SWEEPS, strict=False):
            _curve(axis, row, sweep)
    for name, of_set in panels.items():
        of_set[0].set_ylabel(f"{name}\n({'tuned on' if name in TUNED_ON else 'report'})", fontsize=9)
        for axis, sweep in zip(of_set, SWEEPS.values(), strict=False):
            axis.set_xlabel(sweep.unit, fontsize=8)
            axis.set_title(sweep.title, fontsize=9)
            axis.set(ylim=(-0.03, 1.03))
            axis.tick_params(labelsize=7)
            axis.grid(alpha=0.3)
        for axis in of_set[len(SWEEPS) :]:
            axis.set_visible(False)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _curve(axis, row: dict, sweep: str) -> None:
    levels = [level for level in row["levels"] if level["sweep"] == sweep and level["asked"]]
    name, colour = row["technique"], COLOURS[row["technique"]]
    at = [level["level"] for level in levels]
    recall = [level["recall_at_1"] for level in levels]
    width = 2 if name == "cohog" else 0.9
    axis.plot(at, recall, "o-", markersize=1.5 * width, linewidth=width, color=colour, label=f"{name}, recall@1")
    if name == "cohog":
        right = [(level["accepted"] - level["accepted_wrong"]) / level["asked"] for level in levels]
        axis.plot(at, right, "--", color=colour, label="cohog, accepted and right")
        wrong = [level["accepted_wrong"] / level["asked"] or None for level in levels]
        axis.plot(at, wrong, "x", color="red", markersize=5, zorder=9, label="cohog, accepted and wrong")
    if sweep in ("dark", "height"):
        axis.set_xscale("log")
        axis.set_xticks([level["level"] for level in levels][::2], [f"{level['level']:g}" for level in levels][::2])
        axis.minorticks_off()
    if sweep in ("dark", "jpeg") and not axis.xaxis_inverted():
        axis.invert_xaxis()
