"""Results as tables: plain text for a terminal, Markdown for a page."""

from collections.abc import Sequence

from edgevpr.core.tables import aligned
from edgevpr.lab.evaluate.evaluate import TechniqueResult
from edgevpr.lab.evaluate.quality import Interval, Quality

RECALLS = ("recall@1", "95 %", "@5", "95 %", "@10", "95 %")
CURVE = ("P@100%R", "R@100%P", "AUC", "AUC from 0", "EP", "ROC")
QUALITY = (*RECALLS, *CURVE, "PCU", "accepted (wrong)")
COSTS = ("t_e ms", "t_m ms", "t_m/ref ms", "RAM B/place", "disk B/place", "U_e", "U_m", "mAh/query")


def recalls(result: Quality) -> list[str]:
    """Return the recalls of a technique as texts, in the order of `RECALLS`."""
    shares = [
        result.recall_at_1, result.recall_at_1_interval, result.recall_at_5, result.recall_at_5_interval,
        result.recall_at_10, result.recall_at_10_interval,
    ]  # fmt: skip
    return [_share(share) for share in shares]


def curve(result: Quality) -> list[str]:
    """Return the figures of the precision-recall curve of a technique as texts, in the order of `CURVE`."""
    shares = [
        result.precision_at_100_recall, result.recall_at_100_precision, result.auc, result.auc_from_zero, result.ep,
        result.roc_auc,
    ]  # fmt: skip
    return [_share(share) for share in shares]


def decided(result: TechniqueResult) -> list[str]:
    """Return what a flight would make of a technique as texts: its PCU, and the queries that it accepts."""
    return [_share(result.pcu), f"{result.accepted} ({result.accepted_wrong})"]


def quality(result: TechniqueResult) -> list[str]:
    """Return the quality figures of a technique as texts, in the order of `QUALITY`."""
    return [*recalls(result), *curve(result), *decided(result)]


def costs(result: TechniqueResult) -> list[str]:
    """Return the costs of a technique as texts, in the order of `COSTS`."""
    return [
        f"{result.t_encode_s * 1000:.1f}",
        f"{result.t_match_s * 1000:.1f}",
        f"{result.t_match_per_ref_s * 1000:.3f}",
        str(result.descriptor_bytes),
        str(result.fine_bytes),
        f"{result.u_encode:.2f}",
        f"{result.u_match:.2f}",
        f"{result.ah_total * 1000 / result.queries:.2g}",
    ]


def quality_text(results: Sequence[Quality]) -> str:
    """Make the text for stored similarities."""
    first = results[0]
    return "\n".join(
        [
            *aligned([("technique", *RECALLS), *([result.technique, *recalls(result)] for result in results)]),
            "",
            *aligned([("technique", *CURVE), *([result.technique, *curve(result)] for result in results)]),
            "",
            f"{first.queries} queries scored against {first.references} references.",
            *_on_figures(first),
        ]
    )


def results_text(results: Sequence[TechniqueResult]) -> str:
    """Make the text that `edgevpr eval` prints: tables, and what their figures rest on; `results` by `compare`."""
    first = results[0]
    found = aligned([("technique", *RECALLS), *([result.technique, *recalls(result)] for result in results)])
    reached = aligned(
        [
            ("technique", *CURVE, "PCU", "accepted (wrong)"),
            *([result.technique, *curve(result), *decided(result)] for result in results),
        ]
    )
    paid = aligned([("technique", *COSTS), *([result.technique, *costs(result)] for result in results)])
    lines = [
        *found,
        "",
        *reached,
        "",
        *paid,
        "",
        f"{first.queries} queries scored against {first.references} references; times are means over the queries.",
        *_on_figures(first),
        *_sequences(results),
        *_discarded(results),
        "accepted: queries that would have moved the aircraft, by the technique's own rule.",
        f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {first.t_encode_max_s * 1000:.1f} ms.",
        f"mAh: {first.ah_assumes}.",
        *(f"Weights of {each}." for each in dict.fromkeys(result.weights for result in results) if each),
    ]
    return "\n".join(lines)


def _share(share: float | Interval | None) -> str:
    if isinstance(share, tuple):
        return f"{share[0]:.2f}-{share[1]:.2f}"
    return "-" if share is None else f"{share:.3f}"


def _on_figures(first: Quality) -> list[str]:
    known = "the queries resampled" if first.recall_at_1_interval else "not computed: it needs SciPy"
    return [
        f"95 %: what other queries of the same kind would give, {known}. AUC: equation 2.3; from 0: scikit-learn's."
    ]


def _sequences(results: Sequence[TechniqueResult]) -> list[str]:
    lengths = [f"{result.technique} of {result.sequence}" for result in results if result.sequence > 1]
    return [f"Matched in sequences of queries: {', '.join(lengths)}."] if lengths else []


def _discarded(results: Sequence[TechniqueResult]) -> list[str]:
    lines = []
    for each in results:
        if each.discarded:
            of_the_others = each.recall_at_1 * each.queries / max(each.queries - each.discarded, 1)
            lines.append(
                f"{each.technique}: {each.discarded} queries were not memorable, and count as missed; recall@1 of the "
                f"others is {of_the_others:.3f}."
            )
    return lines
