"""The page that sums up the result files of the image sets, `sets.md`, and its precision-recall curves."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import base
from base import Row

from edgevpr.lab.evaluate import tables
from edgevpr.lab.evaluate.metrics import TechniqueResult, read_result

Results = Mapping[str, Sequence[TechniqueResult]]  # by the name of the set

CURVES = "curves.png"
_MAX_COLUMNS = 3  # of panels
_QUALITY_COLUMNS = (*tables.RECALLS, *tables.CURVE, *tables.DECISIONS)
_COST_SETS = ("grief_stromovka_seasons", "aerial_swindale")  # whose costs are shown: ahead, and down
# More than ten colours cannot be told apart: after ten curves the line style changes.
_LINE_STYLES = ("-", "--", ":", "-.")
FORM_SUFFIXES = (" 8bit", " 1bit")  # of a vector
# What is drawn: forms, and what is the same technique under other conditions, would hide the rest.
_SUFFIXES_WITHOUT_CURVE = (*FORM_SUFFIXES, ", exact", ", one frame", " candidates")

_ABOUT = """\
`cohog` is as it flies: a scan of 144 bytes a place (looking down 1120), then the displacement vote over the best
places; in the aerial sets its camera looks straight down (`--camera nadir`: the picture laid into a square, 24
rotations of the query). `cohog, known` is told heading and height of every query (`--known heading,height`), where a
set has headings. In sat_marash, tiles of pictures from space, they are exact; where its sites lie on Earth is invented.
*aerial_joined* is all sets from the air as one map, those that were tuned on too. `cohog, exact` votes over all places,
under all rotations. `cohog, thesis` scores as published, on the whole picture. A vector is kept in half precision; as
`8bit` or `1bit` it is less the map's mean, a byte or a bit a number. Parameters and limits of acceptance were chosen on
the sets marked *tune*. Some figures of cohog were fixed after other sets had been seen, and are to be judged with that
in mind: of a place code the least overlap (half), its size (12x12 cells) and its Fourier series; how many places are
compared ahead (42), with aerial_swindale; how many of them a glance leaves to be compared in full (12), and that it
looks at a quarter of the regions, with all sets; that the scan counts in the score, ahead, with grief_stromovka_seasons
and nordland_tiny; what a vote counts that is off the peak (ahead 1, 1, 0.75, 0.5) and how many patterns of a region are
compared (20 of 32), both with grief_stromovka_seasons; how many landmarks prove a place (10) and from which score on
some must agree (0.2), with all sets from the air; how far an unknown tilt is thought to be (3 degrees), and that from
other heights two fifths of the usual pairs are compared from each, and how much a dim picture is stretched and
smoothed, with aerial_swindale; and the margin of `cohog, thesis` (0.02, with pictures of foreign sites). The shipped
weights of calc, on which the networks run, have seen the pictures of aerial_caliterra and aerial_brighton in training:
what networks reach there is not clean. A sequence wants a flight along the mapped way; only corridor,
grief_stromovka_seasons and nordland_tiny are such. The pictures of nordland_tiny have 64x32 pixels, which every
technique enlarges: it is here for its thousand places. Of a network other than the shipped one nothing is accepted
before the user says from when on. The truth of the aerial sets was computed by image registration: it favours pairs
that local features can match, and says nothing of others. Of the forms of vectors only recall is shown: the JSON files
beside this page hold every figure.
"""


def read_sets(folder: Path) -> list[Row]:
    """Read the results of all image sets in a folder."""
    contents = [base.read(path.stem, folder) for path in sorted(folder.glob("*.json"))]
    return [{**content, "techniques": index_rows(content)} for content in contents if "ah_assumes" in content]


def index_rows(content: Row) -> dict[str, Row]:
    """Return the rows of a file of results ({}: there is none) by the technique."""
    return {row["technique"]: {"ah_assumes": content["ah_assumes"], **row} for row in content.get("rows", ())}


def select_match_figures(row: Row) -> Row:
    """Return the figures of a row of a file of the queries whose place is in the map."""
    return row["with_match"] or row


def has_curve(label: str) -> bool:
    """Return whether a row has a curve."""
    return not label.endswith(_SUFFIXES_WITHOUT_CURVE)


def write_page(folder: Path, left_out: dict[str, str]) -> None:
    """Sum up all files of `folder`; `left_out` says of sets that are not there why."""
    contents = read_sets(folder)
    results = {content["set"]: [read_result(row) for row in content["techniques"].values()] for content in contents}
    curves = {name: [result for result in rows if has_curve(result.technique)] for name, rows in results.items()}
    plot_curves(curves, folder / CURVES)
    (folder / "sets.md").write_text(_format_page(contents, results, left_out))


def plot_curves(results: Results, path: Path) -> None:
    """Draw one panel per data set with one curve of all its queries per technique, best AUC first in the legend, and
    write them to `path`. A curve of one point, where all scores are the same, is drawn as a mark."""
    columns = min(len(results), _MAX_COLUMNS)
    rows = -(-len(results) // columns)
    figure, axes = base.make_panels(5.2 * columns, 4.6 * rows, len(results), rows)
    # The order of all names gives a technique the same line in every panel.
    names = list(dict.fromkeys(result.technique for compared in results.values() for result in compared))
    for axis, (title, compared) in zip(axes, results.items(), strict=True):
        for result in sorted(compared, key=lambda result: -result.auc_from_zero):
            number = names.index(result.technique)
            precision, recall = zip(*result.precision_recall, strict=True)
            label, mark = f"{result.technique} {result.auc_from_zero:.2f}", "o" if len(recall) == 1 else None
            line, colour = _LINE_STYLES[number // 10 % len(_LINE_STYLES)], f"C{number % 10}"
            axis.plot(recall, precision, line, color=colour, marker=mark, label=label)
        axis.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision", title=title)
        # Below the panel, where it hides no curve.
        axis.legend(title="AUC", fontsize=7, title_fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13))
    base.save_figure(figure, path, dpi=60)


def _format_page(contents: list[Row], results: Results, left_out: dict[str, str]) -> str:
    commits = [", ".join(sorted({row["commit"] for row in _list_rows(content)})) for content in contents]
    origins = [
        [content["set"], content["use"], content["date"], own_commits]
        for content, own_commits in zip(contents, commits, strict=True)
    ]
    machine = contents[0]["machine"]
    pairs = [
        (content["set"], row)
        for content in contents
        for label, row in content["techniques"].items()
        if not label.endswith(FORM_SUFFIXES)
    ]
    reached = [[name, *cells] for name, row in pairs for cells in tables.make_rows(read_result(row), _QUALITY_COLUMNS)]
    costs = [
        (name, row, *tables.make_rows(read_result(row), tables.COSTS, include_in_map=False)) for name, row in pairs
    ]
    paid = [[name, *cells, row["cpu"]] for name, row, cells in costs if name in _COST_SETS]
    old = [content["set"] for content in contents if any("unscored" not in row for row in _list_rows(content))]
    weights = sorted({result.weights for rows in results.values() for result in rows if result.weights})
    page = f"""# Every technique on real images

Made by `make results` with {machine["cores"]} cores, BLAS threads: {machine["blas_threads"]}; the table of costs names
the machine of each row. Python {machine["python"]}, NumPy {machine["numpy"]}, OpenCV {machine["opencv"]}.

{base.format_markdown_table(("set", "use", "date", "commit"), origins)}

{_ABOUT}
Weights in use:

{chr(10).join(f"* {result}" for result in weights)}

## Recall@1

Of the queries whose place is in the map:

{format_recall_table(contents)}

![Precision-recall curves]({CURVES})

## Recognition

{base.format_markdown_table(("set", *tables.list_headings(_QUALITY_COLUMNS)), reached)}

Rows are of all queries; where some have no place in the map, those called *in map* are of the others alone. Sets that
were measured before such queries were counted: {", ".join(old) or "none"}.

{chr(10).join(f"* {result}" for result in tables.ABOUT_FIGURES)}
* P@100%R: precision with the threshold at the lowest-scoring right match. R@100%P: recall with the threshold above the
  highest-scoring wrong one. EP: equation 2.4 of the thesis, as in VPR-Bench.
* ROC: the chance that a right match scores higher than a wrong one; 0.5 means that the score by itself tells nothing.
* PCU: P@100%R x log10(t_e,max / t_e + 9), t_e,max of the slowest encoder on the same set; by machine, too (see costs).
* accepted: queries that would have moved the aircraft by the technique's own rule; in brackets, how many of them would
  have moved it to a wrong place. off the map: how many of the queries without a place in the map were accepted.

## Costs

{base.format_markdown_table(("set", *tables.list_headings(tables.COSTS), "machine"), paid)}

* Means over the queries; t_m is for all references. U: share of all cores. Of the other sets the JSON files have them.
* mAh: {contents[0]["ah_assumes"]}.
"""
    if left_out:
        page += "\n## Left out\n\n"
        for name, why in left_out.items():
            page += f"* {name}: {why}.\n"
    return page


def format_recall_table(contents: list[Row], wanted: Callable[[str], bool] = lambda label: True) -> str:
    """Recall@1 of every `wanted` technique (down) on every set (across), of the queries whose place is in the map, as a
    Markdown table."""
    rows = []
    for label in filter(wanted, dict.fromkeys(label for content in contents for label in content["techniques"])):
        rows_of_sets = [content["techniques"].get(label) for content in contents]
        sizes = sorted({row["descriptor_bytes"] for row in rows_of_sets if row})  # those of cohog differ by camera
        recalls = ("-" if row is None else f"{select_match_figures(row)['recall_at_1']:.2f}" for row in rows_of_sets)
        rows.append([label, " or ".join(map(str, sizes)), *recalls])
    queries = [select_match_figures(_list_rows(content)[0])["queries"] for content in contents]
    heads = [f"{content['set']} ({content['use']}, {count})" for content, count in zip(contents, queries, strict=True)]
    return base.format_markdown_table(("technique", "RAM B/place", *heads), rows)


def _list_rows(content: Row) -> list[Row]:
    return list(content["techniques"].values())
