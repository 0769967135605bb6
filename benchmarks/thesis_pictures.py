"""The pictures of docs/thesis.md: PR curves and PCU."""

from pathlib import Path

import base
from thesis_values import MATRICES, THESIS, Results, measured_rows, pcu_of, printed_pcu


def draw(results: Results, folder: Path) -> None:
    """Draw all pictures into a folder."""
    curves(results, folder / "thesis_curves.png")
    pcu(results, folder / "thesis_pcu.png")


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
