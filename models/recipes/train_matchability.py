"""How the network of matchability is fitted that edgevpr ships: it says how likely a picture's parts are found again
(thesis 7.2, item 2). `python models/recipes/train_matchability.py OUT.onnx` fits it to the sets that were used for it.

A map of a site is asked about each of its own places, changed in view, light and sharpness, from hardly at all to
beyond recognition. Labels come so without any truth: the right answer is the place itself. Its neighbours are left out,
since they show the same ground. A label belongs to the changed picture: that is what a camera would see. Where a data
set has queries with a ground truth, these are asked as they are.

The network sees one of 5x5 crops at a time, as the network of the thesis does (3.2.1), and a frame's score is the mean
over its crops; so the labels of frames teach what a crop is worth. It is a logistic regression on eight statistics of a
crop: a convolutional network of 6,000 weights was worse at the changed pictures of every site that it had not seen.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional
from write_onnx import ModelFile, write_model

from edgevpr.core.arrays import Bools, Bytes, Image, Singles
from edgevpr.core.text import progress
from edgevpr.frames.images import cv2, list_images, read_image
from edgevpr.lab.evaluate.metrics import roc_auc
from edgevpr.runtime.recognise.gate_networks import prepare_crops
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques.card import InputRule

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))

import base
import walks

# Sets of which no network learns: of five places, and of 64x32 pixels.
NOT_LEARNT = ("grief_michigan_monthly", "grief_stromovka_monthly", "nordland_tiny")
TECHNIQUES = ("hog", "calc", "cohog")
TURNS = ("cohog",)  # techniques that know a picture under every heading, where the camera looks down
CHANGES = 3  # of each place
MATCHED = 0.5  # a picture is matched if so many of the techniques know it
_NEIGHBOURS = 3  # before and after a place, in the order of the frames


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
    """Answers to a question: `found` is the share of the techniques that answered it rightly."""

    question: Question
    found: float


def label_site(folder: Path, looks_down: bool, seed: int) -> list[Labelled]:
    """Label changed copies of the references of one data set, and its queries by its ground truth where it has one.

    `folder` has ref/ and may have query/ and ground_truth.csv. Raises SourceError or ImageError for images that cannot
    be used, and ModelError for a network that cannot be used.
    """
    places = list_images(folder / "ref")
    questions = _questions(folder, places, seed)
    answers = []
    for name in TECHNIQUES:
        turns = looks_down and name in TURNS
        with walks.open_walk(places, name, looks_down) as walk:
            asked = progress(questions, len(questions), f"{folder.name}, {name}")
            answers.append([_answer(walk, question, turns) for question in asked])
    return list(map(Labelled, questions, np.mean(answers, axis=0).tolist()))


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


def _questions(folder: Path, places: list[Path], seed: int) -> list[Question]:
    asked = []
    for slot, path in enumerate(places):
        near = frozenset(range(slot - _NEIGHBOURS, slot + _NEIGHBOURS + 1)) - {slot}
        asked += [Question(path, (seed, slot, change), frozenset({slot}), near) for change in range(CHANGES)]
    truth = folder / "ground_truth.csv"
    numbers = {path.name: slot for slot, path in enumerate(places)}
    for query in walks.load_matched_set(folder).queries if truth.is_file() else ():
        right, ignored = (frozenset(numbers[name] for name in names) for names in (query.right, query.ignored))
        asked.append(Question(query.path, None, right, ignored))
    return asked


def _answer(walk: Recogniser, question: Question, turns: bool) -> bool:
    """Tell whether a right place scores higher than all others."""
    ranking = walk.step(walks.make_frame(question.picture(turns))).ranking
    if ranking is None:
        return False
    scores = dict(zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True))
    own = max((score for slot, score in scores.items() if slot in question.right), default=0.0)
    others = (score for slot, score in scores.items() if slot not in question.right | question.ignored)
    return own > max(others, default=0.0)


HEIGHT, WIDTH = 48, 64  # of a crop
INPUT = InputRule(
    layout="NCHW",
    height=HEIGHT,
    width=WIDTH,
    colour="grey",
    equalise=False,
    resize="area",
    scale=1 / 255,
    mean=[0.0],
)
_BATCH = 16
_SCALES, _UNEVEN_SCALES = 4, 2
_FLOOR = 1e-4  # of what a logarithm is taken


class Statistics(nn.Module):
    """Mean, contrast, and on four scales the logarithm of the strength of edges after the contrast is taken out, with
    how unevenly they are spread on two of them; a logistic regression on all of it."""

    RATE, STEPS = 0.03, 400
    NOISE = 3 / 255  # a weaker contrast than that is the sensor's
    LENGTH = 2 + _SCALES + _UNEVEN_SCALES

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(self.LENGTH, affine=False)
        self.linear = nn.Linear(self.LENGTH, 1)

    def forward(self, crops: torch.Tensor) -> torch.Tensor:
        mean = crops.mean((2, 3), keepdim=True)
        contrast = ((crops - mean) ** 2).mean((2, 3), keepdim=True).add(self.NOISE**2).sqrt()
        even = (crops - mean) / contrast
        said = [mean, contrast.log()]
        for scale in range(_SCALES):
            here = even[..., :-1, :-1]
            strength = (even[..., 1:, :-1] - here) ** 2 + (even[..., :-1, 1:] - here) ** 2
            usual = strength.mean((2, 3), keepdim=True) + _FLOOR
            said.append(usual.log())
            if scale < _UNEVEN_SCALES:
                said.append(((strength**2).mean((2, 3), keepdim=True) / usual**2 + _FLOOR).log())
            even = functional.avg_pool2d(even, 2)
        return torch.sigmoid(self.linear(self.norm(torch.cat(said, 1).flatten(1))))


@dataclass(frozen=True, slots=True)
class TrainingSite:
    """The pictures of one site: `crops` uint8 (N, 25, 1, 48, 64), the share of the techniques that knew each rightly,
    float32 (N,), and which are real queries, not generated, bool (N,)."""

    name: str
    crops: Bytes
    found: Singles
    is_real: Bools

    def inputs(self, frame: int) -> torch.Tensor:
        """Return a picture's crops as the network takes them, float32 (25, 1, 48, 64) in 0..1."""
        return torch.from_numpy(self.crops[frame]) / 255


def site_of(name: str, labelled: Sequence[Labelled]) -> TrainingSite:
    """Read the labelled pictures of a site, and cut them into crops as in flight."""
    pictures = (label.question.picture() for label in labelled)
    crops = np.stack([(255 * prepare_crops(picture, INPUT)).round().astype(np.uint8) for picture in pictures])
    found = np.array([label.found for label in labelled], np.float32)
    return TrainingSite(name, crops, found, np.array([label.question.change is None for label in labelled]))


def fit(sites: Sequence[TrainingSite], seed: int) -> nn.Module:
    """Fit a network to the frames of all sites, each site as often as any other."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = Statistics().train()
    optimiser = torch.optim.AdamW(network.parameters(), Statistics.RATE, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, Statistics.STEPS)
    for _ in range(Statistics.STEPS):
        chosen = [sites[number] for number in rng.integers(len(sites), size=_BATCH)]
        frames = [rng.integers(len(site.found)) for site in chosen]
        crops = torch.stack([site.inputs(frame) for site, frame in zip(chosen, frames, strict=True)])
        found = torch.tensor([float(site.found[frame]) for site, frame in zip(chosen, frames, strict=True)])
        said = network(crops.flatten(0, 1)).reshape(_BATCH, -1).mean(1)
        loss = functional.binary_cross_entropy(said, found)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network.eval()


def scores(network: nn.Module, site: TrainingSite) -> Singles:
    """Return the score of every frame of a site, float32 (N,) in 0..1."""
    with torch.no_grad():
        said = [network(site.inputs(frame)).mean().item() for frame in range(len(site.found))]
    return np.array(said, np.float32)


def leave_one_out(sites: Sequence[TrainingSite], seed: int) -> dict[str, dict[str, float | None]]:
    """Judge a network on each site that it has not seen. By site, the share of pairs of pictures, one known by most
    techniques and one not, that it puts in the right order: of `generated` changes, and of `real` queries. .5 is
    chance; None: all pictures are alike, or there are none."""
    unseen: dict[str, dict[str, float | None]] = {"generated": {}, "real": {}}
    for site in sites:
        said = scores(fit([other for other in sites if other is not site], seed), site)
        for judged, of in (("generated", ~site.is_real), ("real", site.is_real)):
            unseen[judged][site.name] = roc_auc(said[of], site.found[of] >= MATCHED)
    return unseen


def write_network(
    network: nn.Module, out: Path, title: str, source: str, site: TrainingSite
) -> tuple[ModelFile, float]:
    """Write a fitted network, `crops` (N, 1, 48, 64) in 0..1 -> `memorability` (N, 1), and its card; tried on a picture
    of `site`. Returns the file, and the largest difference to PyTorch; raises what `write_model` raises."""
    outputs = {"memorability": "memorability"}
    file = ModelFile(path=out, title=title, source=source, input="crops", rule=INPUT, outputs=outputs)
    return file, write_model(file, network, [site.inputs(0).numpy()])


def main() -> None:
    """Fit a network to all sets that it may learn from."""
    labelled = {
        folder.name: label_site(folder, base.infer_camera(folder.name) == "nadir", 1)
        for folder in base.find_sets()
        if folder.name not in NOT_LEARNT
    }
    sites = [site_of(name, labels) for name, labels in labelled.items()]
    unseen = [each for each in leave_one_out(sites, 1)["generated"].values() if each is not None]
    source = (
        f"models/recipes/train_matchability.py; {sum(map(len, labelled.values()))} pictures of "
        f"{', '.join(labelled)}; on a site left out {np.mean(unseen):.2f} of pairs of changed pictures in the right "
        "order"
    )
    write_network(fit(sites, 1), Path(sys.argv[1]), "Matchability, trained by edgevpr", source, sites[0])


if __name__ == "__main__":
    base.run(main)
