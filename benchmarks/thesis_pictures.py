"""The pictures of docs/thesis.md: PR curves, PCU, the sweeps of CoHOG, the thresholds of memorable maps."""

from pathlib import Path

from thesis_memorable import CRITERIA, TECHNIQUES
from thesis_sweep import THESIS as MEAN
from thesis_sweep import VOTE, W2_PX
from thesis_values import MATRICES, THESIS, Results, measured_rows, pcu_of, printed_pcu

from edgevpr.core.text import figure

LOOKS = {MEAN: "C0", VOTE: "C1"}


def draw(results: Results, folder: Path) -> None:
    """Draw all pictures into a folder."""
    curves(results, folder / "thesis_curves.png")
    pcu(results, folder / "thesis_pcu.png")
    sweep(results, folder / "thesis_sweep.png")
    thresholds(results, folder / "thesis_thresholds.png")


def curves(results: Results, path: Path) -> None:
    """Draw the PR curves of the author's matrices of corridor, and those of the techniques here."""
    theirs = {name: results.thesis["matrices"][of] for name, of in MATRICES.items()}
    ours = measured_rows(results, "corridor")
    colours = {name: f"C{number}" for number, name in enumerate(ours)}
    drawn = figure(11, 5.2)
    for axes, title, rows in zip(
        drawn.subplots(1, 2, sharey=True), ("the author's matrices", "here"), (theirs, ours), strict=True
    ):
        for name, row in sorted(rows.items(), key=lambda each: -each[1]["auc"]):
            precision, recall = zip(*row["precision_recall"], strict=True)
            style = {"color": "k", "lw": 2} if name not in theirs and "cohog" in name else {"color": colours[name]}
            axes.plot(recall, precision, label=f"{name} {row['auc']:.2f}", **style)
        axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", title=f"corridor: {title}")
        axes.grid(alpha=0.3)
        axes.legend(
            title="AUC (2.3)", fontsize=7, title_fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13)
        )
    drawn.axes[0].set_ylabel("precision")
    drawn.savefig(path, dpi=100)


def pcu(results: Results, path: Path) -> None:
    """Draw PCU as bars: of table 6.1, of the author's matrices, and here."""
    table = THESIS["table_6_1"]
    names = [name for name in table["techniques"] if "best" not in name]
    panels = [(f"thesis: {on}", {name: printed_pcu(name)[at] for name in names}) for at, on in enumerate(table["sets"])]
    author = pcu_of(results.thesis["matrices"])
    panels.append(("corridor: the author's", {name: author[of] for name, of in MATRICES.items()}))
    panels += [(f"here: {on}", pcu_of(measured_rows(results, on))) for on in ("corridor", "grief_stromovka_seasons")]
    drawn = figure(13, 7)
    for axes, (title, found) in zip(drawn.subplots(2, 4).ravel(), panels, strict=True):
        shown = [name for name in (*names, "cohog, as it flies") if found.get(name) is not None]
        axes.barh(shown, [found[name] for name in shown], color=["C1" if "oho" in n.lower() else "C0" for n in shown])
        axes.invert_yaxis()
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.grid(axis="x", alpha=0.3)
    drawn.supxlabel("PCU")
    drawn.savefig(path, dpi=100)


def sweep(results: Results, path: Path) -> None:
    """Draw the four panels of figure 6.8: precision at 100 % recall by both scores, and the time of encoding."""
    points = results.thesis["sweep"]["points"]
    axis_of = {"GT": "gt", "W1": "w1", "W2": "w2", "W1/W2": "w1"}
    drawn = figure(13, 3.8)
    for number, (axes, (name, key)) in enumerate(zip(drawn.subplots(1, 4), axis_of.items(), strict=True)):
        for score, colour in LOOKS.items():
            for chosen, line in (("filled_bins", "o-"), ("shannon", "x:")):
                rows = [p for p in points if (p["sweep"], p["score"], p["chosen"]) == (name, score, chosen)]
                if rows:
                    rows.sort(key=lambda each: each[key])
                    label = score if chosen == "filled_bins" else f"{score}, Shannon"
                    values = [each["precision_at_100_recall"] for each in rows]
                    axes.plot([each[key] for each in rows], values, line, color=colour, label=label)
        if name != "GT":
            timed = sorted((p[key], 1e3 * p["t_encode_s"]) for p in points if (p["sweep"], p["score"]) == (name, MEAN))
            beside = axes.twinx()
            beside.plot(*zip(*timed, strict=True), "--", color="C7")
            beside.set_ylim(0, None)
            beside.set_ylabel("t_e, ms CPU (dashed)", color="C7", fontsize=8)
        if name == "W2":
            axes.set_xscale("log", base=2)
            axes.set_xticks(W2_PX, map(str, W2_PX))
        what = {"W1/W2": "W1, px, W2 = W1 / 32", "GT": "GT"}.get(name, f"{name}, px")
        axes.set(ylim=(0, 1), xlabel=what, title=f"({'abcd'[number]}) {name}")
        axes.grid(alpha=0.3)
    drawn.axes[0].set_ylabel("precision at 100 % recall")
    drawn.axes[0].legend(fontsize=7)
    drawn.savefig(path, dpi=100)


def thresholds(results: Results, path: Path) -> None:
    """Draw figures 3.17 and 3.10: AUC of the queries that pass each threshold, and the share of pictures that do."""
    swept = results.thesis["thresholds"]
    drawn = figure(12, 3.4 * len(swept))
    for row_of, each in zip(drawn.subplots(len(swept), 3, sharey=True, squeeze=False), swept, strict=True):
        for axes, criterion in zip(row_of, CRITERIA, strict=True):
            rows = [row for row in each["rows"] if row["criterion"] == criterion]
            for name in TECHNIQUES:
                shown = [(row["threshold"], row["auc"][name]) for row in rows if row["auc"][name] is not None]
                axes.plot(*zip(*shown, strict=True), label=f"AUC, {name}")
            axes.fill_between([row["threshold"] for row in rows], [row["kept"] for row in rows], color="C7", alpha=0.3,
                              label="pictures kept")  # fmt: skip
            axes.set(
                xlim=(0, 1), ylim=(0, 1.02), xlabel=f"least {criterion}", ylabel="AUC; share kept", title=each["set"]
            )
            axes.grid(alpha=0.3)
    drawn.axes[0].legend(fontsize=7)
    drawn.savefig(path, dpi=100)
