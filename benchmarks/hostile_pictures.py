"""Pictures that say nothing, and flights of such pictures over every map: nothing of them may be accepted.

In the map of every image set are asked: pictures of nothing real (screens without a signal, displays on a blank ground,
noise, sky), the set's own queries spoilt (covered, out of focus, smeared), pictures of other sites, and pictures by a
camera that looks the other way. Then a display, or figures alone, are drawn over everything, the pictures of the map
among it, and no mask is painted: its own queries and other sites are asked again. A picture that is recognised as its
own place is no fault. Everything follows from a seed.
"""

import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import base
import cv2
import numpy as np
import walks
from base import DATA, Row, camera_of
from pictures_of_nothing import SPOILT, draw_display, overlay_figures, yield_pictures, yield_spoilt

from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser

Asked = tuple[str, np.ndarray, frozenset[str]]  # a kind, a picture, and the references that it may be taken for
Draw = Callable[[np.ndarray], np.ndarray]


def run(count: int, seed: int, data: Path = DATA, names: Iterable[str] | None = None) -> list[Row]:
    """Ask about `count` pictures of each kind in the map of every set of `data` (or of those named); count what is
    accepted, right or wrong, by kind and set."""
    folders, rows = base.find_sets(data), []
    for number, folder in enumerate(folders):
        if names is not None and folder.name not in names:
            continue
        dataset, rng = walks.dataset_of(folder), np.random.default_rng((seed + number, 1))
        counts: dict[str, Row] = {}
        _ask(folder, _bare(dataset, folders, count, rng, seed + number), counts)
        shape = read_image(dataset.queries[0].path).shape[:2]
        for what, over in (("a display", draw_display), ("figures", overlay_figures)):
            draw = partial(_drawn, shape=shape, over=over, seed=seed + number)
            asked = _behind(dataset, folders, count, rng, draw)
            _ask(folder, ((f"{kind} behind {what}", image, may_be) for kind, image, may_be in asked), counts, draw)
        where = {"set": folder.name, "camera": camera_of(folder.name)}
        rows += [{"kind": kind, **where, **of_kind} for kind, of_kind in counts.items()]
    return rows


def mapped(folder: Path, temporary: Path, draw: Draw | None = None) -> Recogniser:
    """Map the references of a set, with `draw` as it makes them, with `cohog`, and open the map as a flight does."""
    path, camera = temporary / "m.gpkg", camera_of(folder.name)
    technique, frames = walks.cohog(camera), walks.frames_of(folder / "ref")
    with PlaceMap.create(path, technique.spec) as place_map:
        drawn = (replace(frame, image=draw(frame.image)) for frame in frames) if draw else frames
        build_map(drawn, FrameEncoder(technique=technique), place_map)
    return open_recogniser(walks.config(map=str(path), **{"source.camera": camera}), load_board("this"))


def _ask(folder: Path, asked: Iterator[Asked], counts: dict[str, Row], draw: Draw | None = None) -> None:
    """Ask pictures in the map of a set, and add to the counts of their kinds what is accepted."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-hostile-") as temporary:
        recogniser = mapped(folder, Path(temporary), draw)
        with recogniser.place_map:
            for kind, image, may_be in asked:
                event = recogniser.step(walks.frame(image, kind))
                of_kind = counts.setdefault(kind, {"tried": 0, "accepted": 0, "accepted_wrong": 0})
                of_kind["tried"] += 1
                of_kind["accepted"] += event.accepted
                of_kind["accepted_wrong"] += event.accepted and event.best.place.source_image not in may_be


def _bare(dataset: Dataset, folders: list[Path], count: int, rng: np.random.Generator, seed: int) -> Iterator[Asked]:
    for _, image in yield_pictures(seed, count):
        yield "of nothing", image, frozenset()
    queries = -(-count // len(SPOILT))
    for number in rng.choice(len(dataset.queries), queries, replace=queries > len(dataset.queries)):
        query = dataset.queries[number]
        for _, image in yield_spoilt(seed + int(number), read_image(query.path)):
            yield "spoilt", image, query.correct | query.ignored
    for kind, same_camera in (("of other sites", True), ("of the other camera", False)):
        for image in _foreign(dataset, folders, count, rng, same_camera):
            yield kind, image, frozenset()


def _behind(dataset: Dataset, folders: list[Path], count: int, rng: np.random.Generator, draw: Draw) -> Iterator[Asked]:
    for query in dataset.queries[:: -(-len(dataset.queries) // count)]:
        yield "its own", draw(read_image(query.path)), query.correct | query.ignored
    for image in _foreign(dataset, folders, count, rng, same_camera=True):
        yield "of other sites", draw(image), frozenset()


def _foreign(
    dataset: Dataset, folders: list[Path], count: int, rng: np.random.Generator, same_camera: bool
) -> Iterator[np.ndarray]:
    """Yield pictures of other sets, by a camera that looks the same way or the other; one asked again is turned."""
    own = dataset.queries[0].path.parent.parent
    others = [each for each in folders if (camera_of(each.name) == camera_of(own.name)) == same_camera and each != own]
    paths = [path for other in others for part in ("query", "ref") for path in list_images(other / part)]
    order = rng.permutation(len(paths))
    for number in range(count):
        path, turns = paths[order[number % len(paths)]], number // len(paths)
        yield np.ascontiguousarray(np.rot90(read_image(path), turns))


def _drawn(picture: np.ndarray, shape: tuple[int, int], over: Callable[..., np.ndarray], seed: int) -> np.ndarray:
    """Return the middle of a picture as one of this shape, (height, width), in colour, with what `over` draws."""
    (height, width), larger = shape, max(shape[0] / picture.shape[0], shape[1] / picture.shape[1])
    picture = cv2.resize(picture, None, fx=larger, fy=larger, interpolation=cv2.INTER_AREA)
    top, left = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
    picture = np.ascontiguousarray(picture[top : top + height, left : left + width])
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    return over(picture, np.random.default_rng(seed))
