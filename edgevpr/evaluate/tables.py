"""Results as tables: plain text for a terminal, Markdown for a page."""

from collections.abc import Sequence

from edgevpr.evaluate.evaluate import TechniqueResult
from edgevpr.runtime.estimate_text import aligned

QUALITY = ("recall@1", "@5", "@10", "P@100%R", "R@100%P", "AUC", "EP", "ROC", "PCU", "accepted (wrong)")
COSTS = ("t_e ms", "t_m ms", "t_m/ref ms", "RAM B/place", "disk B/place", "U_e", "U_m", "mAh/query")


def quality(result: TechniqueResult) -> list[str]:
    """What a technique reached, as texts in the order of `QUALITY`."""
    shares = [
        result.recall_at_1, result.recall_at_5, result.recall_at_10, result.precision_at_100_recall,
        result.recall_at_100_precision, result.auc, result.ep, result.roc_auc, result.pcu,
    ]  # fmt: skip
    return [
        *("-" if share is None else f"{share:.3f}" for share in shares),
        f"{result.accepted} ({result.accepted_wrong})",
    ]


def costs(result: TechniqueResult) -> list[str]:
    """What it cost, as texts in the order of `COSTS`."""
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


def text(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns in line, the first to the left and the others to the right."""
    return "\n".join(aligned([headings, *rows]))


def markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, numbers to the right."""
    ruler = ["---"] + ["---:"] * (len(headings) - 1)
    return "\n".join("| " + " | ".join(line) + " |" for line in (headings, ruler, *rows))


def results_text(results: Sequence[TechniqueResult]) -> str:
    """What `edgevpr eval` prints, with what the figures rest on. `results` come from `compare`."""
    first = results[0]
    reached = text(("technique", *QUALITY), [[result.technique, *quality(result)] for result in results])
    paid = text(("technique", *COSTS), [[result.technique, *costs(result)] for result in results])
    return (
        f"{reached}\n\n{paid}\n\n"
        f"{first.queries} queries scored against {first.references} references; times are means over the queries.\n"
        f"{_sequences(results)}"
        "accepted: queries that would have moved the aircraft, by the technique's own rule.\n"
        f"PCU: P@100%R x log10(t_e,max / t_e + 9) with t_e,max = {first.t_encode_max_s * 1000:.1f} ms.\n"
        f"mAh: {first.ah_assumes}."
        + "".join(f"\nWeights of {each}." for each in dict.fromkeys(result.weights for result in results) if each)
    )


def _sequences(results: Sequence[TechniqueResult]) -> str:
    lengths = [f"{result.technique} of {result.sequence}" for result in results if result.sequence > 1]
    return f"Matched in sequences of queries: {', '.join(lengths)}.\n" if lengths else ""
