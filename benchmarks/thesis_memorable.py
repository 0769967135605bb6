"""Figures 3.10, 3.17 and 3.19 of the thesis: what the three thresholds of memorable maps leave of a set, and what that
does to the AUC; and how the entropy of a picture depends on the radius of its discs.
"""

from collections.abc import Sequence
from pathlib import Path

import detectors
import numpy as np
import walks

from edgevpr.core.text import progress
from edgevpr.frames.images import cv2, list_images, read_image
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.runtime.recognise.detector import Detector
from edgevpr.runtime.recognise.memorability import Memorability
from edgevpr.runtime.recognise.salience_gate import maps_of, scores_of
from edgevpr.techniques.card import load_card
from edgevpr.techniques.entropy import filled_bins

STEPS = tuple(round(0.05 * step, 2) for step in range(21))
TECHNIQUES = ("amosnet", "region_vlad", "cohog")
DETECTOR = "yolox_nano"
CRITERIA = ("memorability", "staticity", "entropy")
RADII_PX = (1, 2, 3, 5, 8, 12, 16)
_LONGEST_PX = 320  # as the gate computes entropy


def networks(cards: Path) -> tuple[Memorability, Detector | None]:
    """Open the network of memorability that is shipped, and a detector, where its file is on this machine. `cards` is
    a folder for models of one's own, into which the detector is put."""
    detector = None
    if detectors.is_there(DETECTOR):
        detectors.write_card(DETECTOR, cards)
        detector = Detector(load_card(DETECTOR))
    return Memorability(load_card("matchability")), detector


def thresholds(name: str, dataset: Dataset, memorability: Memorability, detector: Detector | None) -> dict:
    """Sweep each threshold from 0 to 1 on a set, the other two being off; staticity only with a detector."""
    queries, places = [query.path for query in dataset.queries], list_images(dataset.ref_dir)
    every = progress([*queries, *places], len(queries) + len(places), f"{name}: salience")
    worth = {path: _worth(read_image(path), memorability, detector) for path in every}
    rows = []
    asked = {technique: answers(technique, dataset) for technique in TECHNIQUES}
    for criterion in CRITERIA if detector else ("memorability", "entropy"):
        of_query, of_all = ([worth[path][criterion] for path in paths] for paths in (queries, [*queries, *places]))
        for step in STEPS:
            passes = np.array(of_query) >= step
            rows.append(
                {
                    "criterion": criterion,
                    "threshold": step,
                    "kept": float((np.array(of_all) >= step).mean()),
                    "queries": int(passes.sum()),
                    "auc": {technique: auc_of(*found, passes) for technique, found in asked.items()},
                }
            )
    return {"set": name, "pictures": len(worth), "rows": rows}


def auc_of(scores: np.ndarray, right: np.ndarray, passes: np.ndarray) -> float | None:
    """Return the AUC (2.3) of the queries that pass, as in the thesis, where one that is discarded is a true negative;
    None where fewer than two pass."""
    if passes.sum() < 2:
        return None
    return metrics.auc(*metrics.precision_recall(scores[passes], right[passes]))


def answers(technique: str, dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Ask all queries of a set that looks ahead: the score of each best match, and whether it is right."""
    scores, right = [], []
    with walks.walk_over(list_images(dataset.ref_dir), technique, looks_down=False) as walk:
        for query in progress(dataset.queries, len(dataset.queries), f"{technique}: queries"):
            ranking = walk.step(walks.frame(query.path)).ranking
            found = ranking is not None and len(ranking.slots)
            scores.append(float(ranking.scores[0]) if found else 0.0)
            right.append(bool(found) and dataset.references[ranking.slots[0]] in query.right)
    return np.array(scores), np.array(right)


def entropy_by_radius(images: Sequence[Path]) -> list[dict]:
    """Compute the mean entropy score of pictures for each radius of the discs."""
    greys = [_small_grey(read_image(path)) for path in images]
    return [
        {"radius_px": radius, "entropy": float(np.mean([filled_bins(grey, radius).mean() for grey in greys]))}
        for radius in RADII_PX
    ]


def _worth(image: np.ndarray, memorability: Memorability, detector: Detector | None) -> dict[str, float | None]:
    """The three scores of a picture, each by itself: what moves is taken out of neither of the others, or a sweep of
    those would be one of staticity too."""
    still = scores_of(maps_of(image, memorability, None))
    moving = None if detector is None else float(detector.is_static(image).mean())
    return {"memorability": still.memorability, "staticity": moving, "entropy": still.entropy}


def _small_grey(image: np.ndarray) -> np.ndarray:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    shrink = min(1.0, _LONGEST_PX / max(grey.shape))
    return cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
