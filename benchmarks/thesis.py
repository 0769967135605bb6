"""Compare this project with the tables and figures of the thesis: `make thesis`.

Computes the figures of the similarity matrices that the thesis's author published, which no other benchmark does, to
benchmarks/results/thesis.json, draws the curves, and writes docs/thesis.md from this file and the results of the other
benchmarks. The values of the thesis are in thesis.yaml, each with its source.
"""

import argparse
from pathlib import Path

import base
import numpy as np
import thesis_page
from base import DATA, REPOSITORY, RESULTS
from thesis_values import MATRICES, Results, read_results, select_rows

from edgevpr.lab.evaluate.dataset import list_names, read_truth
from edgevpr.lab.evaluate.metrics import compute_quality, rank_of_first_correct

SET_NAME = "corridor"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--page", action="store_true", help="only write page and curves, from existing results")
    if not parser.parse_args().page:
        matrices = measure_matrices(DATA / "vprbench_precomputed", DATA / SET_NAME)
        base.write_json("thesis", {**base.describe_run(), "matrices": matrices})
    results = read_results(RESULTS)
    draw_curves(results, RESULTS / "thesis_curves.png")
    (REPOSITORY / "docs" / "thesis.md").write_text(thesis_page.format_page(results), encoding="utf-8")


def measure_matrices(folder: Path, images: Path) -> dict[str, dict]:
    """Return the figures of each similarity matrix of the author (a row per query, a column per reference), with the
    times in seconds that he published with it, by technique."""
    times = {row["technique"]: row for row in base.read_csv(folder / f"{SET_NAME}_figures.csv")}
    references, truth = list_names(images / "ref"), read_truth(images / "ground_truth.csv")
    correct = np.array([[name in answers[0] for name in references] for answers in truth.values()])
    figures = {}
    for path in sorted(folder.glob(f"{SET_NAME}_*.npy")):
        name = path.stem.removeprefix(f"{SET_NAME}_")
        published = {key: float(times[name][key]) for key in ("t_encode_s", "t_match_per_ref_s")}
        scores = np.load(path)
        orders = np.argsort(-scores, axis=1, kind="stable")
        ranks = np.array([rank_of_first_correct(*row) for row in zip(orders, correct, strict=True)])
        figures[name] = compute_quality(scores.max(axis=1), ranks, correct.any(axis=1)) | published
    return figures


def draw_curves(results: Results, path: Path) -> None:
    """Draw the precision-recall curves on corridor: of the author's matrices, and of the techniques of this project."""
    theirs = {name: results.thesis["matrices"][matrix] for name, matrix in MATRICES.items()}
    ours = select_rows(results, "corridor")
    colours = {name: f"C{number}" for number, name in enumerate(ours)}
    figure, axes = base.make_panels(11, 5.2, 2, sharey=True)
    for axis, title, rows in zip(axes, ("the author's matrices", "here"), (theirs, ours), strict=True):
        for name, row in sorted(rows.items(), key=lambda item: -item[1]["auc_2_3"]):
            precision, recall = zip(*row["precision_recall"], strict=True)
            style = {"color": "k", "lw": 2} if name not in theirs and "cohog" in name else {"color": colours[name]}
            axis.plot(recall, precision, label=f"{name} {row['auc_2_3']:.2f}", **style)
        axis.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", title=f"corridor: {title}")
        axis.legend(title="AUC (2.3)", fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13))
    axes[0].set_ylabel("precision")
    base.save_figure(figure, path)


if __name__ == "__main__":
    base.run(main)
