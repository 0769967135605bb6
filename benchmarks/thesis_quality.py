"""How well techniques recognise, by the thesis and here, and its sweeps of parameters. Sections of docs/thesis.md."""

from collections.abc import Callable
from typing import Any

import sets_page
from thesis_memorable import CRITERIA, TECHNIQUES
from thesis_sweep import GT, VOTE
from thesis_sweep import THESIS as MEAN
from thesis_values import MATRICES, ROWS, THESIS, Results, measured_rows, sentence

from edgevpr.core.text import markdown

OTHER_SETS = ("grief_stromovka_seasons", "nordland_tiny", "aerial_swindale", "kite_ochota")
FIGURES = {
    "recall@1": "recall_at_1",
    "P@100%R": "precision_at_100_recall",
    "AUC (2.3)": "auc",
    "EP": "ep",
}


def corridor(results: Results) -> str:
    """The author's matrices of corridor beside the same techniques here."""
    found, shaped = [], []
    for name, of in MATRICES.items():
        theirs, ours = results.thesis["matrices"][of], results.sets["corridor"]["techniques"][ROWS[name]]
        each = {
            figure: [f"{theirs[key]:.3f}", f"{ours[key]:.3f}", f"{ours[key] - theirs[key]:+.3f}"]
            for figure, key in FIGURES.items()
        }
        between = "-".join(f"{end:.2f}" for end in theirs["recall_at_1_interval"] or ()) or "not known"
        found.append([name, *each["recall@1"], between, *each["P@100%R"], sets_page.PUBLISHED[ROWS[name]][1]])
        shaped.append([name, *each["AUC (2.3)"], *each["EP"]])
    three_of = {figure: [f"{figure} author's", "here", "difference"] for figure in FIGURES}
    found_heads = ("technique", *three_of["recall@1"], "95 % of author's", *three_of["P@100%R"], "reason")
    shaped_heads = ("technique", *three_of["AUC (2.3)"], *three_of["EP"])
    flown = results.sets["corridor"]["techniques"]["cohog"]
    reached = ", ".join(f"{figure} {flown[key]:.3f}" for figure, key in FIGURES.items())
    return f"""## Corridor: the author's similarity matrices

The thesis's own sets are not at hand, but corridor is (table 2.1 has it), and the author published the similarity
matrices of eight techniques on it with his later benchmark, VPR-Bench. Here both go through the same code: the matrices
through that of `edgevpr eval --similarity`, the techniques through `edgevpr eval` (`cohog` as in the thesis, with
`matching=thesis` and `--exact`). One query is {1 / flown["queries"]:.3f}.

{markdown(found_heads, found)}

{markdown(shaped_heads, shaped)}

AMOSNet and HybridNet differ by their weights alone, and so not at all on the same small network. CALC is the only
network of which the author's own weights are at hand, and comes out the same. `cohog` as it flies
(displacement vote): {reached}.

![Precision-recall curves of the author's matrices and of the techniques here](../benchmarks/results/thesis_curves.png)
"""


def precision(results: Results) -> str:
    """Table 6.1, its precisions, beside those on the sets that are at hand."""
    table = THESIS["table_6_1"]
    sets = ("corridor", *OTHER_SETS)
    here = {name: measured_rows(results, name) for name in sets}
    rows = []
    for name in (*ROWS, "cohog, as it flies"):
        printed = [float(each) for each in table["techniques"].get(name, ())[: len(table["sets"])] if each is not None]
        spread = f"{min(printed):.2f} to {max(printed):.2f}" if printed else "-"
        rows.append([name, spread, *(f"{here[on][name]['precision_at_100_recall']:.2f}" for on in sets)])
    return f"""## Table 6.1 and figure 6.7: precision at 100 % recall

{sentence(table["source"])}. Its five sets ({", ".join(table["sets"])}) are not at hand: the first column is the least
and the most that the thesis has on them, the others are other places, and no difference would say anything. What can be
compared is the order of the techniques on the same set. Networks here are small ones in the place of large ones; in
the sets from the air `cohog` as it flies looks down and turns, and the thesis's CoHOG does not.

{markdown(("technique", "thesis, five sets", *sets), rows)}
"""


def sweeps(results: Results) -> str:
    """Figure 6.8: the parameters of CoHOG."""
    swept = results.thesis["sweep"]
    points = swept["points"]

    def of(sweep: str, score: str = MEAN, chosen: str | None = "filled_bins") -> list[dict[str, Any]]:
        wanted = [each for each in points if each["sweep"] == sweep and each["score"] == score]
        kept = [each for each in wanted if chosen is None or each["chosen"] == chosen]
        return sorted(kept, key=lambda each: (each["gt"] or 0, each["w1"], each["w2"]))

    def lines(sweep: str, key: Callable[[dict[str, Any]], str], chosen: str | None = "filled_bins") -> list[list[str]]:
        votes = of(sweep, VOTE, chosen)
        return [
            [
                key(mean),
                f"{mean['regions']:.0f}",
                f"{1e3 * mean['t_encode_s']:.1f}",
                *(f"{each[figure]:.3f}" for each in (mean, vote) for figure in ("precision_at_100_recall", "auc")),
            ]
            for mean, vote in zip(of(sweep, MEAN, chosen), votes, strict=True)
        ]

    heads = ("regions", "t_e, ms CPU", "P@100%R, mean of cosines", "AUC", "P@100%R, displacement vote", "AUC")

    def best(sweep: str, key: str, score: str = MEAN) -> str:
        first = max(of(sweep, score), key=lambda each: each["precision_at_100_recall"])
        return f"{first[key]:g} ({first['precision_at_100_recall']:.3f})"

    default = next(each for each in of("GT") if each["gt"] == GT)
    top = of("best G", MEAN, None)
    regions = THESIS["cohog"]["mean_regions"]
    said = THESIS["said"]
    return f"""## Figure 6.8: parameters of CoHOG

The thesis sweeps GT, W1 and W2 on ESSEX3IN1; its curves print no numbers. Here on {swept["set"]}
({swept["queries"]} queries), by the thesis's score (the mean of cosines, 6.2.3) and by the displacement vote of
`cohog`,
the regions of a place in full and not in 8 bits. Entropy as the thesis prints it (`filled_bins`); L = 8 throughout.

![Sweeps of GT, W1, W2 and both at the same ratio](../benchmarks/results/thesis_sweep.png)

(a) GT. The thesis: {said["6.8a"]}. Here the most is at GT {best("GT", "gt")} by the mean of cosines,
{default["precision_at_100_recall"]:.3f} at {GT:g}, and at GT {best("GT", "gt", VOTE)} by the vote. Corridor's
pictures are small and dim:
at GT {GT:g} a query has {default["regions"]:.0f} good regions of 961, on the thesis's sets {min(regions.values())} to
{max(regions.values())}.

{markdown(("GT", *heads), lines("GT", lambda each: f"{each['gt']:g}"))}

By Shannon entropy of a small copy, as the author's public code computes it:

{markdown(("GT", *heads), lines("GT", lambda each: f"{each['gt']:g}", "shannon"))}

(b) W1. The thesis: {said["6.8b"]}. Here the most is at {best("W1", "w1")} by the mean of cosines, and at
{best("W1", "w1", VOTE)} by the vote. Corridor's pictures have 160x120 pixels: a larger W1 adds no gradients to them,
only
more and smaller regions of less entropy. The time of encoding grows with the area, as in the thesis.

{markdown(("W1", *heads), lines("W1", lambda each: str(each["w1"])))}

(c) W2. The thesis: {said["6.8c"]}. Here the most is at {best("W2", "w2")} by the mean of cosines, and at
{best("W2", "w2", VOTE)} by the vote. Smaller ones than 16 pixels were left out: nearly 4,000 regions a picture take
sixteen times as long.

{markdown(("W2", *heads), lines("W2", lambda each: str(each["w2"])))}

(d) W1 and W2. The thesis: {said["6.8d"]}. Here the most is at W1 {best("W1/W2", "w1")} by the mean of cosines, and at
{best("W1/W2", "w1", VOTE)} by the vote, and it falls from there: the same picture, enlarged, has less entropy in a
disc of
5 pixels, and GT {GT:g} leaves fewer regions.

{markdown(("W1/W2", *heads), lines("W1/W2", lambda each: f"{each['w1']}/{each['w2']}"))}

Best G instead of GT (the columns Top-200 to Top-800 of table 6.1). The thesis: {said["best G"]}. Here, by the mean of
cosines: {", ".join(f"{each['chosen']} {each['precision_at_100_recall']:.3f}" for each in top)}; GT {GT:g}
{default["precision_at_100_recall"]:.3f} with {default["regions"]:.0f} regions on the mean.

{markdown(("chosen", *heads), lines("best G", lambda each: each["chosen"], None))}
"""


def memorable(results: Results) -> str:
    """Figures 3.10, 3.17, 3.19 and, from the benchmark of the gate, 3.12, 3.20 and 3.21."""
    said, swept = THESIS["said"], results.thesis["thresholds"]
    found = []
    for each in swept:
        for criterion in CRITERIA:
            rows = [row for row in each["rows"] if row["criterion"] == criterion]
            if not rows:
                continue
            full = rows[0]
            some = [row for row in rows if row["queries"] >= full["queries"] / 2]
            best = [f"{some[-1]['auc'][name] - full['auc'][name]:+.3f}" for name in TECHNIQUES]
            lost = [next((row["threshold"] for row in rows if row["kept"] < share), 1.0) for share in (0.95, 0.5, 0.05)]
            found.append([each["set"], criterion, *(f"{at:g}" for at in lost), f"{some[-1]['threshold']:g}", *best])
    heads = ("set", "criterion", "< 95 % kept at", "< 50 %", "< 5 %", "half of the queries left at",
             *(f"AUC there, {name}" for name in TECHNIQUES))  # fmt: skip
    radii = [[name, *(f"{row['entropy']:.3f}" for row in rows)] for name, rows in results.thesis["radius"].items()]
    radius_heads = ("set", *(f"r = {row['radius_px']}" for row in next(iter(results.thesis["radius"].values()))))
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
    return f"""## Figures 3.10, 3.17 and 3.19: thresholds of memorable maps

The thesis sweeps each of the three thresholds on ESSEX3IN1, with MemNet, YOLO and its own networks. Here on
{" and ".join(each["set"] for each in swept)}, with the network of matchability that edgevpr ships (it has seen both
sets in training, and its numbers are other ones than MemNet's), YOLOX-nano and entropy as printed. As in the thesis, a
query that is discarded is a true negative, and all references stay. What moves is not taken out of the other two maps
here, so that each sweep is of one threshold: in the small pictures of corridor the detector sees what is not there.

![AUC and pictures kept against each threshold](../benchmarks/results/thesis_thresholds.png)

{markdown(heads, found)}

"AUC there": by how much the AUC has changed when the threshold leaves half of the queries. The thesis's
sentences: {"; ".join(f"*figure {name}*: {said[name]}" for name in said if name.startswith("3.1") and name != "3.19")}.
The AUC by 2.3 of few queries is small whatever they are (at most (N - 1) / N), so the right end of each curve falls.

Figure 3.19, the entropy score and the radius of its discs. The thesis: {said["3.19"]}. Here, the mean of
20 pictures of each set:

{markdown(radius_heads, radii)}

Figures 3.12, 3.20 and 3.21 (AUC with the gate; what it discards; the size of the map) on the sets here, where it
discards any query ([salience.md](../benchmarks/results/salience.md): networks that have not seen the set, and a
memorability threshold of their own; the thesis's are {", ".join(limits.values())}):

{markdown(gate_heads, gate)}

The thesis found a larger AUC for every technique on every set (figure 3.12), and a larger share of the wrong matches
discarded than of the right ones (figure 3.21). Here the AUC is larger in {larger} of {len(gate)} rows, and the share in
{wronger}. These sets were not made of confusing pictures, as two thirds of ESSEX3IN1 were; and the AUC by 2.3 falls
with
the number of queries that are left.

A frame takes {THESIS["memorable"]["seconds_a_frame"]} s in the thesis (section 3.4.7); here
{speed["all three, yolox_nano"]:.0f} ms with YOLOX-nano, {speed["entropy and memorability"]:.0f} ms without a detector.
"""
