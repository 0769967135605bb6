"""Every speed and memory figure in one run: `make bench` writes benchmarks/results/bench.md and bench.json.

Figures of competitors stand beside ours from the same, interleaved run: on a busy machine the ratios hold, the times do
not.
"""

import base
import bench_flight
import bench_stages
from base import Row

COLUMNS = {
    "encode": {
        "encode `cohog`": "{entropy}",
        "edgevpr ms": "{ours_ms:.2f}",
        "published way ms": "{competitor_ms:.1f}",
        "ratio": "{ratio:.1f}",
        "largest difference of a descriptor value": "{worst_difference:.1e}",
        "good regions that differ": "{good_differing}",
    },
    "match": {
        "compare one place": "{references} references",
        "edgevpr with vote ms": "{ours_ms:.2f}",
        "published way, no vote, ms": "{competitor_ms:.2f}",
        "ratio": "{ratio:.2f}",
    },
    "two_stage": {
        "a query, 10 000 places": "{camera}",
        "candidates": "{candidates}",
        "encode ms": "{encode_ms:.1f}",
        "whole query ms": "{two_stage_ms:.0f}",
        "exact over all s": "{exact_s:.1f}",
        "ratio": "{ratio:.0f}",
        "bytes a place in RAM": "{bytes_per_place}",
    },
    "flight": {
        "`edgevpr run`, cohog, 10 000 places": "{what}",
        "measured": "{value:.3g} {unit}",
        "target": "< {target:g} {unit}",
    },
}


def main() -> None:
    found = base.made_by()
    for name, rows in {**bench_stages.ROWS, "flight": bench_flight.rows}.items():
        found[name] = list(rows())
    base.write("bench", found, page(found))


def page(found: Row) -> str:
    """Return the page for people."""
    ran_on = found["machine"]
    tables = {name: base.table(found[name], columns) for name, columns in COLUMNS.items()}
    return f"""# Speed and memory

Made by `make bench` on {found["date"]}, commit {found["commit"]}.
Machine: {ran_on["cpu"]}, {ran_on["cores"]} cores; one thread; Python {ran_on["python"]}, NumPy {ran_on["numpy"]},
OpenCV {ran_on["opencv"]}. Medians; ratios are taken turn by turn in one interleaved run.

## Encoding a frame

The published way is written plainly in `benchmarks/competitor.py`.

{tables["encode"]}

## Comparing one place in full

{tables["match"]}

## A query over 10 000 places

{tables["two_stage"]}

## The whole program

{tables["flight"]}
"""


if __name__ == "__main__":
    base.run(main)
