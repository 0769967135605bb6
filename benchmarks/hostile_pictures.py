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
from base import Row, infer_camera
from unreal_pictures import SPOILT, draw_display, overlay_figures, yield_pictures, yield_spoilt

from edgevpr.core.arrays import Image
from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser

Query = tuple[str, Image, frozenset[str]]  # a kind, a picture, and the references that it may be taken for
Draw = Callable[[Image], Image]
Rng = np.random.Generator


def run(count: int, seed: int, names: Iterable[str] | None = None) -> list[Row]:
    """Ask about `count` pictures of each kind in the map of every set (or of those named); count what is
    accepted, right or wrong, by kind and set."""
    folders, rows = base.find_sets(), []
    for number, folder in enumerate(folders):
        if names is not None and folder.name not in names:
            continue
        dataset, rng = walks.load_matched_set(folder), np.random.default_rng((seed + number, 1))
        counts: dict[str, Row] = {}
        _ask_map(folder, _yield_plain(dataset, folders, count, rng, seed + number), counts)
        shape = read_image(dataset.queries[0].path).shape[:2]
        for what, over in (("a display", draw_display), ("figures", overlay_figures)):
            draw = partial(_draw_overlay, shape=shape, over=over, seed=seed + number)
            queries = _yield_overlaid(dataset, folders, count, rng, draw)
            renamed = ((f"{kind} behind {what}", image, right) for kind, image, right in queries)
            _ask_map(folder, renamed, counts, draw)
        fields = {"set": folder.name, "camera": infer_camera(folder.name)}
        rows += [{"kind": kind, **fields, **numbers} for kind, numbers in counts.items()]
    return rows


def open_set_map(folder: Path, temporary: Path, draw: Draw | None = None) -> Recogniser:
    """Map the references of a set, with `draw` as it makes them, with `cohog`, and open the map as a flight does."""
    path, camera = temporary / "m.gpkg", infer_camera(folder.name)
    technique, frames = walks.make_cohog(camera), walks.read_folder_frames(folder / "ref")
    with PlaceMap.create(path, technique.spec) as place_map:
        overlaid = (replace(frame, image=draw(frame.image)) for frame in frames) if draw else frames
        build_map(overlaid, FrameEncoder(technique=technique), place_map)
    return open_recogniser(walks.make_config(map=str(path), **{"source.camera": camera}), load_board("this"))


def _ask_map(folder: Path, queries: Iterator[Query], counts: dict[str, Row], draw: Draw | None = None) -> None:
    """Ask pictures in the map of a set, and add to the counts of their kinds what is accepted."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-hostile-") as temporary:
        recogniser = open_set_map(folder, Path(temporary), draw)
        with recogniser.place_map:
            for kind, image, may_be in queries:
                event = recogniser.step(walks.make_frame(image, kind))
                count = counts.setdefault(kind, {"tried": 0, "accepted": 0, "accepted_wrong": 0})
                count["tried"] += 1
                count["accepted"] += event.accepted
                count["accepted_wrong"] += event.accepted and event.best.place.source_image not in may_be


def _yield_plain(dataset: Dataset, folders: list[Path], count: int, rng: Rng, seed: int) -> Iterator[Query]:
    for _, image in yield_pictures(seed, count):
        yield "of nothing", image, frozenset()
    queries = -(-count // len(SPOILT))
    for number in rng.choice(len(dataset.queries), queries, replace=queries > len(dataset.queries)):
        query = dataset.queries[number]
        for _, image in yield_spoilt(seed + int(number), read_image(query.path)):
            yield "spoilt", image, query.correct | query.ignored
    for kind, same_camera in (("of other sites", True), ("of the other camera", False)):
        for image in _yield_foreign(dataset, folders, count, rng, same_camera):
            yield kind, image, frozenset()


def _yield_overlaid(dataset: Dataset, folders: list[Path], count: int, rng: Rng, draw: Draw) -> Iterator[Query]:
    for query in dataset.queries[:: -(-len(dataset.queries) // count)]:
        yield "its own", draw(read_image(query.path)), query.correct | query.ignored
    for image in _yield_foreign(dataset, folders, count, rng, same_camera=True):
        yield "of other sites", draw(image), frozenset()


def _yield_foreign(dataset: Dataset, folders: list[Path], count: int, rng: Rng, same_camera: bool) -> Iterator[Image]:
    """Yield pictures of other sets, by a camera that looks the same way or the other; one asked again is turned."""
    own = dataset.queries[0].path.parent.parent
    camera = infer_camera(own.name)
    others = [folder for folder in folders if (infer_camera(folder.name) == camera) == same_camera and folder != own]
    paths = [path for other in others for part in ("query", "ref") for path in list_images(other / part)]
    order = rng.permutation(len(paths))
    for number in range(count):
        path, turns = paths[order[number % len(paths)]], number // len(paths)
        yield np.ascontiguousarray(np.rot90(read_image(path), turns))


def _draw_overlay(picture: Image, shape: tuple[int, int], over: Callable[..., Image], seed: int) -> Image:
    """Return the middle of a picture as one of this shape, (height, width), in colour, with what `over` draws."""
    (height, width), larger = shape, max(shape[0] / picture.shape[0], shape[1] / picture.shape[1])
    picture = cv2.resize(picture, None, fx=larger, fy=larger, interpolation=cv2.INTER_AREA)
    top, left = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
    picture = np.ascontiguousarray(picture[top : top + height, left : left + width])
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    return over(picture, np.random.default_rng(seed))
