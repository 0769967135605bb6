"""How far may the aircraft be off its map? One thing is changed at a time, by degrees: `make sweeps`.

Looking down (aerial_swindale, on which nothing was tuned): the queries, of other flights than the map, are laid over
each other as a mosaic. Over it a camera of 66 degrees across stands where a place of the map was taken, and is then
turned, tilted, raised or shifted, over ground that is taken to be flat. So what it sees beyond the place's own picture
is real, as far as the flights went. Asked for are the places of whose picture the mosaic covers at least eight tenths,
in those views of which it covers seven tenths; `asked` says how many. Right is the place itself: others that overlap
the view count neither way, and neither do those that could not be laid beside it.

Looking ahead (corridor, on which parameters were tuned): 24 of the queries. A turn is exact. Shift and distance are
those of a wall: a picture that moves aside or shrinks. Beyond the edge of a picture there is nothing: 40 degrees of yaw
leave two fifths of it.

Where a view shows nothing it is black and masked, so no edge of it is taken for one of the world. A change of the
picture starts from the view that is not turned. Techniques are opened as they fly; maps of `cohog` are refined and
calibrated as `map build` does. The networks run on the one that edgevpr ships, `calc`. `seqslam` needs a flight.

What is measured stays in the folder --work, so that an interrupted run goes on.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import sweeps_page
from from_orthophoto import laid, mosaic_of
from height_and_tilt import area, corners, cut, middle, through
from hostile_pictures import camera_of
from run_sets import find_sets, parser_of
from sweep_changes import NONE, OF_CAMERA, SWEEPS, spoilt, view

from edgevpr import techniques
from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.images import read_image
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import all_frames, mapped
from edgevpr.lab.evaluate.metrics import interval
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.calibrated import calibration_of
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

SETS = ("aerial_swindale", "corridor")  # one that looks down, one that looks ahead
TECHNIQUES = tuple(name for name in techniques.names() if name != "seqslam")  # which asks with several pictures
_MOST_ASKED = 24
_LEAST_COVERED, _LEAST_SHOWN, _TOUCHING = 0.8, 0.7, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """The result at one level of a sweep: how many were `asked`, how much of their views showed anything, and which
    were accepted for which wrong place."""

    sweep: str
    level: float
    asked: int
    shown: float
    recall_at_1: float | None
    recall_at_1_interval: tuple[float, float] | None
    accepted: int
    accepted_wrong: int
    wrong: list[tuple[str, str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where a sweep starts from: `ground`, a picture or a mosaic, `covered` bool where there is any, and `onto` (3, 3)
    from it to the picture of `size` (width, height) before any change. `right` are the names of right places, `ignored`
    of those that count neither way, `lies` the corners of other places on the ground."""

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

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: np.ndarray | None) -> Levelled:
        """Return the picture with the mask."""
        return Levelled(frame.image, self.mask, UNKNOWN_VIEW)


@dataclass(frozen=True, slots=True)
class Asked:
    """A technique that is asked: its walk over a map, what it is shown, and the names of the places by their slots."""

    walk: Recogniser
    shown: Shown
    names: tuple[str, ...]


@dataclass(slots=True)
class Found:
    """The answers of a technique at one level."""

    hits: list[bool] = field(default_factory=list)
    accepted: int = 0
    wrong: list[tuple[str, str]] = field(default_factory=list)


def main() -> int:
    args = parser_of(__doc__, "sweeps_work").parse_args()
    cv2.setNumThreads(1)
    args.work.mkdir(parents=True, exist_ok=True)
    found = []
    try:
        for folder in find_sets(args.data, list(SETS)):
            found += _gathered(args.work / f"{folder.name}.json", folder)
            sweeps_page.write(args.out, found, __doc__)
    except EdgevprError as error:
        print(f"sweeps: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _gathered(path: Path, folder: Path) -> list[dict]:
    """Return what each technique finds of a set: what the file has of it, and the levels that it lacks, written one by
    one."""
    camera = camera_of(folder.name)
    found = [{"set": folder.name, "camera": camera, "technique": name, "levels": []} for name in TECHNIQUES]
    if path.exists():
        found = json.loads(path.read_text())
    wanted = [(sweep, level) for sweep in SWEEPS for level in SWEEPS[sweep].of(camera)]
    for levels in swept(folder, wanted[len(found[0]["levels"]) :]):
        for row, level in zip(found, levels, strict=True):
            row["levels"].append(asdict(level))
        path.with_suffix(".new").write_text(json.dumps(found))
        path.with_suffix(".new").replace(path)
    return found


def swept(folder: Path, wanted: list[tuple[str, float]]) -> Iterator[list[Level]]:
    """Ask in the maps of a set, at the wanted levels of sweeps; yield a level of each technique."""
    if not wanted:
        return
    camera = camera_of(folder.name)
    starts = list(_over_mosaic(folder) if camera == "nadir" else _ahead(folder))
    with ExitStack() as stack:
        asked = [_opened(stack, folder, name, camera) for name in TECHNIQUES]
        unchanged = None
        for sweep, level in wanted:
            if level != NONE.get(sweep, 0):
                yield _asked(asked, starts, camera, sweep, level)
            else:
                unchanged = unchanged or _asked(asked, starts, camera, sweep, level)
                yield [replace(each, sweep=sweep, level=level) for each in unchanged]


def _opened(stack: ExitStack, folder: Path, name: str, camera: str) -> Asked:
    """Make the map of a technique, and open it as it flies."""
    config, shown = load_config(None), Shown()
    technique = create(name, {"camera": camera} if name == "cohog" else {})
    meter = meter_of(config, load_board("this"))
    frames = all_frames(open_source(str(folder / "ref"), live=False))
    place_map, index = stack.enter_context(mapped(frames, technique, meter, folder / "ref"))
    walk = Recogniser(
        technique=technique,
        place_map=place_map,
        index=index,
        rule=accept_rule(technique, config.match, 1, calibration_of(place_map)),
        meter=meter,
        candidates=technique.candidates,
        levelling=shown,
    )
    names = {place.place_id: place.source_image for place in place_map.places()}
    return Asked(walk=walk, shown=shown, names=tuple(names[place_id] for place_id in index.place_ids.tolist()))


def _asked(asked: list[Asked], starts: list[Start], camera: str, sweep: str, level: float) -> list[Level]:
    """Ask every technique for the place of every start, at one level of a sweep."""
    shares, found = [], [Found() for _ in asked]
    for number, start in enumerate(starts):
        rng = np.random.default_rng((number, list(SWEEPS).index(sweep)))
        change = view(camera, sweep, level, start.size, rng) if sweep in OF_CAMERA else np.eye(3)
        image, mask = seen(start, change @ start.onto)
        if camera == "nadir" and mask.mean() < _LEAST_SHOWN:
            continue
        if sweep not in OF_CAMERA:
            image = spoilt(sweep, level, image, rng)
        shares.append(mask.mean())
        ignored = start.ignored | _overlapping(start, change @ start.onto)
        for each, of_it in zip(asked, found, strict=True):
            each.shown.mask = None if mask.all() else mask
            event = each.walk.step(Frame(image=image, name=start.name, t_mono_s=0.0))
            if event.failed:
                raise EdgevprError(event.reason)
            ranked = [each.names[slot] for slot in event.ranking.slots] if event.ranking else []
            of_it.hits.append(next((place for place in ranked if place not in ignored), None) in start.right)
            of_it.accepted += event.accepted
            if event.accepted and ranked[0] not in start.right | ignored:
                of_it.wrong.append((start.name, ranked[0]))
    return [
        Level(
            sweep=sweep,
            level=level,
            asked=len(shares),
            shown=round(float(np.mean(shares)), 3) if shares else 0.0,
            recall_at_1=round(float(np.mean(each.hits)), 4) if shares else None,
            recall_at_1_interval=interval(np.array(each.hits)) if shares else None,
            accepted=each.accepted,
            accepted_wrong=len(each.wrong),
            wrong=each.wrong,
        )
        for each in found
    ]


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


def _overlapping(start: Start, onto: np.ndarray) -> frozenset[str]:
    """Return the other places that show ground of a view."""
    if not start.lies:
        return frozenset()
    width, height = start.size
    ground = through(np.linalg.inv(onto), corners(np.empty((height, width))))
    share = {name: area(cut(ground, lies)) / min(area(ground), area(lies)) for name, lies in start.lies.items()}
    return frozenset(name for name, common in share.items() if common > _TOUCHING)


def _over_mosaic(folder: Path) -> Iterator[Start]:
    """Start where places of the map were taken, over the mosaic of the queries."""
    on = laid(folder)
    ground, covered = mosaic_of(folder, on, "query")
    onto, lies, sizes = {}, {}, {}
    every = sorted(path.name for path in (folder / "ref").iterdir())
    for name in every:
        if name in on.middle:
            image = read_image(folder / "ref" / name)
            cos, sin = on.scale[name] * np.cos(on.turn[name]), on.scale[name] * np.sin(on.turn[name])
            turned = np.array([[cos, -sin], [sin, cos]])
            there = np.vstack([np.column_stack([turned, on.middle[name] - turned @ middle(image)]), [0, 0, 1]])
            onto[name], lies[name] = np.linalg.inv(there), through(there, corners(image))
            sizes[name] = image.shape[1::-1]
    starts = []
    for name in onto:
        start = Start(
            name=name,
            ground=ground,
            covered=covered,
            onto=onto[name],
            size=sizes[name],
            right=frozenset([name]),
            ignored=frozenset(every) - frozenset(onto),
            lies={other: each for other, each in lies.items() if other != name},
        )
        if seen(start, start.onto)[1].mean() >= _LEAST_COVERED:
            starts.append(start)
    yield from _some(starts)


def _ahead(folder: Path) -> Iterator[Start]:
    """Start from the queries of a set that looks ahead."""
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    for query in _some(dataset.queries):
        image = read_image(query.path)
        yield Start(
            name=query.path.name,
            ground=image,
            covered=np.ones(image.shape[:2], bool),
            onto=np.eye(3),
            size=image.shape[1::-1],
            right=query.right,
            ignored=query.ignored,
            lies={},
        )


def _some(starts):
    """Return at most `_MOST_ASKED` of all, evenly spread."""
    return [starts[at] for at in np.unique(np.linspace(0, len(starts) - 1, _MOST_ASKED).round().astype(int))]


if __name__ == "__main__":
    sys.exit(main())
