"""Match misleading pictures in the map of every set: none may be accepted as another place.

In the map of every image set are matched: pictures of nothing real (screens without a signal, displays over a blank
image, noise, sky), the set's own queries spoilt (covered, out of focus, smeared), pictures of other sites, and pictures
of a camera that looks the other way. Then a display, or only its figures, is drawn over all pictures, those of the map
included, without a mask: own queries and pictures of other sites are matched again. A picture that is accepted as its
own place is no error. Everything follows from a seed.
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

Query = tuple[str, Image, frozenset[str]]  # the kind, the picture, and the references that it may match
Draw = Callable[[Image], Image]
Rng = np.random.Generator


def run(count: int, seed: int, names: Iterable[str] | None = None) -> list[Row]:
    """Match about `count` pictures of each kind in the map of every set (or of those named). Returns a row for each
    kind and set: how many were tried, accepted, and accepted wrongly."""
    folders, rows = base.find_sets(), []
    for number, folder in enumerate(folders):
        if names is not None and folder.name not in names:
            continue
        dataset, rng = walks.load_matched_set(folder), np.random.default_rng((seed + number, 1))
        counts: dict[str, Row] = {}
        _match_queries(folder, _yield_plain(dataset, folders, count, rng, seed + number), counts)
        shape = read_image(dataset.queries[0].path).shape[:2]
        for overlay, draw_over in (("a display", draw_display), ("figures", overlay_figures)):
            draw = partial(_draw_overlay, shape=shape, draw_over=draw_over, seed=seed + number)
            queries = _yield_overlaid(dataset, folders, count, rng, draw)
            renamed = ((f"{kind} behind {overlay}", image, right) for kind, image, right in queries)
            _match_queries(folder, renamed, counts, draw)
        fields = {"set": folder.name, "camera": infer_camera(folder.name)}
        rows += [{"kind": kind, **fields, **numbers} for kind, numbers in counts.items()]
    return rows


def open_set_map(folder: Path, temporary: Path, draw: Draw | None = None) -> Recogniser:
    """Map the references of a set, changed by `draw`, with `cohog`, and open the map as a flight does."""
    path, camera = temporary / "m.gpkg", infer_camera(folder.name)
    technique, frames = walks.make_cohog(camera), walks.read_folder_frames(folder / "ref")
    with PlaceMap.create(path, technique.spec) as place_map:
        drawn = (replace(frame, image=draw(frame.image)) for frame in frames) if draw else frames
        build_map(drawn, FrameEncoder(technique=technique), place_map)
    return open_recogniser(walks.make_config(map=str(path), **{"source.camera": camera}), load_board("this"))


def _match_queries(folder: Path, queries: Iterator[Query], counts: dict[str, Row], draw: Draw | None = None) -> None:
    """Match pictures in the map of a set, and add the accepted ones to the counts of their kinds."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-hostile-") as temporary:
        recogniser = open_set_map(folder, Path(temporary), draw)
        with recogniser.place_map:
            for kind, image, allowed in queries:
                event = recogniser.step(walks.make_frame(image, kind))
                count = counts.setdefault(kind, {"tried": 0, "accepted": 0, "accepted_wrong": 0})
                count["tried"] += 1
                count["accepted"] += event.accepted
                count["accepted_wrong"] += event.accepted and event.best.place.source_image not in allowed


def _yield_plain(dataset: Dataset, folders: list[Path], count: int, rng: Rng, seed: int) -> Iterator[Query]:
    """Yield the queries without an overlay: of nothing, spoilt, of other sites, and of the other camera."""
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
    """Yield pictures of other sets, by the same kind of camera or the other; repeated pictures are rotated."""
    home = dataset.queries[0].path.parent.parent
    camera = infer_camera(home.name)
    others = [folder for folder in folders if (infer_camera(folder.name) == camera) == same_camera and folder != home]
    paths = [path for other in others for part in ("query", "ref") for path in list_images(other / part)]
    order = rng.permutation(len(paths))
    for number in range(count):
        path, turns = paths[order[number % len(paths)]], number // len(paths)
        yield np.ascontiguousarray(np.rot90(read_image(path), turns))


def _draw_overlay(picture: Image, shape: tuple[int, int], draw_over: Callable[..., Image], seed: int) -> Image:
    """Return the middle of a picture, scaled to `shape` (height, width), in colour, with what `draw_over` draws."""
    height, width = shape
    scale = max(height / picture.shape[0], width / picture.shape[1])
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    top, left = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
    picture = np.ascontiguousarray(picture[top : top + height, left : left + width])
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    return draw_over(picture, np.random.default_rng(seed))
