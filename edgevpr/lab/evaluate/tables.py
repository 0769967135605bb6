"""Formats results of evaluations as text tables for the terminal, and as rows for tables on pages."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from edgevpr.core.text import align_table
from edgevpr.lab.evaluate.metrics import Figures, Interval, TechniqueResult
from edgevpr.lab.evaluate.provenance import read_versions

Column = tuple[str, Callable[[Any], str]]  # the heading, and a function that formats the cell of a result

ABOUT_FIGURES = (
    "95 %: Wilson score interval.",
    "AUC: area under the precision-recall curve from recall 0 (scikit-learn, VPR-Bench); AUC 2.3: by equation 2.3 of "
    "the thesis, from the first point of the curve.",
    "R@100%P, right: fraction of the correct best matches (VPR-Bench); R@100%P, in map: of the queries whose place "
    "is in the map (VPR_Tutorial).",
)


def format_fraction(fraction: float | Interval | None) -> str:
    """Return a fraction (0..1) or an interval as text; "-" for None (unknown)."""
    if isinstance(fraction, Sequence):  # JSON has no tuples
        return f"{fraction[0]:.2f}-{fraction[1]:.2f}"
    return "-" if fraction is None else f"{fraction:.3f}"


def _make_fraction_column(heading: str, field: str) -> Column:
    return heading, lambda result: format_fraction(getattr(result, field, None))


def _count_off_map(result: Figures) -> str:
    if not isinstance(result, TechniqueResult) or not result.queries_off_map:
        return "-"
    return f"{result.accepted_off_map} of {result.queries_off_map}"


def _count_accepted(result: Figures) -> str:
    return f"{result.accepted} ({result.accepted_wrong})" if isinstance(result, TechniqueResult) else "-"


RECALLS: tuple[Column, ...] = (
    ("queries", lambda figures: str(figures.queries)),
    _make_fraction_column("recall@1", "recall_at_1"),
    _make_fraction_column("95 %", "recall_at_1_interval"),
    _make_fraction_column("@5", "recall_at_5"),
    _make_fraction_column("95 %", "recall_at_5_interval"),
    _make_fraction_column("@10", "recall_at_10"),
    _make_fraction_column("95 %", "recall_at_10_interval"),
)
CURVE: tuple[Column, ...] = (
    _make_fraction_column("AUC", "auc_from_zero"),
    _make_fraction_column("AUC 2.3", "auc_2_3"),
    _make_fraction_column("P@100%R", "precision_at_100_recall"),
    _make_fraction_column("R@100%P, right", "recall_at_100_precision_vpr_bench"),
    _make_fraction_column("R@100%P, in map", "recall_at_100_precision_vpr_tutorial"),
    _make_fraction_column("EP", "ep"),
    _make_fraction_column("ROC", "roc_auc"),
)
DECISIONS: tuple[Column, ...] = (
    _make_fraction_column("PCU", "pcu"),
    ("accepted (wrong)", _count_accepted),
    ("off the map", _count_off_map),
)
COSTS: tuple[Column, ...] = (
    ("t_e ms", lambda result: f"{result.t_encode_s * 1000:.1f}"),
    ("t_m ms", lambda result: f"{result.t_match_s * 1000:.1f}"),
    ("t_m/ref ms", lambda result: f"{result.t_match_per_ref_s * 1000:.3f}"),
    ("RAM B/place", lambda result: str(result.descriptor_bytes)),
    ("disk B/place", lambda result: str(result.fine_bytes)),
    ("U_e", lambda result: f"{result.u_encode:.2f}"),
    ("U_m", lambda result: f"{result.u_match:.2f}"),
    ("mAh/query", lambda result: f"{result.ah_total * 1000 / result.queries:.2g}"),
)


def make_rows(result: TechniqueResult, columns: Sequence[Column], include_in_map: bool = True) -> Iterator[list[str]]:
    """Yield the row of a result. With `include_in_map`, also yield that of the queries whose place is in the map."""
    yield [result.technique, *(format_cell(result) for _, format_cell in columns)]
    if include_in_map and result.with_match:
        yield [f"{result.technique}, in map", *(format_cell(result.with_match) for _, format_cell in columns)]


def list_headings(columns: Sequence[Column]) -> list[str]:
    """Return the headings of a table of `make_rows`."""
    return ["technique", *(heading for heading, _ in columns)]


def format_results(results: Sequence[TechniqueResult]) -> str:
    """Return the text that `edgevpr eval` prints for a data set: tables, then notes on them."""
    texts = []
    for columns in (RECALLS, (*CURVE, *DECISIONS), COSTS):
        rows = [row for result in results for row in make_rows(result, columns, include_in_map=columns is not COSTS)]
        texts.append("\n".join(align_table([list_headings(columns), *rows])) + "\n")
    return "\n".join([*texts, *_list_notes(results)])


def _list_notes(results: Sequence[TechniqueResult]) -> Iterator[str]:
    """Yield the sentences below the tables of a data set."""
    first = results[0]
    yield f"{first.queries} queries scored against {first.references} references."
    yield f"{first.queries_off_map} of them are off the map: their place is not in it, so every match is wrong."
    if first.unscored:
        yield f"{first.unscored} more queries have no ground truth and are not scored."
    if first.queries_copied:
        yield f"{first.queries_copied} of the queries are also references (the same file): leave them out."
    yield from ABOUT_FIGURES
    for result in results:
        if result.sequence > 1:
            yield f"{result.technique} matched sequences of {result.sequence} queries."
        if result.known:
            yield f"{result.technique} used with each query: {result.known}."
        if result.discarded:
            yield f"{result.technique}: {result.discarded} queries were discarded as not memorable and count as missed."
        yield from (f"{result.technique}: {sentence}" for sentence in result.not_done)
    yield "Times: means over the queries. accepted: a flight would accept the match, by the technique's own rule."
    slowest_ms = 1000 * max(result.t_encode_s for result in results)
    yield f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {slowest_ms:.1f} ms."
    yield f"mAh: {results[0].ah_assumes}."
    for weights in dict.fromkeys(result.weights for result in results if result.weights):
        yield f"Weights of {weights}."
    versions = (f"{name} {version or '(not installed)'}" for name, version in read_versions().items())
    yield f"Computed with {', '.join(versions)}."
