"""Formats results of evaluations: as text tables for a terminal, and as cells for the tables of `page`."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from edgevpr.core.text import aligned
from edgevpr.lab.evaluate.evaluate import TechniqueResult
from edgevpr.lab.evaluate.metrics import Interval, Quality

Column = tuple[str, Callable[[Any], str]]  # a heading, and the cell below it of a result


def share_text(share: float | Interval | None) -> str:
    """Return a share (0..1) or an interval as text; "-" for None, which is unknown."""
    if isinstance(share, Sequence):  # JSON has no tuples
        return f"{share[0]:.2f}-{share[1]:.2f}"
    return "-" if share is None else f"{share:.3f}"


def _share(heading: str, field: str) -> Column:
    return heading, lambda result: share_text(getattr(result, field))


_RECALLS: tuple[Column, ...] = (
    _share("recall@1", "recall_at_1"),
    _share("95 %", "recall_at_1_interval"),
    _share("@5", "recall_at_5"),
    _share("95 %", "recall_at_5_interval"),
    _share("@10", "recall_at_10"),
    _share("95 %", "recall_at_10_interval"),
)
_CURVE: tuple[Column, ...] = (
    _share("P@100%R", "precision_at_100_recall"),
    _share("R@100%P", "recall_at_100_precision"),
    _share("AUC", "auc"),
    _share("AUC from 0", "auc_from_zero"),
    _share("EP", "ep"),
    _share("ROC", "roc_auc"),
)
_DECIDED: tuple[Column, ...] = (
    _share("PCU", "pcu"),
    ("accepted (wrong)", lambda result: f"{result.accepted} ({result.accepted_wrong})"),
)
_COSTS: tuple[Column, ...] = (
    ("t_e ms", lambda result: f"{result.t_encode_s * 1000:.1f}"),
    ("t_m ms", lambda result: f"{result.t_match_s * 1000:.1f}"),
    ("t_m/ref ms", lambda result: f"{result.t_match_per_ref_s * 1000:.3f}"),
    ("RAM B/place", lambda result: str(result.descriptor_bytes)),
    ("disk B/place", lambda result: str(result.fine_bytes)),
    ("U_e", lambda result: f"{result.u_encode:.2f}"),
    ("U_m", lambda result: f"{result.u_match:.2f}"),
    ("mAh/query", lambda result: f"{result.ah_total * 1000 / result.queries:.2g}"),
)
_QUALITY = (*_RECALLS, *_CURVE, *_DECIDED)
QUALITY = tuple(heading for heading, _ in _QUALITY)
COSTS = tuple(heading for heading, _ in _COSTS)


def quality(result: TechniqueResult) -> list[str]:
    """Return the quality figures of a technique as texts, in the order of `QUALITY`."""
    return [text_of(result) for _, text_of in _QUALITY]


def costs(result: TechniqueResult) -> list[str]:
    """Return the costs of a technique as texts, in the order of `COSTS`."""
    return [text_of(result) for _, text_of in _COSTS]


def results_text(results: Sequence[Quality]) -> str:
    """Make the text that `edgevpr eval` prints for a data set: tables, then the assumptions of their figures. Results
    of techniques come from `evaluate.compare`; those of stored similarities have no costs."""
    first = results[0]
    techniques = [each for each in results if isinstance(each, TechniqueResult)]
    tables = [_RECALLS, (*_CURVE, *_DECIDED), _COSTS] if techniques else [_RECALLS, _CURVE]
    known = "the queries resampled" if first.recall_at_1_interval else "not computed: it needs SciPy"
    lines = [
        *(_table(results, columns) for columns in tables),
        f"{first.queries} queries scored against {first.references} references.",
        f"95 %: what other queries of the same kind would give, {known}. AUC: equation 2.3; from 0: scikit-learn's.",
        *(_assumed(techniques) if techniques else ()),
    ]
    return "\n".join(lines)


def _assumed(results: Sequence[TechniqueResult]) -> Iterator[str]:
    """Yield the sentences below the tables."""
    if sequences := [f"{each.technique} of {each.sequence}" for each in results if each.sequence > 1]:
        yield f"Matched in sequences of queries: {', '.join(sequences)}."
    for each in results:
        if each.known:
            yield f"Known of each query of {each.technique}: {each.known}."
        if each.discarded:
            of_the_others = each.recall_at_1 * each.queries / max(each.queries - each.discarded, 1)
            yield (
                f"{each.technique}: {each.discarded} queries were not memorable, and count as missed; recall@1 of the "
                f"others is {of_the_others:.3f}."
            )
    yield "Times: means over the queries. accepted: would have moved the aircraft, by the technique's own rule."
    slowest_ms = 1000 * max(each.t_encode_s for each in results)
    yield f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {slowest_ms:.1f} ms."
    yield f"mAh: {results[0].ah_assumes}."
    for weights in dict.fromkeys(each.weights for each in results if each.weights):
        yield f"Weights of {weights}."


def _table(results: Sequence[Quality], columns: Sequence[Column]) -> str:
    """Return a table with a row for each result."""
    rows = [[each.technique, *(text_of(each) for _, text_of in columns)] for each in results]
    return "\n".join(aligned([["technique", *(heading for heading, _ in columns)], *rows])) + "\n"
