"""Hold this project against the tables and figures of the thesis: `make thesis`.

Measures what no other benchmark does (figures 3.10, 3.17, 3.19 and 6.8, and the similarity matrices that the thesis's
author published) into benchmarks/results/thesis.json, draws the pictures beside it, and writes docs/thesis.md from that
and the results of the other benchmarks. The values of the thesis stand in thesis.yaml, each with its source.
"""

import argparse
import csv
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import thesis_memorable
import thesis_page
import thesis_pictures
import thesis_sweep
from run_sets import DATA, made_by
from thesis_values import read_results

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.frames.images import cv2
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset, read_truth
from edgevpr.lab.evaluate.similarity import measure, read_similarities

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
SWEPT = "corridor"
GATED = ("corridor", "grief_stromovka_seasons")
MATRICES = "vprbench_precomputed"
RADIUS_PICTURES = 20


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--page", action="store_true", help="measure nothing: page and pictures of what is there")
    args = parser.parse_args(argv)
    try:
        if not args.page:
            measured = measure_all(args.data)
            (RESULTS / "thesis.json").write_text(json.dumps(measured, indent=1) + "\n")
        results = read_results(RESULTS)
        thesis_pictures.draw(results, RESULTS)
        (REPOSITORY / "docs" / "thesis.md").write_text(thesis_page.page(results), encoding="utf-8")
    except EdgevprError as error:
        print(f"thesis: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def measure_all(data: Path) -> dict:
    """Measure everything; minutes of one core. Raises UsageError where a set is not there."""
    for name in (*GATED, MATRICES):
        if not (data / name).is_dir():
            raise UsageError(f"{data} has no `{name}`: name the folder of the image sets with --data or EDGEVPR_DATA.")
    cv2.setNumThreads(1)
    start_s = time.process_time()
    sets = {name: opened(data / name) for name in GATED}
    with tempfile.TemporaryDirectory(prefix="edgevpr-thesis-") as cards:
        os.environ["EDGEVPR_MODELS"] = cards
        both = thesis_memorable.networks(Path(cards))
        gates = [thesis_memorable.thresholds(name, dataset, *both) for name, dataset in sets.items()]
    radii = {
        name: thesis_memorable.entropy_by_radius([each.path for each in dataset.queries[:RADIUS_PICTURES]])
        for name, dataset in sets.items()
    }
    measured = {
        "matrices": matrices(data / MATRICES, data / SWEPT),
        "thresholds": gates,
        "radius": radii,
        "sweep": {"set": SWEPT, "queries": len(sets[SWEPT].queries), "points": thesis_sweep.sweep(sets[SWEPT])},
    }
    return {**made_by(), "cpu_s": time.process_time() - start_s, **measured}


def opened(folder: Path) -> Dataset:
    """Open the data set of a folder."""
    return load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")


def matrices(folder: Path, images: Path) -> dict[str, dict]:
    """Measure every stored similarity matrix of the author, as `edgevpr eval --similarity` does, and add the times that
    he published with them."""
    with open(folder / f"{SWEPT}_figures.csv", newline="") as handle:
        times = {row["technique"]: row for row in csv.DictReader(handle)}
    truth = read_truth(images / "ground_truth.csv")
    found = {}
    for path in sorted(folder.glob(f"{SWEPT}_*.npy")):
        name = path.stem.removeprefix(f"{SWEPT}_")
        published = {key: float(times[name][key]) for key in ("t_encode_s", "t_match_per_ref_s")}
        found[name] = {**asdict(measure(name, read_similarities(path), truth)), **published}
    return found


if __name__ == "__main__":
    sys.exit(main())
