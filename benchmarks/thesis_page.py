"""The page docs/thesis.md: this project beside the tables and figures of the thesis."""

import textwrap

import thesis_costs as costs
import thesis_quality as quality
from thesis_values import ROWS, THESIS, Results, half_digit, total_ah

from edgevpr.core.text import markdown


def answers(results: Results) -> list[list[str]]:
    """Return every table and figure with something to measure: what came out, and in which section it stands."""
    matrices, here = results.thesis["matrices"], results.sets["corridor"]["techniques"]
    power = THESIS["table_5_2"]["techniques"]
    worst = max(abs(total_ah(*map(float, inputs)) / float(ah) - 1) for *inputs, ah in power.values())
    calc = here[ROWS["CALC"]]["auc"] - matrices["CALC"]["auc"]
    cohog = here[ROWS["CoHOG"]]["recall_at_1"] - matrices["CoHOG"]["recall_at_1"]
    apart = contradictions()
    leads = f"CoHOG first on {costs.sets_where_cohog_leads()} of {len(THESIS['table_6_1']['sets'])} sets, as it says"
    corridor = f"CALC's AUC {calc:+.3f}, CoHOG's recall@1 {cohog:+.3f}; networks less, being small ones"
    smaller = f"CoHOG's map {costs.map_ratio(results):.0f} times smaller in RAM"
    far = f"{apart[0]:.0f} to {apart[-1]:.0f}"
    return [
        ["table 5.2", "from its own inputs", f"Ah_t within {worst:.2%}", "ampere-hours"],
        ["figure 6.6", "from table 6.1; run on corridor", leads, "PCU"],
        ["table 6.1", "run on other pictures", "order of techniques, times", "precision; times"],
        ["figures 4.8, 6.7 (techniques)", "the author's matrices of corridor", corridor, "Corridor"],
        ["figures 3.12, 3.20, 3.21", "run on other sets", "AUC rises seldom", "memorable maps"],
        ["figures 4.7, 5.7", "from the sizes in the text", smaller, "memory of a map"],
        ["table 3.1", "held against table 5.2", f"{far} times apart", "of each other"],
    ]


def page(results: Results) -> str:
    """Return the whole page."""
    made = results.thesis
    machine = made["machine"]
    missing = [[each["what"], each["why"]] for each in THESIS["not_reproduced"]]
    head = f"""# The thesis's tables and figures, and this project's

Mubariz Zaffar, *Visual Place Recognition for Autonomous Robots*. Made by `make thesis` ({made["date"]}, commit
{made["commit"]}, {machine["cores"]} cores of an {machine["cpu"]}). The
thesis's values stand in [thesis.yaml](../benchmarks/thesis.yaml), each with its source. Values here come from
[thesis.json](../benchmarks/results/thesis.json), from the results of `make results` and `make bench`, and from the
thesis's own inputs.

{markdown(("thesis", "how", "what came out", "section"), answers(results))}
"""
    tail = f"""## What cannot be reproduced

{markdown(("what", "why"), missing)}
"""
    sections = (
        costs.charge(),
        costs.times(results),
        quality.corridor(results),
        quality.precision(results),
        costs.pcu(results),
        quality.memorable(results),
        costs.memory(results),
        own_tables(),
        tail,
    )
    return reflowed("\n".join((head, *sections)))


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


def reflowed(page: str) -> str:
    """Break the lines of every paragraph anew: numbers of any length stand in them. Tables, lists, headings and
    pictures stay as they are."""
    blocks = page.rstrip().split("\n\n")
    return "\n\n".join(each if each.lstrip()[0] in "#|*!" else _filled(each) for each in blocks) + "\n"


def _filled(paragraph: str) -> str:
    return textwrap.fill(" ".join(paragraph.split()), 120, break_long_words=False, break_on_hyphens=False)
