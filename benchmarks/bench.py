"""Every speed and memory figure in one run: `make bench` writes benchmarks/results/bench.md, bench.json and growth.png.

Figures of competitors stand beside ours from the same, interleaved run: on a busy machine the ratios hold, the times do
not.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import json
from dataclasses import asdict
from pathlib import Path

import bench_card
import bench_encode
import bench_flight
import bench_match
import bench_scan
import bench_two_stage
from run_sets import made_by

RESULTS = Path(__file__).resolve().parent / "results"


def main() -> None:
    RESULTS.mkdir(exist_ok=True)
    made = made_by()
    measured = {}
    for name, measure in {
        "encode": bench_encode.rows,
        "match": lambda: [bench_match.row()],
        "two_stage": bench_two_stage.rows,
        "card": bench_card.rows,
        "binary_scan": bench_scan.binary_rows,
        "growth": bench_scan.growth_rows,
        "flight": bench_flight.rows,
    }.items():
        print(f"measuring: {name}", flush=True)
        measured[name] = measure()
    plain = {name: [row if isinstance(row, dict) else asdict(row) for row in rows] for name, rows in measured.items()}
    (RESULTS / "bench.json").write_text(json.dumps({**made, **plain}, indent=2) + "\n")
    plot_growth(measured["growth"], RESULTS / "growth.png")
    page = report(measured, made)
    (RESULTS / "bench.md").write_text(page)
    print(page)


def plot_growth(rows: list[dict], path: Path) -> None:
    """Time of a query's scan and memory of the index against the number of places, both logarithmic."""
    import matplotlib.pyplot as plt

    figure, (time_axes, ram_axes) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for rotations, colour in ((1, "tab:blue"), (24, "tab:orange")):
        these = [row for row in rows if row["rotations"] == rotations]
        places, scan_ms = [row["places"] for row in these], [row["t_scan_ms"] for row in these]
        label = "camera ahead" if rotations == 1 else "straight down"
        time_axes.loglog(places, scan_ms, "o-", color=colour, label=label)
        linear_ms = [scan_ms[-1] * count / places[-1] for count in places]
        time_axes.loglog(places, linear_ms, ":", color=colour, alpha=0.6)
        each = f"{label}: {these[0]['place_bytes']} bytes a place"
        ram_axes.loglog(places, [row["index_mb"] for row in these], "o-", color=colour, label=each)
    time_axes.set(xlabel="places", ylabel="scan of all places, ms", title="time of the scan (dotted: linear)")
    ram_axes.set(xlabel="places", ylabel="in RAM, MB", title="memory of the places")
    for axes in (time_axes, ram_axes):
        axes.legend(frameon=False)
        axes.grid(alpha=0.3, which="both")
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def report(measured: dict, made: dict) -> str:
    """The page for people."""
    ran_on = made["machine"]
    binary = "\n".join(
        f"| {row['what']} | {row['t_ms']:.2f} | {row['gb_per_s']:.1f} | {row['of_byte_sum']:.0%} "
        f"| {row['of_word_sum']:.0%} |"
        for row in measured["binary_scan"]
    )
    growth = "\n".join(
        f"| {row['places']} | {row['rotations']} | {row['place_bytes']} | {row['t_scan_ms']:.1f} "
        f"| {row['index_mb']:.2f} |"
        for row in measured["growth"]
    )
    return f"""# Speed and memory

Made by `make bench` on {made["date"]}, commit {made["commit"]}.
Machine: {ran_on["cpu"]}, {ran_on["cores"]} cores; one thread; Python {ran_on["python"]}, NumPy {ran_on["numpy"]},
OpenCV {ran_on["opencv"]}. Medians; ratios are taken turn by turn in one interleaved run.

## Encoding a frame

The published way is written plainly in `benchmarks/competitor.py`; the floor is the resize and two Sobel passes alone.

{bench_encode.table(measured["encode"])}

## Comparing one place in full

{bench_match.table(measured["match"][0])}

## A query over 10 000 places

{bench_two_stage.table(measured["two_stage"])}

## Reading from a card

What one query reads of a map of 10 000 places that is not in the page cache, and what that takes beside the query
itself on a card of {bench_card.CARD_MB_PER_S:g} MB/s:

{bench_card.table(measured["card"])}

## Scan of binary vectors, 100 000 x 512 bits

| what | ms | GB/s | of the sum of bytes | of the sum of 64-bit words |
|---|---|---|---|---|
{binary}

## Growth of the scan

| places | rotations | bytes a place | scan ms | RAM MB |
|---|---|---|---|---|
{growth}

![growth](growth.png)

## The whole program

{bench_flight.table(measured["flight"])}
"""


if __name__ == "__main__":
    main()
