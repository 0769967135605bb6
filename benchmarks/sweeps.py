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
from base import Row, camera_of
from mosaics import laid, make_mosaic
from sweep_changes import NONE, OF_CAMERA, SWEEPS, spoilt, view

from edgevpr import techniques
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.images import read_image
from edgevpr.frames.level import UNKNOWN_VIEW, LevelledImage
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

SETS = ("aerial_swindale", "corridor")  # one that looks down, one that looks ahead
TECHNIQUES = tuple(
    name for name in techniques.list_techniques() if name != "seqslam"
)  # which asks with several pictures
WORK = Path("sweeps_work")
_MAX_ASKED = 24
_LEAST_COVERED, _LEAST_SHOWN = 0.8, 0.7
_OVERLAP = 0.3  # of a place or of the view is common: it is right
_TOUCHING = 0.02  # more than this and less than that: it counts neither way


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where a sweep starts from: `ground`, a picture or a mosaic, `covered` bool where there is any, and `onto` (3, 3)
    from it to the picture of `size` (width, height) before any change. `right` are the names of places that are right
    whatever changes, `ignored` of those that count neither way, `lies` the corners of other places on the ground."""

    name: str
    ground: np.ndarray
    covered: np.ndarray
    onto: np.ndarray
    size: tuple[int, int]
    right: frozenset[str]
    ignored: frozenset[str]
    lies: dict[str, np.ndarray]


class Shown:
    """Takes pictures as they are, with the mask of the one that is asked for."""

    mask: np.ndarray | None = None

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: np.ndarray | None, **_: object) -> LevelledImage:
        """Return the picture with the mask."""
        return LevelledImage(frame.image, self.mask, UNKNOWN_VIEW)


Asked = tuple[Recogniser, Shown, list[str]]  # a walk over a map, what it is shown, and the places' names by slot


def main() -> None:
    rows: list[Row] = []
    for folder in base.find_sets(names=SETS):
        rows += base.kept(WORK / f"{folder.name}.json", partial(swept, folder))
    found = {**base.made_by(), "rows": rows}
    base.write("sweeps", found, page(found))


def swept(folder: Path) -> list[Row]:
    """Return what each technique finds in its map of a set, a row for each level of each sweep."""
    camera = camera_of(folder.name)
    starts, rows = list(_over_mosaic(folder) if camera == "nadir" else _ahead(folder)), []
    with ExitStack() as stack:
        asked = []
        for name in TECHNIQUES:
            technique, shown = create(name, {"camera": camera} if name == "cohog" else {}), Shown()
            place_map, index, _ = stack.enter_context(walks.make_map(folder, technique, folder / "ref"))
            walk = walks.walk(place_map, index, technique, levelling=shown)
            asked.append((walk, shown, walks.names_of(place_map, index)))
        unchanged = _asked(asked, starts, camera, "yaw", 0)
        for sweep, level in ((key, level) for key, each in SWEEPS.items() for level in each.of(camera)):
            is_none = level == NONE.get(sweep, 0)
            found = unchanged if is_none else _asked(asked, starts, camera, sweep, level)
            rows.append({"set": folder.name, "sweep": sweep, "level": level, **found})
    return rows


def _asked(asked: list[Asked], starts: list[Start], camera: str, sweep: str, level: float) -> Row:
    """Ask every technique for the place of every start, at one level of a sweep: how many were `asked`, how much of
    their views showed anything, and what was `found` by each: recall@1, accepted, accepted for a wrong place."""
    shares, found = [], [{"hits": [], "accepted": 0, "wrong": 0} for _ in asked]
    for number, start in enumerate(starts):
        rng = np.random.default_rng((number, list(SWEEPS).index(sweep)))
        change = view(camera, sweep, level, start.size, rng) if sweep in OF_CAMERA else np.eye(3)
        image, mask = seen(start, change @ start.onto)
        if camera == "nadir" and mask.mean() < _LEAST_SHOWN:
            continue
        if sweep not in OF_CAMERA:
            image = spoilt(sweep, level, image, rng)
        shares.append(mask.mean())
        shares_of = _shares_of(start, change @ start.onto)
        right = start.right | {place for place, share in shares_of.items() if share >= _OVERLAP}
        ignored = start.ignored | {place for place, share in shares_of.items() if _TOUCHING < share < _OVERLAP}
        for (walk, shown, names), of_it in zip(asked, found, strict=True):
            shown.mask = None if mask.all() else mask
            event = walk.step(walks.frame(image, start.name))
            ranked = walks.ranked(event, names)
            of_it["hits"].append(next((place for place in ranked if place not in ignored), None) in right)
            of_it["accepted"] += event.accepted
            of_it["wrong"] += event.accepted and ranked[0] not in right | ignored
    recalls = [round(float(np.mean(each["hits"])), 4) if shares else None for each in found]
    by_technique = zip(TECHNIQUES, recalls, found, strict=True)
    return {
        "asked": len(shares),
        "shown": round(float(np.mean(shares)), 3) if shares else 0.0,
        "found": {name: (recall, each["accepted"], each["wrong"]) for name, recall, each in by_technique},
    }


def seen(start: Start, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a camera sees of the ground, black where there is none, and bool where there is any."""
    width, height = start.size
    finer = np.diag([2.0, 2.0, 1.0])  # seen at twice the resolution, so that ground from high up does not flicker
    fine = cv2.warpPerspective(start.ground, finer @ onto, (2 * width, 2 * height))
    mask = cv2.warpPerspective(start.covered.view(np.uint8), onto, start.size, flags=cv2.INTER_NEAREST)
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1).astype(bool)
    image = cv2.resize(fine, start.size, interpolation=cv2.INTER_AREA)
    image[~mask] = 0
    return image, mask


def _shares_of(start: Start, onto: np.ndarray) -> dict[str, float]:
    """Return what each other place and a view have in common, as a share of the smaller of both."""
    width, height = start.size
    ground = through(np.linalg.inv(onto), corners(np.empty((height, width))))
    return {name: area(common(ground, lies)) / min(area(ground), area(lies)) for name, lies in start.lies.items()}


def corners(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def through(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(np.asarray(points, float)[None], homography)[0]


def common(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the common part of two convex polygons (N, 2), empty where there is none."""
    found = cv2.intersectConvexConvex(one.astype(np.float32), other.astype(np.float32))[1]
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2)


def area(polygon: np.ndarray) -> float:
    return abs(cv2.contourArea(polygon.astype(np.float32)))


def _over_mosaic(folder: Path) -> Iterator[Start]:
    """Start where places of the map were taken, over the mosaic of the queries."""
    on = laid(folder)
    ground, covered = make_mosaic(folder, on, "query")
    every = sorted(path.name for path in (folder / "ref").iterdir())
    images = {name: read_image(folder / "ref" / name) for name in every if name in on.middle}
    there = {name: np.vstack([on.matrix(name, image), [0, 0, 1]]) for name, image in images.items()}
    lies = {name: through(there[name], corners(image)) for name, image in images.items()}
    starts = [
        Start(
            name=name,
            ground=ground,
            covered=covered,
            onto=np.linalg.inv(there[name]),
            size=image.shape[1::-1],
            right=frozenset([name]),
            ignored=frozenset(every) - frozenset(images),
            lies={other: each for other, each in lies.items() if other != name},
        )
        for name, image in images.items()
    ]
    yield from _some([start for start in starts if seen(start, start.onto)[1].mean() >= _LEAST_COVERED])


def _ahead(folder: Path) -> Iterator[Start]:
    """Start from the queries of a set that looks ahead."""
    for query in _some(walks.dataset_of(folder).queries):
        image = read_image(query.path)
        yield Start(
            name=query.path.name,
            ground=image,
            covered=np.ones(image.shape[:2], bool),
            onto=np.eye(3),
            size=image.shape[1::-1],
            right=query.correct,
            ignored=query.ignored,
            lies={},
        )


def _some(starts):
    """Return at most `_MAX_ASKED` of all, evenly spread."""
    return [starts[at] for at in np.unique(np.linspace(0, len(starts) - 1, _MAX_ASKED).round().astype(int))]


def page(found: Row) -> str:
    """Return the page for people."""
    parts = ["# How far off the map", base.told(__doc__, "What is measured")]
    changes = {key: f"{sweep.title}, {sweep.unit}" for key, sweep in SWEEPS.items()}
    for name, rows in base.groups(found["rows"], lambda row: row["set"]):
        columns = {"change": "{change}", "level": "{level:g}", "asked": "{asked}", "shown": "{shown:.2f}"}
        for of in rows[0]["found"]:
            columns[of] = f"{{found[{of}][0]:.2f}} ({{found[{of}][1]}}, {{found[{of}][2]}})"
        lines = [{**row, "change": changes[row["sweep"]]} for row in rows]
        parts.append(f"## {name} ({base.use_of(name).replace('tune', 'tuned on')})")
        parts.append("recall@1; in brackets accepted and, of these, wrong.")
        parts.append(base.table(lines, columns))
    return "\n\n".join([*parts, base.made_line(found, "make sweeps")])


if __name__ == "__main__":
    base.run(main)
