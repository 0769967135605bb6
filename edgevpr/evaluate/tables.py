"""Results as tables: plain text for a terminal, Markdown for a page."""

from collections.abc import Sequence

from edgevpr.evaluate.evaluate import TechniqueResult
from edgevpr.helpers.tables import aligned

QUALITY = ("recall@1", "@5", "@10", "P@100%R", "R@100%P", "AUC", "EP", "ROC", "PCU", "accepted (wrong)")
COSTS = ("t_e ms", "t_m ms", "t_m/ref ms", "RAM B/place", "disk B/place", "U_e", "U_m", "mAh/query")


def quality(result: TechniqueResult) -> list[str]:
    """Return the quality figures of a technique as texts, in the order of `QUALITY`."""
    shares = [
        result.recall_at_1, result.recall_at_5, result.recall_at_10, result.precision_at_100_recall,
        result.recall_at_100_precision, result.auc, result.ep, result.roc_auc, result.pcu,
    ]  # fmt: skip
    return [
        *("-" if share is None else f"{share:.3f}" for share in shares),
        f"{result.accepted} ({result.accepted_wrong})",
    ]


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


def results_text(results: Sequence[TechniqueResult]) -> str:
    """Make the text that `edgevpr eval` prints: tables, and what their figures rest on; `results` by `compare`."""
    first = results[0]
    reached = aligned([("technique", *QUALITY), *([result.technique, *quality(result)] for result in results)])
    paid = aligned([("technique", *COSTS), *([result.technique, *costs(result)] for result in results)])
    lines = [
        *reached,
        "",
        *paid,
        "",
        f"{first.queries} queries scored against {first.references} references; times are means over the queries.",
        *_sequences(results),
        *_discarded(results),
        "accepted: queries that would have moved the aircraft, by the technique's own rule.",
        f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {first.t_encode_max_s * 1000:.1f} ms.",
        f"mAh: {first.ah_assumes}.",
        *(f"Weights of {each}." for each in dict.fromkeys(result.weights for result in results) if each),
    ]
    return "\n".join(lines)


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
