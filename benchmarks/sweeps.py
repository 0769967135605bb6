"""How much a query may differ from the map, when one property changes gradually: `make sweeps`.

Nadir (aerial_swindale, on which nothing was tuned): the queries, of other flights than the map, form a mosaic. Above it
a simulated camera with a field of view of 66 degrees stands where a picture of the map was taken. It is then rotated,
tilted, raised or shifted, over ground assumed to be flat. So the view is real beyond the picture of the place, too, as
far as the flights went. Queries are the places whose picture the mosaic covers by at least 0.8, in the views that it
covers by at least 0.7; `asked` is their number. A match is right if it is the place itself, or if its picture and the
view share 0.3 of the smaller one. Places with less overlap, or missing in the mosaic, count as neither right nor wrong.

Forward (corridor, on which parameters were tuned): 24 of the queries. Rotations are exact. Shift and distance are those
of a flat wall: the picture moves sideways or shrinks. A corridor differs: enlarged, it looks as from farther along, so
wrong places accepted there are three to eight places farther on. There is nothing beyond the edge of a picture: 40
degrees of yaw leave two fifths of it.

Parts of a view without a picture are black and masked, so that their edges are not matched. Changes of pixels start
from the view without rotation. Techniques have their settings of a flight; maps of `cohog` are refined and calibrated
as by `map build`. All networks run on the one that edgevpr ships, `calc`. `seqslam` is left out: it needs a flight.

The rows of each measured set are kept in sweeps_work/, so that an interrupted run continues.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import base
import cv2
import numpy as np
import walks
from base import Row, infer_camera
from mosaics import make_mosaic, read_layout
from sweep_changes import CAMERA_SWEEPS, SWEEPS, UNCHANGED_LEVELS, degrade_image, make_view

from edgevpr import techniques
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.images import read_image
from edgevpr.frames.level import UNKNOWN_VIEW, LevelledImage
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

SETS = ("aerial_swindale", "corridor")  # one nadir, one forward
TECHNIQUES = tuple(name for name in techniques.list_techniques() if name != "seqslam")
WORK = Path("sweeps_work")
_MAX_STARTS = 24
_MIN_COVERED = 0.8  # share of the picture of a place
_MIN_SHOWN = 0.7  # share of a view
_RIGHT_OVERLAP = 0.3  # a match with this overlap, as a share of the place or of the view, is right
_WRONG_OVERLAP = 0.02  # a match with no more overlap than this is wrong


@dataclass(frozen=True, slots=True, kw_only=True)
class StartView:
    """The view where a sweep starts: `ground`, a picture or mosaic, with a bool mask `covered`, and the `homography`
    (3, 3) from it to the unchanged picture of `size` (width, height). `right` are the names of places that are right at
    every level, `ignored` those that count as neither right nor wrong, `others` the corners (4, 2) of other places."""

    name: str
    ground: np.ndarray
    covered: np.ndarray
    homography: np.ndarray
    size: tuple[int, int]
    right: frozenset[str]
    ignored: frozenset[str]
    others: dict[str, np.ndarray]


class MaskedLevelling:
    """Levelling that leaves pictures unchanged and adds `mask`, which the caller sets before each query."""

    mask: np.ndarray | None = None

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: np.ndarray | None, **_: object) -> LevelledImage:
        """Return the picture with the mask."""
        return LevelledImage(frame.image, self.mask, UNKNOWN_VIEW)


MapWalk = tuple[Recogniser, MaskedLevelling, list[str]]  # with the names of the places by slot


def main() -> None:
    rows: list[Row] = []
    for folder in base.find_sets(names=SETS):
        rows += base.measure_once(WORK / f"{folder.name}.json", partial(run_sweeps, folder))
    result = {**base.describe_run(), "rows": rows}
    base.write("sweeps", result, format_page(result))


def run_sweeps(folder: Path) -> list[Row]:
    """Return a row for each level of each sweep of a set, with the results of every technique."""
    camera = infer_camera(folder.name)
    starts, rows = list(_yield_nadir_starts(folder) if camera == "nadir" else _yield_forward_starts(folder)), []
    with ExitStack() as stack:
        map_walks = []
        for name in TECHNIQUES:
            technique, levelling = create(name, {"camera": camera} if name == "cohog" else {}), MaskedLevelling()
            place_map, index, _ = stack.enter_context(walks.make_map(folder, technique, folder / "ref"))
            walk = walks.make_walk(place_map, index, technique, levelling=levelling)
            map_walks.append((walk, levelling, walks.read_names(place_map, index)))
        unchanged = _match_level(map_walks, starts, camera, "yaw", 0)
        for sweep, level in ((key, level) for key, change in SWEEPS.items() for level in change.list_levels(camera)):
            is_unchanged = level == UNCHANGED_LEVELS.get(sweep, 0)
            results = unchanged if is_unchanged else _match_level(map_walks, starts, camera, sweep, level)
            rows.append({"set": folder.name, "sweep": sweep, "level": level, **results})
    return rows


def _match_level(map_walks: list[MapWalk], starts: list[StartView], camera: str, sweep: str, level: float) -> Row:
    """Match the views of all starts at one level of a sweep. Return the number of queries (`asked`), the covered share
    of their views (`shown`), and by technique (`found`) recall@1 and the counts of accepted and accepted wrong ones."""
    shares = []
    tallies: list[Row] = [{"hits": [], "accepted": 0, "wrong": 0} for _ in map_walks]
    for number, start in enumerate(starts):
        rng = np.random.default_rng((number, list(SWEEPS).index(sweep)))
        change = make_view(camera, sweep, level, start.size, rng) if sweep in CAMERA_SWEEPS else np.eye(3)
        image, mask = render_view(start, change @ start.homography)
        if camera == "nadir" and mask.mean() < _MIN_SHOWN:
            continue
        if sweep not in CAMERA_SWEEPS:
            image = degrade_image(sweep, level, image, rng)
        shares.append(mask.mean())
        overlaps = _compute_overlaps(start, change @ start.homography)
        right = start.right | {place for place, share in overlaps.items() if share >= _RIGHT_OVERLAP}
        touching = {place for place, share in overlaps.items() if _WRONG_OVERLAP < share < _RIGHT_OVERLAP}
        ignored = start.ignored | touching
        for (walk, levelling, names), tally in zip(map_walks, tallies, strict=True):
            levelling.mask = None if mask.all() else mask
            event = walk.step(walks.make_frame(image, start.name))
            ranked = walks.list_ranked_names(event, names)
            tally["hits"].append(next((place for place in ranked if place not in ignored), None) in right)
            tally["accepted"] += event.accepted
            tally["wrong"] += event.accepted and ranked[0] not in right | ignored
    recalls = [round(float(np.mean(tally["hits"])), 4) if shares else None for tally in tallies]
    by_technique = zip(TECHNIQUES, recalls, tallies, strict=True)
    return {
        "asked": len(shares),
        "shown": round(float(np.mean(shares)), 3) if shares else 0.0,
        "found": {name: (recall, tally["accepted"], tally["wrong"]) for name, recall, tally in by_technique},
    }


def render_view(start: StartView, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the view of the ground through a homography, black where no ground is, and its bool mask of ground."""
    width, height = start.size
    upscale = np.diag([2.0, 2.0, 1.0])  # rendered at twice the resolution, against aliasing from high up
    double_image = cv2.warpPerspective(start.ground, upscale @ homography, (2 * width, 2 * height))
    mask = cv2.warpPerspective(start.covered.view(np.uint8), homography, start.size, flags=cv2.INTER_NEAREST)
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1).astype(bool)
    image = cv2.resize(double_image, start.size, interpolation=cv2.INTER_AREA)
    image[~mask] = 0
    return image, mask


def _compute_overlaps(start: StartView, homography: np.ndarray) -> dict[str, float]:
    """Return the overlap of a view with each other place, as a share of the smaller of the two."""
    view = project(np.linalg.inv(homography), list_corners(*start.size))
    overlaps = {}
    for name, polygon in start.others.items():
        overlap_px, _ = cv2.intersectConvexConvex(view, polygon)
        overlaps[name] = overlap_px / min(cv2.contourArea(view), cv2.contourArea(polygon))
    return overlaps


def list_corners(width: int, height: int) -> np.ndarray:
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def project(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a homography (3, 3) to points (N, 2) and return them as float32 (N, 2)."""
    return cv2.perspectiveTransform(points[None], homography)[0].astype(np.float32)


def _yield_nadir_starts(folder: Path) -> Iterator[StartView]:
    """Yield views over the mosaic of the queries, from where places of the map were taken."""
    layout = read_layout(folder)
    ground, covered = make_mosaic(folder, layout, "query")
    names = sorted(path.name for path in (folder / "ref").iterdir())
    images = {name: read_image(folder / "ref" / name) for name in names if name in layout.middle}
    transforms = {name: np.vstack([layout.compute_transform(name, image), [0, 0, 1]]) for name, image in images.items()}
    polygons = {name: project(transforms[name], list_corners(*image.shape[1::-1])) for name, image in images.items()}
    starts = [
        StartView(
            name=name,
            ground=ground,
            covered=covered,
            homography=np.linalg.inv(transforms[name]),
            size=image.shape[1::-1],
            right=frozenset([name]),
            ignored=frozenset(names) - frozenset(images),
            others={other: polygon for other, polygon in polygons.items() if other != name},
        )
        for name, image in images.items()
    ]
    starts = [start for start in starts if render_view(start, start.homography)[1].mean() >= _MIN_COVERED]
    yield from base.thin_evenly(starts, _MAX_STARTS)


def _yield_forward_starts(folder: Path) -> Iterator[StartView]:
    """Yield the queries of a forward set."""
    for query in base.thin_evenly(walks.load_matched_set(folder).queries, _MAX_STARTS):
        image = read_image(query.path)
        yield StartView(
            name=query.path.name,
            ground=image,
            covered=np.ones(image.shape[:2], bool),
            homography=np.eye(3),
            size=image.shape[1::-1],
            right=query.correct,
            ignored=query.ignored,
            others={},
        )


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    parts = ["# How far off the map", base.strip_title(__doc__, "The rows of each")]
    titles = {key: f"{sweep.title}, {sweep.unit}" for key, sweep in SWEEPS.items()}
    for name, rows in base.group_rows(result["rows"], lambda row: row["set"]):
        columns = {"change": "{change}", "level": "{level:g}", "asked": "{asked}", "shown": "{shown:.2f}"}
        for technique in rows[0]["found"]:
            columns[technique] = f"{{found[{technique}][0]:.2f}} ({{found[{technique}][1]}}, {{found[{technique}][2]}})"
        lines = [{**row, "change": titles[row["sweep"]]} for row in rows]
        parts.append(f"## {name} ({base.find_use(name).replace('tune', 'tuned on')})")
        parts.append("recall@1; in brackets: accepted matches, and how many of them are wrong.")
        parts.append(base.format_table(lines, columns))
    return "\n\n".join([*parts, base.format_origin(result, "make sweeps")])


if __name__ == "__main__":
    base.run(main)
