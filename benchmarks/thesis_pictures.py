"""The pictures of docs/thesis.md: PR curves, PCU, the sweeps of CoHOG, the thresholds of memorable maps."""

from pathlib import Path

import base
from thesis_memorable import CRITERIA, TECHNIQUES
from thesis_sweep import THESIS as MEAN
from thesis_sweep import VOTE, W2_PX
from thesis_values import MATRICES, THESIS, Results, measured_rows, pcu_of, printed_pcu

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
    drawn, axes = base.panels(11, 5.2, 2, sharey=True)
    for axis, title, rows in zip(axes, ("the author's matrices", "here"), (theirs, ours), strict=True):
        for name, row in sorted(rows.items(), key=lambda each: -each[1]["auc"]):
            precision, recall = zip(*row["precision_recall"], strict=True)
            style = {"color": "k", "lw": 2} if name not in theirs and "cohog" in name else {"color": colours[name]}
            axis.plot(recall, precision, label=f"{name} {row['auc']:.2f}", **style)
        axis.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", title=f"corridor: {title}")
        axis.legend(title="AUC (2.3)", fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13))
    axes[0].set_ylabel("precision")
    base.save(drawn, path)


def pcu(results: Results, path: Path) -> None:
    """Draw PCU as bars: of table 6.1, of the author's matrices, and here."""
    table = THESIS["table_6_1"]
    names = [name for name in table["techniques"] if "best" not in name]
    shown = [(f"thesis: {on}", {name: printed_pcu(name)[at] for name in names}) for at, on in enumerate(table["sets"])]
    author = pcu_of(results.thesis["matrices"])
    shown.append(("corridor: the author's", {name: author[of] for name, of in MATRICES.items()}))
    shown += [(f"here: {on}", pcu_of(measured_rows(results, on))) for on in ("corridor", "grief_stromovka_seasons")]
    drawn, axes = base.panels(13, 7, len(shown), 2)
    for axis, (title, found) in zip(axes, shown, strict=True):
        bars = {name: found[name] for name in (*names, "cohog, as it flies") if found.get(name) is not None}
        axis.barh(list(bars), list(bars.values()), color=["C1" if "oho" in name.lower() else "C0" for name in bars])
        axis.invert_yaxis()
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=7)
    drawn.supxlabel("PCU")
    base.save(drawn, path)


def sweep(results: Results, path: Path) -> None:
    """Draw the four panels of figure 6.8: precision at 100 % recall by both scores, and the time of encoding."""
    points = results.thesis["sweep"]["points"]
    keys = {"GT": "gt", "W1": "w1", "W2": "w2", "W1/W2": "w1"}
    drawn, axes = base.panels(13, 3.8, len(keys))
    for axis, letter, (name, key) in zip(axes, "abcd", keys.items(), strict=True):
        of_sweep = sorted((point for point in points if point["sweep"] == name), key=lambda point: point[key])
        for (score, chosen), rows in base.groups(of_sweep, lambda point: (point["score"], point["chosen"])):
            style, label = ("o-", score) if chosen == "filled_bins" else ("x:", f"{score}, Shannon")
            values = [row["precision_at_100_recall"] for row in rows]
            axis.plot([row[key] for row in rows], values, style, color=LOOKS[score], label=label)
        if name != "GT":
            timed = [(point[key], 1e3 * point["t_encode_s"]) for point in of_sweep if point["score"] == MEAN]
            beside = axis.twinx()
            beside.plot(*zip(*timed, strict=True), "--", color="C7")
            beside.set_ylim(0, None)
            beside.set_ylabel("t_e, ms CPU (dashed)", color="C7", fontsize=8)
        if name == "W2":
            axis.set_xscale("log", base=2)
            axis.set_xticks(W2_PX, map(str, W2_PX))
        what = {"W1/W2": "W1, px, W2 = W1 / 32", "GT": "GT"}.get(name, f"{name}, px")
        axis.set(ylim=(0, 1), xlabel=what, title=f"({letter}) {name}")
    axes[0].set_ylabel("precision at 100 % recall")
    axes[0].legend(fontsize=7)
    base.save(drawn, path)


def thresholds(results: Results, path: Path) -> None:
    """Draw figures 3.17 and 3.10: AUC of the queries that pass each threshold, and the share of pictures that do."""
    swept = [(each, criterion) for each in results.thesis["thresholds"] for criterion in CRITERIA]
    drawn, axes = base.panels(12, 3.4 * len(swept) / 3, len(swept), len(swept) // 3, sharey=True)
    for axis, (each, criterion) in zip(axes, swept, strict=True):
        rows = [row for row in each["rows"] if row["criterion"] == criterion]
        for name in TECHNIQUES:
            shown = [(row["threshold"], row["auc"][name]) for row in rows if row["auc"][name] is not None]
            axis.plot(*zip(*shown, strict=True), label=f"AUC, {name}")
        at, kept = [row["threshold"] for row in rows], [row["kept"] for row in rows]
        axis.fill_between(at, kept, color="C7", alpha=0.3, label="pictures kept")
        axis.set(xlim=(0, 1), ylim=(0, 1.02), xlabel=f"least {criterion}", ylabel="AUC; share kept", title=each["set"])
    axes[0].legend(fontsize=7)
    base.save(drawn, path)
