"""Measure how often `cohog`, looking down, finds a place from another height, with any heading, and with the camera
tilted: `python height_and_tilt.py`. The sets are those of `run_sets.py` that are from the air.

The pictures are real, the heights are made. For a query from lower down its middle is enlarged. For one from higher up
the middles of the map's pictures are enlarged, as if the map had been made from lower down. A turned and tilted query
is what a camera of 66 degrees across sees that looks at the same point. Which places are then right follows from how
the pictures lie on each other (`pairs_overlap.csv`): those of which, or of the query, three tenths are common.
"""

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from run_sets import DATA, FROM_THE_AIR, RESULTS, TUNED_ON, find_sets, made_by

from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import markdown
from edgevpr.core.types import Frame
from edgevpr.frames.images import read_image
from edgevpr.lab.evaluate.dataset import ScoredQuery, load_dataset
from edgevpr.lab.evaluate.evaluate import mapped
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

REPOSITORY = Path(__file__).resolve().parents[1]
RATIOS = (0.5, 0.59, 0.71, 0.84, 1.0, 1.19, 1.41, 1.68, 2.0)
TILTS_DEG = (0.0, 20.0)
_ACROSS_DEG = 66.0
_OVERLAP, _TOUCHING = 0.3, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The result of all queries of a set from one height: `queries` that have a right place, and shares or counts of
    them. Errors are medians of right matches: of where the middle of the query lies, in cells, of the rotation, and of
    the height, as a share."""

    set: str
    height_ratio: float
    tilt_deg: float
    queries: int
    recall_at_1: float
    accepted: int
    accepted_wrong: int
    shift_off_cells: float | None
    rotation_off_deg: float | None
    height_off: float | None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        folders = [each for each in find_sets(args.data, None) if each.name.startswith(FROM_THE_AIR)]
        rows = [row for folder in folders for row in measured(folder)]
    except EdgevprError as error:
        print(f"height_and_tilt: {error}", file=sys.stderr)
        return error.exit_code
    write(args.out, rows)
    return 0


def measured(folder: Path) -> Iterator[Row]:
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    references = {name: read_image(dataset.ref_dir / name) for name in dataset.references}
    queries = {query.path.name: read_image(query.path) for query in dataset.queries}
    lies = laid(folder / "pairs_overlap.csv", queries, references)
    for ratio in RATIOS:
        nearer = {name: camera(image, max(1.0, ratio)) for name, image in references.items()}
        seen = {name: taken(image, nearer[name]) for name, image in references.items()}
        technique, config = create("cohog", {"camera": "nadir"}), load_config(None)
        meter = meter_of(config, load_board("this"))
        frames = (Frame(image=image, name=name, t_mono_s=0.0) for name, image in seen.items())
        with mapped(frames, technique, meter) as (place_map, index):
            for tilt_deg in TILTS_DEG:
                recogniser = Recogniser(
                    technique=technique,
                    place_map=place_map,
                    index=index,
                    rule=accept_rule(technique, config.match),
                    meter=meter,
                    candidates=technique.candidates,
                )
                yield asked(
                    folder.name, recogniser, dataset.queries, queries, references, nearer, lies, ratio, tilt_deg
                )


def asked(name, recogniser, scored, queries, references, nearer, lies, ratio, tilt_deg) -> Row:
    """Ask for the place of every query, turned by a random angle."""
    rng = np.random.default_rng(0)
    names, right_at_1, accepted, wrong, off = list(references), [], 0, 0, []
    for query in scored:
        image = queries[query.path.name]
        turn_deg, towards_deg = rng.uniform(0, 360, 2)
        view = camera(image, max(1.0, 1 / ratio), turn_deg, tilt_deg, towards_deg)
        truth, ignored = truth_of(query, image, view, references, nearer, lies)
        right = {place for place, (overlap, _) in truth.items() if overlap >= _OVERLAP}
        if not right:
            continue
        ignored |= truth.keys() - right
        event = recogniser.step(Frame(image=taken(image, view), name=query.path.name, t_mono_s=0.0))
        if event.failed:
            raise EdgevprError(event.reason)
        ranked = [names[slot] for slot in event.ranking.slots] if event.ranking else []
        right_at_1.append(next((place in right for place in ranked if place not in ignored), False))
        accepted += event.accepted
        wrong += event.accepted and ranked[0] not in right | ignored
        if ranked and ranked[0] in right:
            off.append(errors(event.best.match, image, references[ranked[0]], truth[ranked[0]][1]))
    shift, rotation, height = np.median(off, axis=0).round(3).tolist() if off else (None,) * 3
    return Row(
        set=name,
        height_ratio=ratio,
        tilt_deg=tilt_deg,
        queries=len(right_at_1),
        recall_at_1=round(float(np.mean(right_at_1)), 3),
        accepted=int(accepted),
        accepted_wrong=int(wrong),
        shift_off_cells=shift,
        rotation_off_deg=rotation,
        height_off=height,
    )


def laid(pairs: Path, queries: dict, references: dict) -> dict[tuple[str, str], np.ndarray]:
    """How queries lie on references, of each pair that was registered: the similarity from pixels to pixels, (3, 3)."""
    lies = {}
    with open(pairs, newline="") as handle:
        for row in csv.DictReader(handle):
            a, b = row["file_a"], row["file_b"]
            images = queries | references
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
    axis = math.radians(tilt_deg) * np.array(
        [math.cos(math.radians(towards_deg)), math.sin(math.radians(towards_deg)), 0]
    )
    pose = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array([0, 0, math.radians(turn_deg)]))[0]
    return lens @ np.column_stack([pose[:, 0], pose[:, 1], [0, 0, 1 / nearer]]) @ np.linalg.inv(lens)


def taken(image: np.ndarray, view: np.ndarray) -> np.ndarray:
    """The picture of a camera, of the same size; beyond the edge of the picture it is mirrored."""
    return cv2.warpPerspective(image, view, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT_101)


def truth_of(query: ScoredQuery, image, view, references, nearer, lies) -> tuple[dict, set[str]]:
    """Of each place that the query was registered with and overlaps: the share of the smaller picture that both show,
    and the homography from the query as taken. Also the places of which it is not known."""
    ground = cut(through(np.linalg.inv(view), corners(image)), corners(image))
    truth, ignored = {}, set()
    for name in query.right | query.ignored:
        if (query.path.name, name) not in lies:
            ignored.add(name)
            continue
        onto = nearer[name] @ lies[query.path.name, name]
        mine, there = through(onto, ground), corners(references[name])
        common = cut(mine, there)
        overlap = area(common) / min(area(mine), area(there)) if len(common) else 0.0
        if overlap > _TOUCHING:
            truth[name] = overlap, onto @ np.linalg.inv(view)
    return truth, ignored


def errors(match, image, reference, onto: np.ndarray) -> tuple[float, float, float]:
    """How far a match is off, in cells, degrees, and of the height as a share."""
    centre, beside = through(onto, middle(image) + np.array([[0, 0], [1, 0]]))
    step = beside - centre
    shift = (centre - middle(reference)) / (max(reference.shape[:2]) / 32) - match.shift_cells
    rotation_deg = match.rotation_deg - math.degrees(math.atan2(step[1], step[0]))
    ratio = math.hypot(*step) * max(image.shape[:2]) / max(reference.shape[:2])
    return math.hypot(*shift), abs((rotation_deg + 180) % 360 - 180), abs(match.height_ratio / ratio - 1)


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


def write(out: Path, rows: list[Row]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    content = {**made_by(), "tuned_on": [name for name in TUNED_ON if name.startswith(FROM_THE_AIR)]}
    content["rows"] = [asdict(row) for row in rows]
    (out / "height_and_tilt.json").write_text(json.dumps(content, indent=1) + "\n")
    (out / "height_and_tilt.md").write_text(page(rows))
    draw(out / "height_and_tilt.png", rows)


def page(rows: list[Row]) -> str:
    parts = [
        "# From another height, turned and tilted\n",
        f"{__doc__}\nTuned on aerial_caliterra and aerial_garfield28.",
    ]
    found = {(row.set, row.height_ratio, row.tilt_deg): row for row in rows}
    names = sorted({row.set for row in rows})
    for tilt_deg in TILTS_DEG:
        parts.append(f"## Recall@1, any heading, {tilt_deg:g} degrees of tilt\n")
        table = [[name, *(f"{found[name, ratio, tilt_deg].recall_at_1:.2f}" for ratio in RATIOS)] for name in names]
        parts.append(markdown(("height over that of the map", *(f"{ratio:g}" for ratio in RATIOS)), table))
    parts.append("## All figures\n")
    table = [["–" if value is None else str(value) for value in asdict(row).values()] for row in rows]
    parts.append(markdown(tuple(name.replace("_", " ") for name in asdict(rows[0])), table))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def draw(path: Path, rows: list[Row]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(TILTS_DEG), figsize=(11, 4.2), sharey=True, layout="constrained")
    for axis, tilt_deg in zip(axes, TILTS_DEG, strict=True):
        for name in sorted({row.set for row in rows}):
            own = [row for row in rows if row.set == name and row.tilt_deg == tilt_deg]
            label = f"{name} ({own[0].queries})" + (", tuned on" if name in TUNED_ON else "")
            axis.plot([row.height_ratio for row in own], [row.recall_at_1 for row in own], marker="o", label=label)
        axis.set(xscale="log", xlabel="height over that of the map", ylim=(0, 1.03))
        axis.set_title(f"any heading, {tilt_deg:g}° of tilt")
        axis.set_xticks(RATIOS, [f"{ratio:g}" for ratio in RATIOS], minor=False)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("recall@1")
    axes[0].legend(loc="lower center", fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
