"""Precision-recall curves as a picture (needs matplotlib, extra `plots`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from edgevpr.core.text import figure
from edgevpr.lab.evaluate.metrics import Quality

_PANELS_A_ROW = 3
# More than ten colours cannot be told apart: after ten curves the line style changes.
_LINES = ("-", "--", ":", "-.")


def plot(results: Mapping[str, Sequence[Quality]], path: Path) -> None:
    """Draw one panel per data set with one curve per technique, best AUC first in the legend, and write it to `path`.

    If all scores of a technique are the same, its curve is one point: it is drawn as a mark.
    """
    columns = min(len(results), _PANELS_A_ROW)
    rows = -(-len(results) // columns)
    drawn = figure(5.2 * columns, 4.6 * rows)
    # A technique looks the same in every panel, whatever is beside it and whatever the order of the legend.
    names = dict.fromkeys(result.technique for compared in results.values() for result in compared)
    looks = {name: look for look, name in enumerate(names)}
    for at, (title, compared) in enumerate(results.items(), start=1):
        axes = drawn.add_subplot(rows, columns, at)
        for result in sorted(compared, key=lambda result: -result.auc):
            number = looks[result.technique]
            precision, recall = zip(*result.precision_recall, strict=True)
            axes.plot(
                recall,
                precision,
                _LINES[number // 10 % len(_LINES)],
                color=f"C{number % 10}",
                marker="o" if len(recall) == 1 else None,
                label=f"{result.technique} {result.auc:.2f}",
            )
        axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision", title=title)
        axes.grid(alpha=0.3)
        # Below the panel, where it hides no curve.
        axes.legend(
            title="AUC (2.3)", fontsize=7, title_fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13)
        )
    drawn.savefig(path, dpi=100)
