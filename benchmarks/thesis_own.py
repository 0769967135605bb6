"""What the tables of the thesis say of each other. A section of docs/thesis.md."""

from thesis_values import THESIS, half_digit

from edgevpr.core.text import markdown


def match_ms(technique: str) -> tuple[list[float], float]:
    """Return the milliseconds to match one reference: on each set of table 3.1, and by table 5.2."""
    sizes, power = THESIS["table_3_1"], THESIS["table_5_2"]
    by_set = sizes["seconds"][technique]
    each = [1e3 * float(by_set[on][0]) / count for on, count in sizes["references"].items()]
    return each, 1e3 * float(power["techniques"][technique][3]) / power["references"]


def contradictions() -> list[float]:
    """Return how many times apart tables 3.1 and 5.2 are, of each technique that is in both, least first."""
    found = [match_ms(name) for name in THESIS["table_3_1"]["seconds"]]
    return sorted(max(max(each) / later, later / max(each)) for each, later in found)


def own_tables() -> str:
    """What the thesis's tables say of each other."""
    sizes, power = THESIS["table_3_1"], THESIS["table_5_2"]
    rows = []
    for name, by_set in sizes["seconds"].items():
        kept = [f"{float(by_set[on][1]) / float(by_set[on][0]):.0%}" for on in sizes["references"]]
        each, later = match_ms(name)
        rows.append([name, f"{min(each):.2f} to {max(each):.2f}", f"{later:.3f}", f"{max(each) / later:.0f}", *kept])
    heads = ("technique", "table 3.1, ms", "table 5.2, ms", "ratio", *(f"{on} kept" for on in sizes["references"]))
    encoded = []
    for name, (_, _, t_encode_s, _, _) in power["techniques"].items():
        short = THESIS["table_6_1"]["techniques"][name][-2]
        if abs(float(short) - float(t_encode_s)) > half_digit(short):
            encoded.append(f"{name} ({t_encode_s} s in table 5.2, {short} s in table 6.1)")
    return f"""## What the thesis's tables say of each other

Table 3.1 (page 59) divided by the references of each set (section 3.3.1) is the time to match one reference; so is t_m
of table 5.2 over its {power["references"]}. Both ran on the same processor, and differ by the ratio. The last columns
are
how much of the map the second half of table 3.1 leaves (figure 3.20 has these sizes as bars).

{markdown(heads, rows)}

* t_e of table 6.1 is that of table 5.2 rounded, but for {", ".join(encoded) or "none"}.
* Table 6.1 gives the same RAM to AlexNet and Region-VLAD, to AMOSNet and HybridNet, and to R-MAC and Cross-Region-BoW:
  techniques that share a network share the figure, whatever their descriptor is.
* A disc of radius 5 has 81 pixels: an entropy of `filled_bins` is at most log2(81) / 8 = 0.79, and a GT of 0.8 leaves
  nothing.
* On Cross-Seasons table 6.1 gives the best 800 regions 0.43 and the best 400 0.75, with 0.65 for GT, which on the other
  four sets chooses 730 to 790 (no mean is given for Cross-Seasons).
* Precision at 100 % recall, by equation 2.2, is that at the lowest-scoring *right* match: it is never below recall@1.
  Both are on this page.
* AUC by 2.3 begins at the first point of the curve: it is at most (N - 1) / N.
* The text calls tables 2.1, 4.1, 5.1 and 5.2 "Table 6.1", and tables 3.1 and 6.1 "Table 1".
"""
