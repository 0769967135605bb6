"""Pictures that say nothing, and flights of such pictures over every map: nothing of them may be accepted.

In the map of every image set are asked: pictures of nothing real (screens without a signal, displays on a blank ground,
noise, sky), the set's own queries spoilt (covered, out of focus, smeared), and pictures by a camera that looks the
other way. A spoilt picture that is recognised as its own place is no fault. Everything follows from a seed.
"""

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import base
import numpy as np
import walks
from base import DATA, Row, camera_of
from pictures_of_nothing import SPOILT, pictures, spoilt

from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser

Asked = tuple[str, np.ndarray, frozenset[str]]  # a kind, a picture, and the references that it may be taken for


def run(count: int, seed: int, data: Path = DATA, names: Iterable[str] | None = None) -> list[Row]:
    """Ask `count` pictures of nothing, about `count` spoilt ones and `count` by the other camera in the map of every
    set of `data` (or of those named); count what is accepted, right or wrong, by kind and set."""
    folders, rows = base.find_sets(data), []
    for number, folder in enumerate(folders):
        if names is not None and folder.name not in names:
            continue
        others = [each for each in folders if camera_of(each.name) != camera_of(folder.name)]
        counts: dict[str, Row] = {}
        with tempfile.TemporaryDirectory(prefix="edgevpr-hostile-") as temporary:
            recogniser = mapped(folder, Path(temporary))
            with recogniser.place_map:
                for kind, image, may_be in _asked(walks.dataset_of(folder), others, count, seed + number):
                    event = recogniser.step(walks.frame(image, kind))
                    of_kind = counts.setdefault(kind, {"tried": 0, "accepted": 0, "accepted_wrong": 0})
                    of_kind["tried"] += 1
                    of_kind["accepted"] += event.accepted
                    of_kind["accepted_wrong"] += event.accepted and event.best.place.source_image not in may_be
        where = {"set": folder.name, "camera": camera_of(folder.name)}
        rows += [{"kind": kind, **where, **of_kind} for kind, of_kind in counts.items()]
    return rows


def mapped(folder: Path, temporary: Path) -> Recogniser:
    """Map the references of a set with `cohog`, and open the map as a flight does."""
    path, camera = temporary / "m.gpkg", camera_of(folder.name)
    technique = walks.cohog(camera)
    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(walks.frames_of(folder / "ref"), technique, place_map, walks.meter())
    return open_recogniser(walks.config(map=str(path), **{"source.camera": camera}), load_board("this"))


def _asked(dataset: Dataset, others: list[Path], count: int, seed: int) -> Iterator[Asked]:
    for _, image in pictures(seed, count):
        yield "of nothing", image, frozenset()
    rng = np.random.default_rng((seed, 1))
    queries = -(-count // len(SPOILT))
    for number in rng.choice(len(dataset.queries), queries, replace=queries > len(dataset.queries)):
        query = dataset.queries[number]
        for _, image in spoilt(seed + int(number), read_image(query.path)):
            yield "spoilt", image, query.right | query.ignored
    paths = [path for other in others for part in ("query", "ref") for path in list_images(other / part)]
    order = rng.permutation(len(paths))
    for number in range(count):
        path, turns = paths[order[number % len(paths)]], number // len(paths)  # a picture asked again is turned
        yield "of the other camera", np.ascontiguousarray(np.rot90(read_image(path), turns)), frozenset()
