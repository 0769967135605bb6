"""How far may the aircraft be off its map? One thing is changed at a time, by degrees: `make sweeps`.

Looking down (aerial_swindale, on which nothing was tuned): the queries, of other flights than the map, are laid over
each other as a mosaic. Over it a camera of 66 degrees across stands where a place of the map was taken, and is then
turned, tilted, raised or shifted, over ground that is taken to be flat. So what it sees beyond the place's own picture
is real, as far as the flights went. Asked for are the places of whose picture the mosaic covers at least eight tenths,
in those views of which it covers seven tenths; `asked` says how many. Right are the place itself and those of which, or
of the view, three tenths are common; others that touch the view, or could not be laid beside it, count neither way.

Looking ahead (corridor, on which parameters were tuned): 24 of the queries. A turn is exact. Shift and distance are
those of a wall: a picture that moves aside or shrinks. A corridor is none: enlarged, it looks as from farther along, so
that wrong places accepted there are three to eight on. Beyond the edge of a picture there is nothing: 40 degrees of yaw
leave two fifths of it.

Where a view shows nothing it is black and masked, so no edge of it is taken for one of the world. A change of the
picture starts from the view that is not turned. Techniques are opened as they fly; maps of `cohog` are refined and
calibrated as `map build` does. The networks run on the one that edgevpr ships, `calc`. `seqslam` needs a flight.

What is measured of a set stays in sweeps_work/, so that an interrupted run goes on.
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

SETS = ("aerial_swindale", "corridor")  # one that looks down, one that looks ahead
# seqslam matches several pictures at once.
TECHNIQUES = tuple(name for name in techniques.list_techniques() if name != "seqslam")
WORK = Path("sweeps_work")
_MAX_STARTS = 24
_MIN_COVERED = 0.8  # of the picture of a place
_MIN_SHOWN = 0.7  # of a view
_RIGHT_OVERLAP = 0.3  # of a place or of the view is common: it is right
_WRONG_OVERLAP = 0.02  # more than this and less than that: it counts neither way


@dataclass(frozen=True, slots=True, kw_only=True)
class StartView:
    """Where a sweep starts from: `ground`, a picture or a mosaic, `covered` bool where there is any, and `homography`
    (3, 3) from it to the picture of `size` (width, height) before any change. `right` are the names of places that are
    right whatever changes, `ignored` of those that count neither way, `others` the corners (4, 2) of other places."""

    name: str
    ground: np.ndarray
    covered: np.ndarray
    homography: np.ndarray
    size: tuple[int, int]
    right: frozenset[str]
    ignored: frozenset[str]
    others: dict[str, np.ndarray]


class MaskedLevelling:
    """Takes pictures as they are, with the mask of the one that is asked for."""

    mask: np.ndarray | None = None

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: np.ndarray | None, **_: object) -> LevelledImage:
        """Return the picture with the mask."""
        return LevelledImage(frame.image, self.mask, UNKNOWN_VIEW)


MapWalk = tuple[Recogniser, MaskedLevelling, list[str]]  # and the names of the places by slot


def main() -> None:
    rows: list[Row] = []
    for folder in base.find_sets(names=SETS):
        rows += base.measure_once(WORK / f"{folder.name}.json", partial(run_sweeps, folder))
    result = {**base.describe_run(), "rows": rows}
    base.write("sweeps", result, format_page(result))


def run_sweeps(folder: Path) -> list[Row]:
    """Return what each technique finds in its map of a set, a row for each level of each sweep."""
    camera = infer_camera(folder.name)
    starts, rows = list(_yield_nadir_starts(folder) if camera == "nadir" else _yield_forward_starts(folder)), []
    with ExitStack() as stack:
        map_walks = []
        for name in TECHNIQUES:
            technique, levelling = create(name, {"camera": camera} if name == "cohog" else {}), MaskedLevelling()
            place_map, index, _ = stack.enter_context(walks.make_map(folder, technique, folder / "ref"))
            walk = walks.make_walk(place_map, index, technique, levelling=levelling)
            map_walks.append((walk, levelling, walks.read_names(place_map, index)))
        unchanged = _answer_level(map_walks, starts, camera, "yaw", 0)
        for sweep, level in ((key, level) for key, change in SWEEPS.items() for level in change.list_levels(camera)):
            is_none = level == UNCHANGED_LEVELS.get(sweep, 0)
            answers = unchanged if is_none else _answer_level(map_walks, starts, camera, sweep, level)
            rows.append({"set": folder.name, "sweep": sweep, "level": level, **answers})
    return rows


def _answer_level(map_walks: list[MapWalk], starts: list[StartView], camera: str, sweep: str, level: float) -> Row:
    """Ask every technique for the place of every start, at one level of a sweep: how many were `asked`, how much of
    their views showed anything, and what was `found` by each: recall@1, accepted, accepted for a wrong place."""
    shares = []
    answers: list[Row] = [{"hits": [], "accepted": 0, "wrong": 0} for _ in map_walks]
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
        for (walk, levelling, names), answer in zip(map_walks, answers, strict=True):
            levelling.mask = None if mask.all() else mask
            event = walk.step(walks.make_frame(image, start.name))
            ranked = walks.list_ranked_names(event, names)
            answer["hits"].append(next((place for place in ranked if place not in ignored), None) in right)
            answer["accepted"] += event.accepted
            answer["wrong"] += event.accepted and ranked[0] not in right | ignored
    recalls = [round(float(np.mean(answer["hits"])), 4) if shares else None for answer in answers]
    by_technique = zip(TECHNIQUES, recalls, answers, strict=True)
    return {
        "asked": len(shares),
        "shown": round(float(np.mean(shares)), 3) if shares else 0.0,
        "found": {name: (recall, answer["accepted"], answer["wrong"]) for name, recall, answer in by_technique},
    }


def render_view(start: StartView, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a camera sees of the ground, black where there is none, and bool where there is any."""
    width, height = start.size
    finer = np.diag([2.0, 2.0, 1.0])  # seen at twice the resolution, so that ground from high up does not flicker
    fine = cv2.warpPerspective(start.ground, finer @ homography, (2 * width, 2 * height))
    mask = cv2.warpPerspective(start.covered.view(np.uint8), homography, start.size, flags=cv2.INTER_NEAREST)
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1).astype(bool)
    image = cv2.resize(fine, start.size, interpolation=cv2.INTER_AREA)
    image[~mask] = 0
    return image, mask


def _compute_overlaps(start: StartView, homography: np.ndarray) -> dict[str, float]:
    """Return what each other place and a view have in common, as a share of the smaller of both."""
    view = project(np.linalg.inv(homography), list_corners(*start.size))
    overlaps = {}
    for name, polygon in start.others.items():
        common, _ = cv2.intersectConvexConvex(view, polygon)
        overlaps[name] = common / min(cv2.contourArea(view), cv2.contourArea(polygon))
    return overlaps


def list_corners(width: int, height: int) -> np.ndarray:
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def project(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (N, 2) after a homography, float32."""
    return cv2.perspectiveTransform(points[None], homography)[0].astype(np.float32)


def _yield_nadir_starts(folder: Path) -> Iterator[StartView]:
    """Start where places of the map were taken, over the mosaic of the queries."""
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
    """Start from the queries of a set that looks ahead."""
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
    """Return the page for people."""
    parts = ["# How far off the map", base.strip_title(__doc__, "What is measured")]
    changes = {key: f"{sweep.title}, {sweep.unit}" for key, sweep in SWEEPS.items()}
    for name, rows in base.group_rows(result["rows"], lambda row: row["set"]):
        columns = {"change": "{change}", "level": "{level:g}", "asked": "{asked}", "shown": "{shown:.2f}"}
        for technique in rows[0]["found"]:
            columns[technique] = f"{{found[{technique}][0]:.2f}} ({{found[{technique}][1]}}, {{found[{technique}][2]}})"
        lines = [{**row, "change": changes[row["sweep"]]} for row in rows]
        parts.append(f"## {name} ({base.find_use(name).replace('tune', 'tuned on')})")
        parts.append("recall@1; in brackets accepted and, of these, wrong.")
        parts.append(base.format_table(lines, columns))
    return "\n\n".join([*parts, base.format_origin(result, "make sweeps")])


if __name__ == "__main__":
    base.run(main)
