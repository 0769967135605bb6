"""Labels of matchability: which frames are found again, and which look like others (thesis 7.2, item 2).

A map of a site is asked for each of its own places, changed in view, light and noise. Labels come so without any truth:
the right answer is the place itself. Its neighbours are left out, since they show the same ground. Where a data set has
queries with a ground truth, these are asked as they are.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.config import load_config
from edgevpr.evaluate.dataset import load_dataset
from edgevpr.evaluate.evaluate import mapped
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.opencv import cv2
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.judge import ACCEPT_NOTHING
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create
from edgevpr.types import Frame

TECHNIQUES = ("hog", "calc", "cohog")
TURNS = ("cohog",)  # techniques that know a picture under every heading, where the camera looks down
CHANGES = 3  # of each place
_NEIGHBOURS = 3  # before and after a place, in the order of the frames
Progress = Callable[[Iterable, int, str], Iterable]


@dataclass(frozen=True, slots=True)
class Labelled:
    """One frame: `found` is the share of the questions about it that were answered rightly; `alike` is how much it
    looks like the place elsewhere that it resembles most, as a share of how much it looks like itself, the mean over
    the questions."""

    path: Path
    found: float
    alike: float


def label_site(folder: Path, looks_down: bool, seed: int, progress: Progress) -> list[Labelled]:
    """Label the references of one data set by their changes, and its queries by its ground truth where it has one.

    `folder` has ref/ and may have query/ and ground_truth.csv. Raises SourceError or ImageError for images that cannot
    be used, and ModelError for a network that cannot be used.
    """
    said: dict[Path, list[tuple[bool, float]]] = {}
    places = list_images(folder / "ref")
    truth = folder / "ground_truth.csv"
    queries = load_dataset(folder / "query", folder / "ref", truth).queries if truth.is_file() else []
    for name in TECHNIQUES:
        turns = looks_down and name in TURNS
        with walk_over(places, name, looks_down) as walk:
            for slot, path in progress(list(enumerate(places)), len(places), f"{folder.name}, {name}: places"):
                near = set(range(slot - _NEIGHBOURS, slot + _NEIGHBOURS + 1)) - {slot}
                picture = read_image(path)
                for change in range(CHANGES):
                    later = changed(picture, np.random.default_rng((seed, slot, change)), turns)
                    said.setdefault(path, []).append(_answer(walk, later, {slot}, near))
            numbers = {path.name: slot for slot, path in enumerate(places)}
            for query in progress(queries, len(queries), f"{folder.name}, {name}: queries"):
                right, ignored = ({numbers[each] for each in names} for names in (query.right, query.ignored))
                said.setdefault(query.path, []).append(_answer(walk, read_image(query.path), right, ignored))
    return [Labelled(path, *map(float, np.mean(answers, axis=0))) for path, answers in said.items()]


def changed(picture: np.ndarray, rng: np.random.Generator, turns: bool) -> np.ndarray:
    """Change a picture as a later flight would: another view (with `turns` under any heading), light, haze, blur and
    noise; uint8 of the same form."""
    height, width = picture.shape[:2]
    turn_deg = rng.uniform(0, 360) if turns else rng.uniform(-3, 3)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, rng.uniform(0.85, 1.2))
    matrix[:, 2] += rng.uniform(-0.12, 0.12, 2) * (width, height)
    seen = cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    clouds = np.exp(cv2.resize(rng.normal(0, 0.35, (3, 4)), (width, height), interpolation=cv2.INTER_CUBIC))
    values = (seen / 255.0) ** np.exp(rng.normal(0, 0.4))
    values *= (clouds if seen.ndim == 2 else clouds[..., None]) * rng.uniform(0.5, 1.2)
    haze = rng.uniform(0, 0.4)
    values = cv2.GaussianBlur(values * (1 - haze) + haze * 0.8, (0, 0), rng.uniform(0.3, 1.5))
    return np.clip(values * 255 + rng.normal(0, rng.uniform(0, 6), values.shape), 0, 255).astype(np.uint8)


@contextmanager
def walk_over(places: Iterable[Path], name: str, looks_down: bool) -> Iterator[Recogniser]:
    """Map images with a technique, and give what recognises in that map, as it flies, and accepts nothing."""
    technique = create(name, {"camera": "nadir"} if looks_down and name in TURNS else {})
    meter = meter_of(load_config(None), load_board("this"))
    with mapped(map(_frame, places), technique, meter) as (place_map, index):
        yield Recogniser(
            technique=technique,
            place_map=place_map,
            index=index,
            rule=ACCEPT_NOTHING,
            meter=meter,
            candidates=technique.candidates,
        )


def _frame(path: Path) -> Frame:
    return Frame(image=read_image(path), name=path.name, t_mono_s=0.0)


def _answer(walk: Recogniser, picture: np.ndarray, right: set[int], ignored: set[int]) -> tuple[bool, float]:
    ranking = walk.step(Frame(image=picture, name="", t_mono_s=0.0)).ranking
    if ranking is None:
        return False, 1.0
    scores = dict(zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True))
    own = max((score for slot, score in scores.items() if slot in right), default=0.0)
    others = (score for slot, score in scores.items() if slot not in right | ignored)
    other = max(others, default=0.0)
    return own > other, 1.0 if own <= 0 else min(1.0, other / own)
