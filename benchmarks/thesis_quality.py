"""Sections of docs/thesis.md on the quality of recognition, in the thesis and here, and on memorable maps."""

from base import format_markdown_table
from thesis_values import MATRICES, ROWS, THESIS, Results, select_rows

# How the techniques here differ from the author's.
SMALL = "the small shipped network replaces a large one trained for places or ImageNet"
REASONS = {
    "CoHOG": "the true gradient magnitude, regions in 8 bits",
    "HOG": "512x512 pixels in cells of 8, square root of the image",
    "CALC": "the same weights and preprocessing",
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
    """Return the section that compares the author's matrices of corridor with the same techniques here."""
    rows, curve_rows = [], []
    for name, matrix in MATRICES.items():
        theirs, ours = results.thesis["matrices"][matrix], results.sets["corridor"]["techniques"][ROWS[name]]
        cells = {
            figure: [f"{theirs[key]:.3f}", f"{ours[key]:.3f}", f"{ours[key] - theirs[key]:+.3f}"]
            for figure, key in FIGURES.items()
        }
        interval = "-".join(f"{end:.2f}" for end in theirs["recall_at_1_interval"] or ()) or "not known"
        rows.append([name, *cells["recall@1"], interval, *cells["P@100%R"], REASONS.get(name, SMALL)])
        curve_rows.append([name, *cells["AUC"], *cells["AUC (2.3)"], *cells["EP"]])
    figure_heads = {figure: [f"{figure} author's", "here", "difference"] for figure in FIGURES}
    heads = ("technique", *figure_heads["recall@1"], "95 % of author's", *figure_heads["P@100%R"], "reason")
    curve_heads = ("technique", *figure_heads["AUC"], *figure_heads["AUC (2.3)"], *figure_heads["EP"])
    cohog = results.sets["corridor"]["techniques"]["cohog"]
    cohog_figures = ", ".join(f"{figure} {cohog[key]:.3f}" for figure, key in FIGURES.items())
    return f"""## Corridor: the author's similarity matrices

The thesis's own sets are not available, but corridor (in table 2.1) is, and the author published the similarity
matrices of eight techniques on it with his later benchmark, VPR-Bench. The code of `edgevpr eval` computes the figures
of both (`cohog` as in the thesis, with `matching=thesis` and `--exact`). One query counts {1 / cohog["queries"]:.3f}.

{format_markdown_table(heads, rows)}

AUC starts at recall 0, as in VPR-Bench and scikit-learn; AUC (2.3) is by equation 2.3 of the thesis.

{format_markdown_table(curve_heads, curve_rows)}

AMOSNet and HybridNet differ only by their weights, so with the same small network they are equal here. CALC is the only
network whose author's weights are available, and its figures agree. `cohog` as it flies: {cohog_figures}.

![Precision-recall curves of the author's matrices and of the techniques here](../benchmarks/results/thesis_curves.png)
"""


def format_precision(results: Results) -> str:
    """Return the section that compares the precisions of table 6.1 with those on the available sets."""
    table = THESIS["table_6_1"]
    sets = ("corridor", *OTHER_SETS)
    ours = {name: select_rows(results, name) for name in sets}
    rows = []
    for name in (*ROWS, "cohog, as it flies"):
        values = table["techniques"].get(name, ())[: len(table["sets"])]
        printed = [float(value) for value in values if value is not None]
        spread = f"{min(printed):.2f} to {max(printed):.2f}" if printed else "-"
        rows.append([name, spread, *(f"{ours[set_name][name]['precision_at_100_recall']:.2f}" for set_name in sets)])
    return f"""## Table 6.1 and figure 6.7: precision at 100 % recall

{table["source"]}. Its five sets ({", ".join(table["sets"])}) are not available: the first column has the
range of the thesis's values on them. The other columns are other places, so differences to them mean nothing; only the
order of the techniques on the same set can be compared. Networks here are small replacements of large ones. In aerial
sets, `cohog` as it flies has a nadir camera and compares rotations, and the thesis's CoHOG does not.

{format_markdown_table(("technique", "thesis, five sets", *sets), rows)}
"""


def format_memorable_maps(results: Results) -> str:
    """Return the section on figures 3.12, 3.20 and 3.21, from the benchmark of the salience gate."""
    gate, larger, more_wrong = [], 0, 0
    ungated_rows = {(row["set"], row["technique"]): row for row in results.salience["gate"] if row["gate"] == "none"}
    for row in results.salience["gate"]:
        right, wrong = row["true_discarded"], row["false_discarded"]
        if row["gate"] != "all three" or not right + wrong:
            continue
        ungated = ungated_rows[row["set"], row["technique"]]
        all_right = round(ungated["recall"] * row["queries"])
        all_wrong = row["queries"] - all_right
        larger += row["auc"] > ungated["auc"]
        more_wrong += wrong * all_right > right * all_wrong
        figures = [f"{ungated['auc']:.3f}", f"{row['auc']:.3f}", f"{row['auc'] - ungated['auc']:+.3f}"]
        discarded = [f"{right} of {all_right}", f"{wrong} of {all_wrong}"]
        gate.append([row["set"], row["technique"], *figures, *discarded, f"{row['places']:.0%}"])
    gate_heads = (
        "set", "technique", "AUC without", "with the gate", "difference", "right discarded", "wrong discarded",
        "places kept",
    )  # fmt: skip
    speed = results.salience["speed"]
    limits = THESIS["memorable"]["thresholds"]
    return f"""## Figures 3.12, 3.20 and 3.21: memorable maps

AUC with the gate, discarded matches, and the size of the map, on the sets where the gate
discards any query ([salience.md](../benchmarks/results/salience.md): networks not trained on the set, with their own
memorability threshold; the thesis's thresholds are {", ".join(limits.values())}):

{format_markdown_table(gate_heads, gate)}

In the thesis, the gate raised the AUC of every technique on every set (figure 3.12), and discarded a larger share of
the wrong matches than of the right ones (figure 3.21). Here the AUC is larger in {larger} of {len(gate)} rows, and the
share in {more_wrong}. These sets were not made of confusing pictures, as two thirds of ESSEX3IN1 were; and the AUC by
equation 2.3 falls with the number of queries left.

A frame takes {THESIS["memorable"]["seconds_a_frame"]} s in the thesis (section 3.4.7), and here
{speed["all three, yolox_nano"]:.0f} ms with YOLOX-nano, {speed["entropy and memorability"]:.0f} ms without a detector.
"""
