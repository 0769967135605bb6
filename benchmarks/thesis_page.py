"""The page docs/thesis.md: this project beside the tables and figures of the thesis."""

import textwrap

import thesis_costs as costs
import thesis_own as own
import thesis_quality as quality
from thesis_values import ROWS, THESIS, Results, total_ah

from edgevpr.core.text import markdown


def answers(results: Results) -> list[list[str]]:
    """Return every table and figure with something to measure: what came out, and in which section it stands."""
    matrices, here = results.thesis["matrices"], results.sets["corridor"]["techniques"]
    power = THESIS["table_5_2"]["techniques"]
    worst = max(abs(total_ah(*map(float, inputs)) / float(ah) - 1) for *inputs, ah in power.values())
    calc = here[ROWS["CALC"]]["auc"] - matrices["CALC"]["auc"]
    cohog = here[ROWS["CoHOG"]]["recall_at_1"] - matrices["CoHOG"]["recall_at_1"]
    apart = own.contradictions()
    leads = f"CoHOG first on {costs.sets_where_cohog_leads()} of {len(THESIS['table_6_1']['sets'])} sets, as it says"
    corridor = f"CALC's AUC {calc:+.3f}, CoHOG's recall@1 {cohog:+.3f}; networks less, being small ones"
    lost = "pictures are lost at like thresholds; AUC follows none of them"
    smaller, far = (
        f"CoHOG's map {costs.map_ratio(results):.0f} times smaller in RAM",
        f"{apart[0]:.0f} to {apart[-1]:.0f}",
    )
    return [
        ["table 5.2", "from its own inputs", f"Ah_t within {worst:.2%}", "ampere-hours"],
        ["figure 6.6", "from table 6.1; run on corridor", leads, "PCU"],
        ["table 6.1", "run on other pictures", "order of techniques, times, RAM", "precision; times; RAM"],
        ["figures 4.8, 6.7 (techniques)", "the author's matrices of corridor", corridor, "Corridor"],
        ["figure 6.8, Top-G", "run on corridor", "other optima than on ESSEX3IN1", "parameters of CoHOG"],
        ["figures 3.10, 3.17", "run on two other sets", lost, "thresholds"],
        ["figure 3.19", "run on two other sets", "rises with the radius, as there", "thresholds"],
        ["figures 3.12, 3.20, 3.21", "run on other sets", "AUC rises seldom", "thresholds"],
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
{made["commit"]}, {machine["cores"]} cores of an {machine["cpu"]}; {made["cpu_s"] / 60:.0f} minutes of one core). The
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
        costs.charge_here(results),
        costs.times(results),
        quality.corridor(results),
        quality.precision(results),
        costs.pcu(results),
        quality.sweeps(results),
        quality.memorable(results),
        costs.memory(results),
        costs.encode_ram(results),
        own.own_tables(),
        tail,
    )
    return reflowed("\n".join((head, *sections)))


def reflowed(page: str) -> str:
    """Break the lines of every paragraph anew: numbers of any length stand in them. Tables, lists, headings and
    pictures stay as they are."""
    blocks = page.rstrip().split("\n\n")
    return "\n\n".join(each if each.lstrip()[0] in "#|*!" else _filled(each) for each in blocks) + "\n"


def _filled(paragraph: str) -> str:
    return textwrap.fill(" ".join(paragraph.split()), 120, break_long_words=False, break_on_hyphens=False)
