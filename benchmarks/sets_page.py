"""The page `sets.md`, which summarises the result files of the image sets, and its precision-recall curves."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path

import base
from base import Row

from edgevpr.lab.evaluate import tables
from edgevpr.lab.evaluate.metrics import Figures, TechniqueResult

Results = Mapping[str, Sequence[TechniqueResult]]  # by the name of the set

CURVES = "curves.png"
_MAX_COLUMNS = 3  # panels of curves side by side
_QUALITY_COLUMNS = (*tables.RECALLS, *tables.CURVE, *tables.DECISIONS)
_COST_SETS = ("grief_stromovka_seasons", "aerial_swindale")  # the sets whose costs are shown: one forward, one nadir
# There are ten distinct colours, so the line style changes after ten curves.
_LINE_STYLES = ("-", "--", ":", "-.")
FORM_SUFFIXES = (" 8bit", " 1bit")  # forms of a vector
# No curves for vector forms and for variants of the same technique, which would hide the others.
_SUFFIXES_WITHOUT_CURVE = (*FORM_SUFFIXES, ", exact", ", one frame", " candidates")

_ABOUT = """\
`cohog` is measured as it flies: a scan of 144 bytes per place (1120 for nadir cameras), then the displacement vote over
the best places. In the aerial sets the camera looks straight down (`--camera nadir`: each picture is fitted into a
square, and the query is compared at 24 rotations). `cohog, known` gets the heading and height of every query (`--known
heading,height`), where a set has headings. In sat_marash (tiles of satellite pictures) these are exact, and the
positions of the sites are invented. *aerial_joined* is one map of all aerial sets, including the tuned ones. `cohog,
exact` votes over all places and rotations. `cohog, thesis` scores as published, on the whole picture. Vectors are
stored in half precision; the forms `8bit` and `1bit` subtract the map's mean and store a byte or a bit per number.
Parameters and acceptance limits were chosen on the sets marked *tune*. Some parameters of cohog were chosen after other
sets had been seen, so judge its figures there with care: for the place code, the minimum overlap (half), the size
(12x12 cells) and the Fourier series; the number of places that forward cameras compare (42), with aerial_swindale; the
number of these that the quick score leaves for the full comparison (12), and the quarter of the regions that the quick
score uses, with all sets; that the scan counts in the score of forward cameras, with grief_stromovka_seasons and
nordland_tiny; the weight of a vote off the peak (forward: 1, 1, 0.75, 0.5) and the number of patterns compared per
region (20 of 32), both with grief_stromovka_seasons; the number of landmarks that prove a place (10) and the score from
which some must agree (0.2), with all aerial sets; the assumed limit of an unknown tilt (3 degrees), the share of the
usual pairs that is compared for each other height (two fifths), and how much a dim picture is stretched and smoothed,
with aerial_swindale; and the margin of `cohog, thesis` (0.02, with pictures of foreign sites). The shipped weights of
calc, which all networks use, were trained on pictures of aerial_caliterra and aerial_brighton, so figures of networks
on these sets are not independent. Sequences need a flight along the mapped route, as in corridor,
grief_stromovka_seasons and nordland_tiny. The pictures of nordland_tiny have 64x32 pixels, which every technique
enlarges: the set is here for its thousand places. Matches of any network except the shipped one are accepted only once
the user has set limits. The truth of the aerial sets was computed by image registration, which favours pairs that local
features can match, and leaves out others. Of vector forms only recall is shown; the JSON files have every figure.
"""


def read_sets(folder: Path) -> list[Row]:
    """Read the results of all image sets in a folder."""
    contents = [base.read(path.stem, folder) for path in sorted(folder.glob("*.json"))]
    return [{**content, "techniques": index_rows(content)} for content in contents if "ah_assumes" in content]


def index_rows(content: Row) -> dict[str, Row]:
    """Return the rows of a result file by technique; none if `content` is empty because there is no such file."""
    return {row["technique"]: {"ah_assumes": content["ah_assumes"], **row} for row in content.get("rows", ())}


def select_match_figures(row: Row) -> Row:
    """Return the figures of a row for those queries whose place is in the map."""
    return row["with_match"] or row


def has_curve(label: str) -> bool:
    """Return True if the precision-recall curve of a row is drawn."""
    return not label.endswith(_SUFFIXES_WITHOUT_CURVE)


def read_result(row: Row) -> TechniqueResult:
    """Return the result whose fields are in `row`, as read from JSON. Other keys of `row` are ignored."""
    values = {field.name: row[field.name] for field in fields(TechniqueResult) if field.name in row}
    return TechniqueResult(**{**values, "with_match": values.get("with_match") and Figures(**values["with_match"])})


def write_page(folder: Path, left_out: dict[str, str]) -> None:
    """Write the page and curves of all result files of `folder`; `left_out` maps the sets left out to the reasons."""
    contents = read_sets(folder)
    results = {content["set"]: [read_result(row) for row in content["techniques"].values()] for content in contents}
    curves = {name: [result for result in rows if has_curve(result.technique)] for name, rows in results.items()}
    plot_curves(curves, folder / CURVES)
    (folder / "sets.md").write_text(_format_page(contents, results, left_out))


def plot_curves(results: Results, path: Path) -> None:
    """Draw a panel per image set, with a precision-recall curve per technique and the best AUC first in the legend, to
    `path`. A curve of a single point (all scores are equal) is drawn as a mark."""
    columns = min(len(results), _MAX_COLUMNS)
    rows = -(-len(results) // columns)
    figure, axes = base.make_panels(5.2 * columns, 4.6 * rows, len(results), rows)
    # Colours follow the order of all names, so that a technique has the same line in every panel.
    names = list(dict.fromkeys(result.technique for set_results in results.values() for result in set_results))
    for axis, (title, set_results) in zip(axes, results.items(), strict=True):
        for result in sorted(set_results, key=lambda result: -result.auc_from_zero):
            number = names.index(result.technique)
            precision, recall = zip(*result.precision_recall, strict=True)
            label, mark = f"{result.technique} {result.auc_from_zero:.2f}", "o" if len(recall) == 1 else None
            line, colour = _LINE_STYLES[number // 10 % len(_LINE_STYLES)], f"C{number % 10}"
            axis.plot(recall, precision, line, color=colour, marker=mark, label=label)
        axis.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision", title=title)
        # The legend is below the panel, where it hides no curve.
        axis.legend(title="AUC", fontsize=7, title_fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13))
    base.save_figure(figure, path, dpi=60)


def _format_page(contents: list[Row], results: Results, left_out: dict[str, str]) -> str:
    origins = [
        [content["set"], content["use"], content["date"], ", ".join(sorted({row["commit"] for row in rows}))]
        for content, rows in zip(contents, map(_list_rows, contents), strict=True)
    ]
    machine = contents[0]["machine"]
    pairs = [
        (content["set"], row)
        for content in contents
        for label, row in content["techniques"].items()
        if not label.endswith(FORM_SUFFIXES)
    ]
    quality = [[name, *cells] for name, row in pairs for cells in tables.make_rows(read_result(row), _QUALITY_COLUMNS)]
    costs = [
        (name, row, *tables.make_rows(read_result(row), tables.COSTS, include_in_map=False)) for name, row in pairs
    ]
    cost_rows = [[name, *cells, row["cpu"]] for name, row, cells in costs if name in _COST_SETS]
    outdated = [content["set"] for content in contents if any("unscored" not in row for row in _list_rows(content))]
    weights = sorted({result.weights for rows in results.values() for result in rows if result.weights})
    page = f"""# Every technique on real images

Made by `make results` with {machine["cores"]} cores, BLAS threads: {machine["blas_threads"]}; the table of costs has
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

{base.format_markdown_table(("set", *tables.list_headings(_QUALITY_COLUMNS)), quality)}

Rows count all queries; where some queries have no place in the map, rows marked *in map* count only the others. Sets
that were measured before such queries were counted: {", ".join(outdated) or "none"}.

{chr(10).join(f"* {result}" for result in tables.ABOUT_FIGURES)}
* P@100%R: precision with the threshold at the lowest-scoring right match. R@100%P: recall with the threshold above the
  highest-scoring wrong match. EP: equation 2.4 of the thesis, as in VPR-Bench.
* ROC: the probability that a right match scores higher than a wrong one; 0.5 means that the score is uninformative.
* PCU: P@100%R x log10(t_e,max / t_e + 9), t_e,max of the slowest encoder on the same set; depends on the machine, too.
* accepted: queries whose match would have been sent to the autopilot by the technique's own rule; in brackets, how many
  of these matches were wrong. off the map: accepted queries of those that have no place in the map.

## Costs

{base.format_markdown_table(("set", *tables.list_headings(tables.COSTS), "machine"), cost_rows)}

* Means over the queries; t_m is for all references. U: share of all cores. The JSON files have those of other sets.
* mAh: {contents[0]["ah_assumes"]}.
"""
    if left_out:
        page += "\n## Left out\n\n"
        for name, why in left_out.items():
            page += f"* {name}: {why}.\n"
    return page


def format_recall_table(contents: list[Row], is_shown: Callable[[str], bool] = lambda label: True) -> str:
    """Return a Markdown table of recall@1 for the queries whose place is in the map: a row per technique (label) that
    `is_shown`, a column per set."""
    rows = []
    for label in filter(is_shown, dict.fromkeys(label for content in contents for label in content["techniques"])):
        rows_of_sets = [content["techniques"].get(label) for content in contents]
        sizes = sorted({row["descriptor_bytes"] for row in rows_of_sets if row})  # cohog: depends on the camera
        recalls = ("-" if row is None else f"{select_match_figures(row)['recall_at_1']:.2f}" for row in rows_of_sets)
        rows.append([label, " or ".join(map(str, sizes)), *recalls])
    queries = [select_match_figures(_list_rows(content)[0])["queries"] for content in contents]
    heads = [f"{content['set']} ({content['use']}, {count})" for content, count in zip(contents, queries, strict=True)]
    return base.format_markdown_table(("technique", "RAM B/place", *heads), rows)


def _list_rows(content: Row) -> list[Row]:
    return list(content["techniques"].values())
