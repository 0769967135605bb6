"""Formats results of evaluations: as text tables for a terminal, and as cells for the tables of `page`."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from edgevpr.core.text import aligned
from edgevpr.lab.evaluate.metrics import Interval, Quality, TechniqueResult

Column = tuple[str, Callable[[Any], str]]  # a heading, and the text of a result's cell


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
    """Return the text that `edgevpr eval` prints for a data set: tables, then the notes on them. Results of techniques
    come from `metrics.compare`; those of stored similarities have no costs."""
    has_costs = isinstance(results[0], TechniqueResult)
    tables = [_RECALLS, (*_CURVE, *_DECIDED), _COSTS] if has_costs else [_RECALLS, _CURVE]
    texts = []
    for columns in tables:
        rows = [[result.technique, *(text_of(result) for _, text_of in columns)] for result in results]
        texts.append("\n".join(aligned([["technique", *(heading for heading, _ in columns)], *rows])) + "\n")
    return "\n".join([*texts, *list_notes(results)])


def list_notes(results: Sequence[Quality]) -> Iterator[str]:
    """Yield the sentences below the tables of a data set."""
    known = "the queries resampled" if results[0].recall_at_1_interval else "not computed: it needs SciPy"
    yield f"{results[0].queries} queries scored against {results[0].references} references."
    yield f"95 %: what other queries of the same kind would give, {known}. AUC: equation 2.3; from 0: scikit-learn's."
    techniques = [result for result in results if isinstance(result, TechniqueResult)]
    if not techniques:
        return
    for result in techniques:
        if result.sequence > 1:
            yield f"{result.technique} matched sequences of {result.sequence} queries."
        if result.known:
            yield f"Known of each query of {result.technique}: {result.known}."
        if result.discarded:
            remaining = result.recall_at_1 * result.queries / max(result.queries - result.discarded, 1)
            yield (
                f"{result.technique}: {result.discarded} queries were not memorable, and count as missed; recall@1 of "
                f"the others is {remaining:.3f}."
            )
    yield "Times: means over the queries. accepted: would have moved the aircraft, by the technique's own rule."
    slowest_ms = 1000 * max(result.t_encode_s for result in techniques)
    yield f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {slowest_ms:.1f} ms."
    yield f"mAh: {techniques[0].ah_assumes}."
    for weights in dict.fromkeys(result.weights for result in techniques if result.weights):
        yield f"Weights of {weights}."
