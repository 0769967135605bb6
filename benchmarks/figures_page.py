"""Write the figures of benchmarks/results/ between the two markers of docs/figures.md: none is typed by hand."""

from pathlib import Path
from typing import Any

import base
import sets_page
from base import REPOSITORY, RESULTS, format_markdown_table

BEGIN_MARKER = "<!-- figures: made by benchmarks/figures_page.py -->\n"
END_MARKER = "<!-- end of figures -->"


def main() -> None:
    write_figures(REPOSITORY / "docs" / "figures.md")


def write_figures(page: Path) -> None:
    """Write the figures between the markers of a page."""
    figures = f"{format_recall(sets_page.read_sets(RESULTS))}\n\n{format_speed()}"
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN_MARKER)
    _, _, after = rest.partition(END_MARKER)
    page.write_text(f"{before}{BEGIN_MARKER}\n{figures}\n\n{END_MARKER}{after}", encoding="utf-8")


def format_recall(contents: list[dict[str, Any]]) -> str:
    """Return recall@1 of every technique and of every reduced form on every set, and the matches accepted in flight."""
    weights = {row["weights"] for content in contents for row in content["techniques"].values() if row["weights"]}
    accepted_lines = []
    for content in contents:
        name = "cohog" if "cohog" in content["techniques"] else "hog"
        line = "* {set}: `{name}`, {accepted} of {queries}, {accepted_wrong} wrong"
        if content["techniques"][name]["queries_off_map"]:
            line += "; {accepted_off_map} of the {queries_off_map} off the map"
        accepted_lines.append(line.format(set=content["set"], name=name, **content["techniques"][name]))
    return (
        "Recall@1, made by `make results`. In brackets: the use of a set, and its number of queries whose place is in "
        "the map:\n\n"
        f"{sets_page.format_recall_table(contents, lambda label: not label.endswith(sets_page.FORM_SUFFIXES))}\n\n"
        "The same vectors minus the mean of the map, with one byte or one bit per number:\n\n"
        f"{sets_page.format_recall_table(contents, lambda label: label.endswith(sets_page.FORM_SUFFIXES))}\n\n"
        f"Weights in use: {'; '.join(sorted(weights))}.\n\n"
        f"![Precision-recall curves of all techniques on all sets](../benchmarks/results/{sets_page.CURVES})\n\n"
        "Matches accepted by the rule of the flight:\n\n" + "\n".join(accepted_lines)
    )


def format_speed() -> str:
    """Return the figures of `make bench` for builders of aircraft."""
    content = base.read("bench")
    machine = content["machine"]
    rows = [[f"encode a frame ({row['entropy']})", f"{row['ours_ms']:.1f} ms", "-"] for row in content["encode"]]
    (match,) = content["match"]
    rows.append(["compare one place in full", f"{match['ours_ms']:.2f} ms", "-"])
    for row in content["two_stage"]:
        ratio = f"{row['ratio']:.0f}x faster than comparing all in full" if row["ratio"] else row["beside"]
        rows.append([f"query, 10 000 places, {row['camera']}", f"{row['two_stage_ms']:.0f} ms", ratio])
    sizes = " or ".join(str(size) for size in sorted({row["bytes_per_place"] for row in content["two_stage"]}))
    rows.append(["RAM of a place, ahead or down", f"{sizes} bytes", "the thesis's: 123 008"])
    rows += [[row["what"], f"{row['value']:.3g} {row['unit']}", "10 000 places"] for row in content["flight"]]
    return (
        f"Speed and memory on one thread of an {machine['cpu']}, made by `make bench`:\n\n"
        f"{format_markdown_table(('what', 'measured', 'comparison'), rows)}"
    )


if __name__ == "__main__":
    base.run(main)
