"""Labels of matchability: which frames are found again, and which look like others (thesis 7.2, item 2).

A map of a site is asked about each of its own places, changed in view, light and sharpness, from hardly at all to
beyond recognition. Labels come so without any truth: the right answer is the place itself. Its neighbours are left out,
since they show the same ground. A label belongs to the changed picture: that is what a camera would see. Where a data
set has queries with a ground truth, these are asked as they are.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.config import load_config
from edgevpr.core.types import Frame
from edgevpr.frames.images import cv2, list_images, read_image
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import mapped
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.judge import ACCEPT_NOTHING
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

TECHNIQUES = ("hog", "calc", "cohog")
TURNS = ("cohog",)  # techniques that know a picture under every heading, where the camera looks down
CHANGES = 3  # of each place
MATCHED = 0.5  # a picture is matched if so many of the techniques know it
_NEIGHBOURS = 3  # before and after a place, in the order of the frames
Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Question:
    """A picture to ask a map about: a file, changed by this seed (None: as it is). `right` and `ignored` are slots."""

    path: Path
    change: tuple[int, ...] | None
    right: frozenset[int]
    ignored: frozenset[int]

    def picture(self, turns: bool = False) -> Image:
        """Return the picture, uint8 (H, W[, 3]), with `turns` under any heading. Raises ImageError."""
        picture = read_image(self.path)
        return picture if self.change is None else changed(picture, np.random.default_rng(self.change), turns)


@dataclass(frozen=True, slots=True)
class Labelled:
    """Answers to a question: `found` is the share of the techniques that answered it rightly; `alike` is how much
    the picture looks like the place elsewhere that it resembles most, as a share of how much it looks like its own, the
    mean over the techniques."""

    question: Question
    found: float
    alike: float


def label_site(folder: Path, looks_down: bool, seed: int, progress: Progress) -> list[Labelled]:
    """Label changed copies of the references of one data set, and its queries by its ground truth where it has one.

    `folder` has ref/ and may have query/ and ground_truth.csv. Raises SourceError or ImageError for images that cannot
    be used, and ModelError for a network that cannot be used.
    """
    places = list_images(folder / "ref")
    questions = _questions(folder, places, seed)
    answers = []
    for name in TECHNIQUES:
        turns = looks_down and name in TURNS
        with walk_over(places, name, looks_down) as walk:
            asked = progress(questions, len(questions), f"{folder.name}, {name}")
            answers.append([_answer(walk, question, turns) for question in asked])
    means = np.mean(answers, axis=0).tolist()
    return [Labelled(question, *mean) for question, mean in zip(questions, means, strict=True)]


def changed(picture: Image, rng: np.random.Generator, turns: bool) -> Image:
    """Change a picture as a later flight would: another view (with `turns` under any heading), light, haze, blur and
    noise, most of it little and some of it much; uint8 of the same form. The view changes little: what it costs cannot
    be seen in the picture."""
    height, width = picture.shape[:2]
    turn_deg = rng.uniform(0, 360) if turns else rng.uniform(-3, 3)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, rng.uniform(0.93, 1.08))
    matrix[:, 2] = matrix[:, 2] + rng.uniform(-0.05, 0.05, 2) * (width, height)
    seen = cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    clouds = np.exp(cv2.resize(rng.normal(0, 0.35, (3, 4)), (width, height), interpolation=cv2.INTER_CUBIC))
    dark, haze, blur, noise = rng.uniform(0, 1, 4) ** 2
    values = (seen / 255.0) ** np.exp(rng.normal(0, 0.4))
    values *= (clouds if seen.ndim == 2 else clouds[..., None]) * 1.2 * np.exp(-3 * dark)
    values = cv2.GaussianBlur(values * (1 - 0.95 * haze) + 0.95 * haze * 0.8, (0, 0), 0.3 + 0.015 * blur * width)
    later: Image = np.clip(values * 255 + rng.normal(0, 20 * noise, values.shape), 0, 255).astype(np.uint8)
    return later


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


def _questions(folder: Path, places: list[Path], seed: int) -> list[Question]:
    asked = []
    for slot, path in enumerate(places):
        near = frozenset(range(slot - _NEIGHBOURS, slot + _NEIGHBOURS + 1)) - {slot}
        asked += [Question(path, (seed, slot, change), frozenset({slot}), near) for change in range(CHANGES)]
    truth = folder / "ground_truth.csv"
    numbers = {path.name: slot for slot, path in enumerate(places)}
    for query in load_dataset(folder / "query", folder / "ref", truth).queries if truth.is_file() else ():
        right, ignored = (frozenset(numbers[name] for name in names) for names in (query.right, query.ignored))
        asked.append(Question(query.path, None, right, ignored))
    return asked


def _answer(walk: Recogniser, question: Question, turns: bool) -> tuple[bool, float]:
    ranking = walk.step(Frame(image=question.picture(turns), name="", t_mono_s=0.0)).ranking
    if ranking is None:
        return False, 1.0
    scores = dict(zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True))
    own = max((score for slot, score in scores.items() if slot in question.right), default=0.0)
    others = (score for slot, score in scores.items() if slot not in question.right | question.ignored)
    other = max(others, default=0.0)
    return own > other, 1.0 if own <= 0 else min(1.0, other / own)
