"""The page docs/thesis.md, which compares this project with the tables and figures of the thesis."""

import textwrap

import thesis_costs as costs
import thesis_quality as quality
from base import format_markdown_table
from thesis_values import ROWS, THESIS, Results, total_ah


def list_results(results: Results) -> list[list[str]]:
    """Return a row for each table and figure that can be reproduced: its name, how, the result, and the section."""
    matrices, techniques = results.thesis["matrices"], results.sets["corridor"]["techniques"]
    power = THESIS["table_5_2"]["techniques"]
    max_error = max(abs(total_ah(*map(float, inputs)) / float(ah) - 1) for *inputs, ah in power.values())
    calc = techniques[ROWS["CALC"]]["auc_2_3"] - matrices["CALC"]["auc_2_3"]
    cohog = techniques[ROWS["CoHOG"]]["recall_at_1"] - matrices["CoHOG"]["recall_at_1"]
    leads = f"CoHOG best on {costs.count_sets_cohog_leads()} of {len(THESIS['table_6_1']['sets'])} sets, as stated"
    corridor = f"CALC's AUC {calc:+.3f}, CoHOG's recall@1 {cohog:+.3f}; networks lower, as they are small"
    smaller = f"CoHOG's map {costs.compute_map_ratio(results):.0f} times smaller in RAM"
    return [
        ["table 5.2", "from its own inputs", f"Ah_t within {max_error:.2%}", "ampere-hours"],
        ["figure 6.6", "from table 6.1; run on corridor", leads, "PCU"],
        ["table 6.1", "run on other pictures", "order of techniques, times", "precision; times"],
        ["figures 4.8, 6.7 (techniques)", "the author's matrices of corridor", corridor, "Corridor"],
        ["figures 3.12, 3.20, 3.21", "run on other sets", "AUC rises rarely", "memorable maps"],
        ["figures 4.7, 5.7", "from the sizes in the text", smaller, "memory of a map"],
    ]


def format_page(results: Results) -> str:
    """Return the whole page."""
    origin = results.thesis
    machine = origin["machine"]
    missing = [[item["what"], item["why"]] for item in THESIS["not_reproduced"]]
    head = f"""# The thesis's tables and figures, and this project's

Mubariz Zaffar, *Visual Place Recognition for Autonomous Robots*. Made by `make thesis` ({origin["date"]}, commit
{origin["commit"]}, {machine["cores"]} cores of an {machine["cpu"]}). The
thesis's values are in [thesis.yaml](../benchmarks/thesis.yaml), each with its source. Values of this project come from
[thesis.json](../benchmarks/results/thesis.json), from the results of `make results` and `make bench`, and from the
thesis's own inputs.

{format_markdown_table(("thesis", "how", "result", "section"), list_results(results))}
"""
    tail = f"""## What cannot be reproduced

{format_markdown_table(("what", "why"), missing)}
"""
    sections = (
        costs.format_charge(),
        costs.format_times(results),
        quality.format_corridor(results),
        quality.format_precision(results),
        costs.format_pcu(results),
        quality.format_memorable_maps(results),
        costs.format_memory(results),
        tail,
    )
    return wrap_paragraphs("\n".join((head, *sections)))


def wrap_paragraphs(page: str) -> str:
    """Wrap the lines of every paragraph again, because inserted numbers change their length. Tables, lists, headings
    and pictures stay as they are."""
    wrapper = textwrap.TextWrapper(120, break_long_words=False, break_on_hyphens=False)
    blocks = [
        block if block.lstrip()[0] in "#|*!" else wrapper.fill(" ".join(block.split()))
        for block in page.rstrip().split("\n\n")
    ]
    return "\n\n".join(blocks) + "\n"
