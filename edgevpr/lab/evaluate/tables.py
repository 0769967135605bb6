"""Formats results of evaluations: as text tables for a terminal, as cells for the tables of `page`, and as a plot of
curves (matplotlib, extra `plots`)."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from edgevpr.core.text import aligned, figure
from edgevpr.lab.evaluate.evaluate import TechniqueResult
from edgevpr.lab.evaluate.metrics import Interval, Quality

_PANELS_A_ROW = 3
# More than ten colours cannot be told apart: after ten curves the line style changes.
_LINES = ("-", "--", ":", "-.")
# Pairs of a column's heading and the field of `Quality` below it.
_RECALLS = (
    ("recall@1", "recall_at_1"), ("95 %", "recall_at_1_interval"), ("@5", "recall_at_5"),
    ("95 %", "recall_at_5_interval"), ("@10", "recall_at_10"), ("95 %", "recall_at_10_interval"),
)  # fmt: skip
_CURVE = (
    ("P@100%R", "precision_at_100_recall"), ("R@100%P", "recall_at_100_precision"), ("AUC", "auc"),
    ("AUC from 0", "auc_from_zero"), ("EP", "ep"), ("ROC", "roc_auc"),
)  # fmt: skip
_COSTS: dict[str, Callable[[TechniqueResult], str]] = {
    "t_e ms": lambda result: f"{result.t_encode_s * 1000:.1f}",
    "t_m ms": lambda result: f"{result.t_match_s * 1000:.1f}",
    "t_m/ref ms": lambda result: f"{result.t_match_per_ref_s * 1000:.3f}",
    "RAM B/place": lambda result: str(result.descriptor_bytes),
    "disk B/place": lambda result: str(result.fine_bytes),
    "U_e": lambda result: f"{result.u_encode:.2f}",
    "U_m": lambda result: f"{result.u_match:.2f}",
    "mAh/query": lambda result: f"{result.ah_total * 1000 / result.queries:.2g}",
}
_DECIDED = ("PCU", "accepted (wrong)")
QUALITY = (*(heading for heading, _ in (*_RECALLS, *_CURVE)), *_DECIDED)
COSTS = tuple(_COSTS)


def share_text(share: float | Interval | None) -> str:
    """Return a share (0..1) or an interval as text; "-" for None, which is unknown."""
    if isinstance(share, tuple):
        return f"{share[0]:.2f}-{share[1]:.2f}"
    return "-" if share is None else f"{share:.3f}"


def quality(result: TechniqueResult) -> list[str]:
    """Return the quality figures of a technique as texts, in the order of `QUALITY`."""
    return [*_shares(result, (*_RECALLS, *_CURVE)), *_decided(result)]


def costs(result: TechniqueResult) -> list[str]:
    """Return the costs of a technique as texts, in the order of `COSTS`."""
    return [text_of(result) for text_of in _COSTS.values()]


def quality_text(results: Sequence[Quality]) -> str:
    """Make the text that `edgevpr eval` prints for stored similarities, and with --out for each set."""
    first = results[0]
    recalls, curves = (_table(results, fields) for fields in (_RECALLS, _CURVE))
    scored = f"{first.queries} queries scored against {first.references} references."
    return f"{recalls}\n{curves}\n{scored}\n{_on_figures(first)}"


def results_text(results: Sequence[TechniqueResult]) -> str:
    """Make the text that `edgevpr eval` prints: tables, then the assumptions of their figures. `results` come from
    `evaluate.compare`."""
    first = results[0]
    sequences = [f"{each.technique} of {each.sequence}" for each in results if each.sequence > 1]
    lines = [
        _table(results, _RECALLS),
        _table(results, _CURVE, _DECIDED, [_decided(each) for each in results]),
        _table(results, (), COSTS, [costs(each) for each in results]),
        f"{first.queries} queries scored against {first.references} references; times are means over the queries.",
        _on_figures(first),
        *([f"Matched in sequences of queries: {', '.join(sequences)}."] if sequences else []),
        *(f"Known of each query of {each.technique}: {each.known}." for each in results if each.known),
        *(_discarded(each) for each in results if each.discarded),
        "accepted: queries that would have moved the aircraft, by the technique's own rule.",
        f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {1000 * (first.t_encode_max_s or 0):.1f} ms.",
        f"mAh: {first.ah_assumes}.",
        *(f"Weights of {weights}." for weights in dict.fromkeys(each.weights for each in results) if weights),
    ]
    return "\n".join(lines)


def _shares(result: Quality, fields: Sequence[tuple[str, str]]) -> list[str]:
    return [share_text(getattr(result, field)) for _, field in fields]


def _decided(result: TechniqueResult) -> list[str]:
    return [share_text(result.pcu), f"{result.accepted} ({result.accepted_wrong})"]


def _table(
    results: Sequence[Quality],
    fields: Sequence[tuple[str, str]],
    headings: Sequence[str] = (),
    cells: Sequence[list[str]] = (),
) -> str:
    """Return a table of `fields`, and of the `cells` below `headings`, with a row for each result."""
    rows = [
        [each.technique, *_shares(each, fields), *more]
        for each, more in zip(results, cells or [[]] * len(results), strict=True)
    ]
    return "\n".join(aligned([["technique", *(heading for heading, _ in fields), *headings], *rows])) + "\n"


def _on_figures(first: Quality) -> str:
    known = "the queries resampled" if first.recall_at_1_interval else "not computed: it needs SciPy"
    return f"95 %: what other queries of the same kind would give, {known}. AUC: equation 2.3; from 0: scikit-learn's."


def _discarded(result: TechniqueResult) -> str:
    of_the_others = result.recall_at_1 * result.queries / max(result.queries - result.discarded, 1)
    return (
        f"{result.technique}: {result.discarded} queries were not memorable, and count as missed; recall@1 of the "
        f"others is {of_the_others:.3f}."
    )


def plot(results: Mapping[str, Sequence[Quality]], path: Path) -> None:
    """Draw one panel per data set with one curve per technique, best AUC first in the legend, and write it to `path`.
    A curve of one point, where all scores are the same, is drawn as a mark."""
    columns = min(len(results), _PANELS_A_ROW)
    rows = -(-len(results) // columns)
    drawn = figure(5.2 * columns, 4.6 * rows)
    # A technique looks the same in every panel, whatever is beside it and whatever the order of the legend.
    names = list(dict.fromkeys(result.technique for compared in results.values() for result in compared))
    for at, (title, compared) in enumerate(results.items(), start=1):
        axes = drawn.add_subplot(rows, columns, at)
        for result in sorted(compared, key=lambda result: -result.auc):
            number = names.index(result.technique)
            precision, recall = zip(*result.precision_recall, strict=True)
            label, mark = f"{result.technique} {result.auc:.2f}", "o" if len(recall) == 1 else None
            line, colour = _LINES[number // 10 % len(_LINES)], f"C{number % 10}"
            axes.plot(recall, precision, line, color=colour, marker=mark, label=label)
        axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision", title=title)
        axes.grid(alpha=0.3)
        # Below the panel, where it hides no curve.
        axes.legend(
            title="AUC (2.3)", fontsize=7, title_fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13)
        )
    drawn.savefig(path, dpi=100)
