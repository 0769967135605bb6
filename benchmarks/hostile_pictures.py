"""Pictures that say nothing, and flights of such pictures over every map: nothing of them may be accepted.

`pictures` makes pictures of nothing real: screens without a signal, displays on a blank ground, noise, sky, and others.
`spoilt` makes pictures that hide a real one: covered, out of focus, smeared. `run` asks in the map of every image set:
pictures of nothing, the set's own queries spoilt, and pictures by a camera that looks the other way. It counts what is
accepted. A spoilt picture that is recognised as its own place is no fault. Everything follows from a seed.
"""

import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import base  # noqa: F401
import numpy as np
from pictures_of_nothing import SPOILT, pictures, spoilt
from run_sets import DATA, FROM_THE_AIR

from edgevpr.core.config import load_config
from edgevpr.core.types import Frame
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import meter_of, open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

OF_NOTHING, OTHER_CAMERA = "nothing: ", "other camera: "  # how kinds begin


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Count of pictures of one kind that were asked in the map of one set, and of those accepted, right or wrong."""

    kind: str
    set: str
    camera: str
    tried: int
    accepted: int
    accepted_wrong: int


@dataclass(frozen=True, slots=True)
class _Asked:
    """A picture to ask: its kind, and the references that it may be taken for (empty: none)."""

    kind: str
    image: np.ndarray
    may_be: frozenset[str] = frozenset()


def run(count: int, seed: int, data: Path = DATA, names: Iterable[str] | None = None) -> list[Row]:
    """Ask `count` pictures of nothing, about `count` spoilt ones and `count` by the other camera in the map of every
    set of `data` (or of those named), and count by kind and set."""
    folders = [path.parent for path in sorted(data.glob("*/ground_truth.csv"))]
    rows = []
    for number, folder in enumerate(folders):
        if names is None or folder.name in names:
            others = [each for each in folders if camera_of(each.name) != camera_of(folder.name)]
            rows += _counted(folder, others, count, seed + number)
    return rows


def camera_of(name: str) -> str:
    return "nadir" if name.startswith(FROM_THE_AIR) else "forward"


def _counted(folder: Path, others: list[Path], count: int, seed: int) -> list[Row]:
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    tried: Counter[str] = Counter()
    accepted: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="edgevpr-hostile-") as temporary:
        recogniser = mapped(folder, Path(temporary))
        with recogniser.place_map:
            for asked in _asked(dataset, others, count, seed):
                event = recogniser.step(Frame(image=asked.image, name=asked.kind, t_mono_s=0.0))
                tried[asked.kind] += 1
                if event.accepted:
                    accepted[asked.kind] += 1
                    wrong[asked.kind] += event.best.place.source_image not in asked.may_be
    return [
        Row(
            kind=kind,
            set=folder.name,
            camera=camera_of(folder.name),
            tried=tried[kind],
            accepted=accepted[kind],
            accepted_wrong=wrong[kind],
        )
        for kind in tried
    ]


def mapped(folder: Path, temporary: Path) -> Recogniser:
    """Map the references of a set with `cohog`, and open the map as a flight does."""
    config = load_config(None, {"map": str(temporary / "m.gpkg"), "source.camera": camera_of(folder.name)})
    board = load_board("this")
    technique = create("cohog", {"camera": camera_of(folder.name)})
    source = open_source(str(folder / "ref"), live=False)
    with PlaceMap.create(config.map, technique.spec) as place_map:
        build_map((source.read(0) for _ in range(source.total)), technique, place_map, meter_of(config, board))
    return open_recogniser(config, board)


def _asked(dataset: Dataset, others: list[Path], count: int, seed: int) -> Iterator[_Asked]:
    for kind, image in pictures(seed, count):
        yield _Asked(OF_NOTHING + kind, image)
    rng = np.random.default_rng((seed, 1))
    queries = -(-count // len(SPOILT))
    for number in rng.choice(len(dataset.queries), queries, replace=queries > len(dataset.queries)):
        query = dataset.queries[number]
        for kind, image in spoilt(seed + int(number), read_image(query.path)):
            yield _Asked(kind, image, query.right | query.ignored)
    paths = [path for other in others for part in ("query", "ref") for path in list_images(other / part)]
    order = rng.permutation(len(paths))
    for number in range(count):
        path, turns = paths[order[number % len(paths)]], number // len(paths)  # a picture asked again is turned
        yield _Asked(OTHER_CAMERA + path.parents[1].name, np.ascontiguousarray(np.rot90(read_image(path), turns)))


def run_in_groups(count: int, seed: int) -> list[Row]:
    """Run as `run` does, and add up the kinds of each group: pictures of nothing, of the other camera, and spoilt."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in run(count, seed):
        groups.setdefault((_group(row), row.set, row.camera), []).append(row)
    return [
        Row(
            kind=kind,
            set=name,
            camera=camera,
            tried=sum(row.tried for row in rows),
            accepted=sum(row.accepted for row in rows),
            accepted_wrong=sum(row.accepted_wrong for row in rows),
        )
        for (kind, name, camera), rows in groups.items()
    ]


def _group(row: Row) -> str:
    """Return the group of a kind, in words."""
    groups = {OF_NOTHING: "of nothing", OTHER_CAMERA: "of the other camera"}
    return next((group for begin, group in groups.items() if row.kind.startswith(begin)), "spoilt")
