"""Measure how often `cohog`, looking down, finds a place from another height, with any heading, and with the camera
tilted: `python height_and_tilt.py`. The sets are those of `run_sets.py` that are from the air.

The pictures are real, the heights are made. For a query from lower down its middle is enlarged. For one from higher up
the middles of the map's pictures are enlarged, as if the map had been made from lower down. A turned and tilted query
is what a camera of 66 degrees across sees that looks at the same point. Which places are then right follows from how
the pictures lie on each other (`pairs_overlap.csv`): those of which, or of the query, three tenths are common.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import base
import cv2
import numpy as np
import walks
from base import Row

from edgevpr.core.geodesy import shorter_deg
from edgevpr.core.text import markdown
from edgevpr.frames.images import read_image
from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery
from edgevpr.lab.evaluate.evaluate import mapped
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.recogniser import Recogniser

RATIOS = (0.5, 0.59, 0.71, 0.84, 1.0, 1.19, 1.41, 1.68, 2.0)
TILTS_DEG = (0.0, 20.0)
_ACROSS_DEG = 66.0
OVERLAP, TOUCHING = 0.3, 0.02


@dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures of a set by name, the homography of each reference from its own to that of a nearer camera, and how
    queries lie on references, by both names."""

    queries: dict[str, np.ndarray]
    references: dict[str, np.ndarray]
    nearer: dict[str, np.ndarray]
    lies: dict[tuple[str, str], np.ndarray]


def main() -> None:
    laid = [folder for folder in base.find_sets(camera="nadir") if (folder / "pairs_overlap.csv").exists()]
    rows = [row for folder in laid for row in measured(folder)]
    found = {**base.made_by(), "rows": rows}
    base.write("height_and_tilt", found, page(found))


def measured(folder: Path) -> Iterator[Row]:
    """Yield the result of all queries of a set from each height and at each tilt."""
    dataset = walks.dataset_of(folder)
    references = {name: read_image(dataset.ref_dir / name) for name in dataset.references}
    queries = {query.path.name: read_image(query.path) for query in dataset.queries}
    lies = laid(folder / "pairs_overlap.csv", queries, references)
    for ratio in RATIOS:
        nearer = {name: camera(image, max(1.0, ratio)) for name, image in references.items()}
        frames = (walks.frame(taken(image, nearer[name]), name) for name, image in references.items())
        technique = walks.cohog("nadir")
        with mapped(frames, technique, walks.meter()) as (place_map, index):
            for tilt_deg in TILTS_DEG:
                walk = walks.walk(place_map, index, technique, rule=accept_rule(technique, walks.config().match))
                row = {"set": folder.name, "height_ratio": ratio, "tilt_deg": tilt_deg}
                yield row | asked(walk, dataset, Pictures(queries, references, nearer, lies), ratio, tilt_deg)


def asked(walk: Recogniser, dataset: Dataset, pictures: Pictures, ratio: float, tilt_deg: float) -> Row:
    """Ask for the place of every query, turned by a random angle: `queries` that have a right place, and shares or
    counts of them. Errors are medians of right matches: of where the middle of the query lies, in cells, of the
    rotation, and of the height, as a share."""
    rng, names = np.random.default_rng(0), list(pictures.references)
    right_at_1, accepted, wrong, off = [], 0, 0, []
    for query in dataset.queries:
        image = pictures.queries[query.path.name]
        turn_deg, towards_deg = rng.uniform(0, 360, 2)
        view = camera(image, max(1.0, 1 / ratio), turn_deg, tilt_deg, towards_deg)
        truth, ignored = truth_of(query, image, view, pictures)
        right = {place for place, (overlap, _) in truth.items() if overlap >= OVERLAP}
        if not right:
            continue
        ignored |= truth.keys() - right
        event = walk.step(walks.frame(taken(image, view), query.path.name))
        ranked = walks.ranked(event, names)
        right_at_1.append(next((place in right for place in ranked if place not in ignored), False))
        accepted += event.accepted
        wrong += event.accepted and ranked[0] not in right | ignored
        if ranked and ranked[0] in right:
            off.append(errors(event.best.match, image, pictures.references[ranked[0]], truth[ranked[0]][1]))
    shift, rotation, height = np.median(off, axis=0).round(3).tolist() if off else (None,) * 3
    return {
        "queries": len(right_at_1),
        "recall_at_1": round(float(np.mean(right_at_1)), 3),
        "accepted": int(accepted),
        "accepted_wrong": int(wrong),
        "shift_off_cells": shift,
        "rotation_off_deg": rotation,
        "height_off": height,
    }


def laid(pairs: Path, queries: dict, references: dict) -> dict[tuple[str, str], np.ndarray]:
    """How queries lie on references, of each pair that was registered: the similarity from pixels to pixels, (3, 3)."""
    lies = {}
    images = queries | references
    for row in base.read_csv(pairs):
        a, b = row["file_a"], row["file_b"]
        if not ({a, b} <= images.keys() and (a in queries) != (b in queries)):
            continue
        turned = math.radians(float(row["rotation_deg"]))
        across, along = (float(row["scale"]) * part for part in (math.cos(turned), math.sin(turned)))
        matrix = np.array([[across, -along], [along, across]])
        shift = middle(images[b]) + np.array([row["dx_px"], row["dy_px"]], float) - matrix @ middle(images[a])
        a_on_b = np.vstack([np.column_stack([matrix, shift]), [0, 0, 1]])
        lies[(a, b) if a in queries else (b, a)] = a_on_b if a in queries else np.linalg.inv(a_on_b)
    return lies


def camera(image, nearer: float, turn_deg=0.0, tilt_deg=0.0, towards_deg=0.0) -> np.ndarray:
    """The homography (3, 3) from a picture straight down to that of a camera which looks at the same point from so
    many times nearer, turned, and tilted about an axis in the ground."""
    centre = middle(image)
    focal_px = image.shape[1] / 2 / math.tan(math.radians(_ACROSS_DEG / 2))
    lens = np.array([[focal_px, 0, centre[0]], [0, focal_px, centre[1]], [0, 0, 1.0]])
    towards = math.radians(towards_deg)
    axis = math.radians(tilt_deg) * np.array([math.cos(towards), math.sin(towards), 0])
    pose = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array([0, 0, math.radians(turn_deg)]))[0]
    return lens @ np.column_stack([pose[:, 0], pose[:, 1], [0, 0, 1 / nearer]]) @ np.linalg.inv(lens)


def taken(image: np.ndarray, view: np.ndarray) -> np.ndarray:
    """The picture of a camera, of the same size; beyond the edge of the picture it is mirrored."""
    return cv2.warpPerspective(image, view, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT_101)


def truth_of(query: ScoredQuery, image: np.ndarray, view: np.ndarray, pictures: Pictures) -> tuple[dict, set[str]]:
    """Of each place that the query was registered with and overlaps: the share of the smaller picture that both show,
    and the homography from the query as taken. Also the places of which it is not known."""
    ground = cut(through(np.linalg.inv(view), corners(image)), corners(image))
    truth, ignored = {}, set()
    for name in query.right | query.ignored:
        if (query.path.name, name) not in pictures.lies:
            ignored.add(name)
            continue
        onto = pictures.nearer[name] @ pictures.lies[query.path.name, name]
        mine, there = through(onto, ground), corners(pictures.references[name])
        common = cut(mine, there)
        overlap = area(common) / min(area(mine), area(there)) if len(common) else 0.0
        if overlap > TOUCHING:
            truth[name] = overlap, onto @ np.linalg.inv(view)
    return truth, ignored


def errors(match, image, reference, onto: np.ndarray) -> tuple[float, float, float]:
    """How far a match is off, in cells, degrees, and of the height as a share."""
    centre, beside = through(onto, middle(image) + np.array([[0, 0], [1, 0]]))
    step = beside - centre
    shift = (centre - middle(reference)) / (max(reference.shape[:2]) / 32) - match.shift_cells
    rotation_deg = match.rotation_deg - math.degrees(math.atan2(step[1], step[0]))
    ratio = math.hypot(*step) * max(image.shape[:2]) / max(reference.shape[:2])
    return math.hypot(*shift), abs(shorter_deg(rotation_deg)), abs(match.height_ratio / ratio - 1)


def middle(image: np.ndarray) -> np.ndarray:
    return (np.array(image.shape[1::-1]) - 1) / 2


def corners(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def through(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(np.asarray(points, float)[None], homography)[0]


def cut(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The common part of two convex polygons (N, 2), empty where there is none."""
    common = cv2.intersectConvexConvex(one.astype(np.float32), other.astype(np.float32))[1]
    return np.empty((0, 2)) if common is None else common.reshape(-1, 2)


def area(polygon: np.ndarray) -> float:
    return abs(cv2.contourArea(polygon.astype(np.float32)))


def page(found: Row) -> str:
    """Return the page for people."""
    rows = found["rows"]
    parts = ["# From another height, turned and tilted", f"{__doc__}\nTuned on aerial_caliterra and aerial_garfield28."]
    recall = {(row["set"], row["height_ratio"], row["tilt_deg"]): f"{row['recall_at_1']:.2f}" for row in rows}
    for tilt_deg in TILTS_DEG:
        parts.append(f"## Recall@1, any heading, {tilt_deg:g} degrees of tilt")
        sets = sorted({row["set"] for row in rows})
        lines = [[name, *(recall[name, ratio, tilt_deg] for ratio in RATIOS)] for name in sets]
        parts.append(markdown(("height over that of the map", *(f"{ratio:g}" for ratio in RATIOS)), lines))
    parts += ["## All figures", base.table(rows, {name.replace("_", " "): f"{{{name}}}" for name in rows[0]})]
    return "\n\n".join(part.strip() for part in parts)


if __name__ == "__main__":
    base.run(main)
