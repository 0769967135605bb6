"""Hold this project against the tables and figures of the thesis: `make thesis`.

Measures what no other benchmark does (figures 3.10, 3.17, 3.19 and 6.8, and the similarity matrices that the thesis's
author published) into benchmarks/results/thesis.json, draws the pictures beside it, and writes docs/thesis.md from that
and the results of the other benchmarks. The values of the thesis stand in thesis.yaml, each with its source.
"""

import argparse
import csv
import os
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import base
import thesis_memorable
import thesis_page
import thesis_pictures
import thesis_sweep
import walks
from base import DATA, REPOSITORY, RESULTS, Row
from thesis_values import read_results

from edgevpr.lab.evaluate.dataset import read_truth
from edgevpr.lab.evaluate.similarity import measure, read_similarities

SWEPT = "corridor"
GATED = ("corridor", "grief_stromovka_seasons")
MATRICES = "vprbench_precomputed"
RADIUS_PICTURES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--page", action="store_true", help="measure nothing: page and pictures of what is there")
    if not parser.parse_args().page:
        base.write_json("thesis", measure_all())
    results = read_results(RESULTS)
    thesis_pictures.draw(results, RESULTS)
    (REPOSITORY / "docs" / "thesis.md").write_text(thesis_page.page(results), encoding="utf-8")


def measure_all() -> Row:
    """Measure everything; minutes of one core."""
    start_s, sets = (
        time.process_time(),
        {folder.name: walks.dataset_of(folder) for folder in base.find_sets(names=GATED)},
    )
    with tempfile.TemporaryDirectory(prefix="edgevpr-thesis-") as cards:
        os.environ["EDGEVPR_MODELS"] = cards
        both = thesis_memorable.networks(Path(cards))
        gates = [thesis_memorable.thresholds(name, dataset, *both) for name, dataset in sets.items()]
    radii = {
        name: thesis_memorable.entropy_by_radius([each.path for each in dataset.queries[:RADIUS_PICTURES]])
        for name, dataset in sets.items()
    }
    measured = {
        "matrices": matrices(DATA / MATRICES, DATA / SWEPT),
        "thresholds": gates,
        "radius": radii,
        "sweep": {"set": SWEPT, "queries": len(sets[SWEPT].queries), "points": thesis_sweep.sweep(sets[SWEPT])},
    }
    return {**base.made_by(), "cpu_s": time.process_time() - start_s, **measured}


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
    base.run(main)
