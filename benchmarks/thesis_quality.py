"""How well techniques recognise, by the thesis and here, and memorable maps. Sections of docs/thesis.md."""

from base import format_markdown_table
from thesis_values import MATRICES, ROWS, THESIS, Results, capitalise, select_rows

# What is different here from the author's techniques.
SMALL = "the small network that is shipped stands in for a large one trained for places or ImageNet"
REASONS = {
    "CoHOG": "the true gradient magnitude, regions in 8 bits",
    "HOG": "512x512 pixels in cells of 8, of the root of the image",
    "CALC": "the same weights and preparation",
}
OTHER_SETS = ("grief_stromovka_seasons", "nordland_tiny", "aerial_swindale", "kite_ochota")
FIGURES = {
    "recall@1": "recall_at_1",
    "P@100%R": "precision_at_100_recall",
    "AUC": "auc_from_zero",
    "AUC (2.3)": "auc_2_3",
    "EP": "ep",
}


def format_corridor(results: Results) -> str:
    """The author's matrices of corridor beside the same techniques here."""
    rows, curve_rows = [], []
    for name, matrix in MATRICES.items():
        theirs, ours = results.thesis["matrices"][matrix], results.sets["corridor"]["techniques"][ROWS[name]]
        cells = {
            figure: [f"{theirs[key]:.3f}", f"{ours[key]:.3f}", f"{ours[key] - theirs[key]:+.3f}"]
            for figure, key in FIGURES.items()
        }
        between = "-".join(f"{end:.2f}" for end in theirs["recall_at_1_interval"] or ()) or "not known"
        rows.append([name, *cells["recall@1"], between, *cells["P@100%R"], REASONS.get(name, SMALL)])
        curve_rows.append([name, *cells["AUC"], *cells["AUC (2.3)"], *cells["EP"]])
    three_of = {figure: [f"{figure} author's", "here", "difference"] for figure in FIGURES}
    heads = ("technique", *three_of["recall@1"], "95 % of author's", *three_of["P@100%R"], "reason")
    curve_heads = ("technique", *three_of["AUC"], *three_of["AUC (2.3)"], *three_of["EP"])
    cohog = results.sets["corridor"]["techniques"]["cohog"]
    reached = ", ".join(f"{figure} {cohog[key]:.3f}" for figure, key in FIGURES.items())
    return f"""## Corridor: the author's similarity matrices

The thesis's own sets are not at hand, but corridor is (table 2.1 has it), and the author published the similarity
matrices of eight techniques on it with his later benchmark, VPR-Bench. Here the code of `edgevpr eval` computes the
figures of both (`cohog` as in the thesis, with `matching=thesis` and `--exact`).
One query is {1 / cohog["queries"]:.3f}.

{format_markdown_table(heads, rows)}

AUC is from recall 0, as VPR-Bench and scikit-learn compute it; the thesis's own is by equation 2.3.

{format_markdown_table(curve_heads, curve_rows)}

AMOSNet and HybridNet differ by their weights alone, and so not at all on the same small network. CALC is the only
network of which the author's own weights are at hand, and comes out the same. `cohog` as it flies
(displacement vote): {reached}.

![Precision-recall curves of the author's matrices and of the techniques here](../benchmarks/results/thesis_curves.png)
"""


def format_precision(results: Results) -> str:
    """Table 6.1, its precisions, beside those on the sets that are at hand."""
    table = THESIS["table_6_1"]
    sets = ("corridor", *OTHER_SETS)
    here = {name: select_rows(results, name) for name in sets}
    rows = []
    for name in (*ROWS, "cohog, as it flies"):
        values = table["techniques"].get(name, ())[: len(table["sets"])]
        printed = [float(value) for value in values if value is not None]
        spread = f"{min(printed):.2f} to {max(printed):.2f}" if printed else "-"
        rows.append([name, spread, *(f"{here[set_name][name]['precision_at_100_recall']:.2f}" for set_name in sets)])
    return f"""## Table 6.1 and figure 6.7: precision at 100 % recall

{capitalise(table["source"])}. Its five sets ({", ".join(table["sets"])}) are not at hand: the first column is the least
and the most that the thesis has on them, the others are other places, and no difference would say anything. What can be
compared is the order of the techniques on the same set. Networks here are small ones in the place of large ones; in
the sets from the air `cohog` as it flies looks down and turns, and the thesis's CoHOG does not.

{format_markdown_table(("technique", "thesis, five sets", *sets), rows)}
"""


def format_memorable_maps(results: Results) -> str:
    """Figures 3.12, 3.20 and 3.21, from the benchmark of the gate."""
    gate, larger, wronger = [], 0, 0
    before = {(row["set"], row["technique"]): row for row in results.salience["gate"] if row["gate"] == "none"}
    for row in results.salience["gate"]:
        right, wrong = row["true_discarded"], row["false_discarded"]
        if row["gate"] != "all three" or not right + wrong:
            continue
        ungated = before[row["set"], row["technique"]]
        all_right = round(ungated["recall"] * row["queries"])
        all_wrong = row["queries"] - all_right
        larger += row["auc"] > ungated["auc"]
        wronger += wrong * all_right > right * all_wrong
        figures = [f"{ungated['auc']:.3f}", f"{row['auc']:.3f}", f"{row['auc'] - ungated['auc']:+.3f}"]
        discarded = [f"{right} of {all_right}", f"{wrong} of {all_wrong}"]
        gate.append([row["set"], row["technique"], *figures, *discarded, f"{row['places']:.0%}"])
    gate_heads = (
        "set", "technique", "AUC without", "with the gate", "difference", "right discarded", "wrong discarded",
        "map left",
    )  # fmt: skip
    speed = results.salience["speed"]
    limits = THESIS["memorable"]["thresholds"]
    return f"""## Figures 3.12, 3.20 and 3.21: memorable maps

AUC with the gate, what it discards, and the size of the map, on the sets here, where it
discards any query ([salience.md](../benchmarks/results/salience.md): networks that have not seen the set, and a
memorability threshold of their own; the thesis's are {", ".join(limits.values())}):

{format_markdown_table(gate_heads, gate)}

The thesis found a larger AUC for every technique on every set (figure 3.12), and a larger share of the wrong matches
discarded than of the right ones (figure 3.21). Here the AUC is larger in {larger} of {len(gate)} rows, and the share in
{wronger}. These sets were not made of confusing pictures, as two thirds of ESSEX3IN1 were; and the AUC by 2.3 falls
with
the number of queries that are left.

A frame takes {THESIS["memorable"]["seconds_a_frame"]} s in the thesis (section 3.4.7); here
{speed["all three, yolox_nano"]:.0f} ms with YOLOX-nano, {speed["entropy and memorability"]:.0f} ms without a detector.
"""
