"""The jobs of `edgevpr train calc` and `train matchability`: pictures in, a checked ONNX file and its card out.

PyTorch is imported only when all that can be wrong without it has been checked.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import progress
from edgevpr.frames.images import cv2, list_images
from edgevpr.lab.training.labels import MATCHED, Labelled, label_site
from edgevpr.lab.training.pictures import (
    HEIGHT,
    WIDTH,
    batch,
    read_pictures,
    require_enough,
    require_new,
    require_packages,
    small_grey,
)
from edgevpr.techniques.card import InputRule

_CHECKED_INPUTS = 16
_INPUT = InputRule(
    layout="NCHW",
    height=HEIGHT,
    width=WIDTH,
    colour="grey",
    equalise=True,
    resize="cubic",
    scale=1 / 255,
    mean=[0.0],
)
_FEWEST_SITES, _FEWEST_FRAMES = 3, 8
_LOSSES_SAID = 50  # the reported loss is the mean of as many steps: one batch says little


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingResult:
    """Result of a training: the pictures learned from, the steps, the mean loss of the first and last 50 steps of this
    run (None if the checkpoint was of the last step), and the largest difference between the file and PyTorch."""

    model: str
    card: str
    pictures: int
    steps: int
    first_loss: float | None
    last_loss: float | None
    largest_difference: float


def train_calc(
    folders: Sequence[str], out: Path, steps: int, seed: int, resume: bool, unusable: list[ImageError]
) -> TrainingResult:
    """Train on the images of `folders` and write `out` (ONNX) and its card beside it; see `calc.Training`.

    A checkpoint beside `out` is kept until both are written. Images that cannot be used are added to `unusable`. Raises
    UsageError for settings that make no sense or files that exist already, and what `read_pictures`,
    `require_packages`, `Training` and `write_model` raise.
    """
    if steps < 1 or seed < 0:
        raise UsageError(f"--steps {steps} --seed {seed}: give at least 1 step and a seed of 0 or more.")
    require_new(out)
    checkpoint = out.with_suffix(".checkpoint")
    if checkpoint.exists() and not resume:
        raise UsageError(f"{checkpoint} is of a training that was stopped: add --resume to go on, or delete it.")
    pictures = [small_grey(picture) for picture in read_pictures(folders, "reading", unusable)]
    require_enough(pictures)
    require_packages()
    cv2.setNumThreads(1)

    from edgevpr.lab.training.calc import Training
    from edgevpr.lab.training.onnxfile import ModelFile, write_model

    training = Training(pictures, steps, seed)
    if resume:
        training.load(checkpoint)
    try:
        for _ in progress(training.run(checkpoint), steps - training.step, "training"):
            pass
    except KeyboardInterrupt:
        training.save(checkpoint)
        raise
    training.save(checkpoint)
    inputs, _ = batch(pictures, _CHECKED_INPUTS, np.random.default_rng(seed))
    names = ", ".join(Path(folder).as_posix() for folder in folders)
    source = f"edgevpr train calc --steps {steps} --seed {seed}; {len(pictures)} images of {names}"
    file = ModelFile(
        path=out,
        title="CALC (Merrill and Huang 2018), trained by edgevpr",
        input="image",
        rule=_INPUT,
        outputs={"descriptor": "descriptor", "features": "features"},
    )
    largest = write_model(
        file, training.encoder(), list(inputs[:, None]), source, "run the command again with --resume"
    )
    checkpoint.unlink()
    return TrainingResult(
        model=str(out),
        card=str(file.card),
        pictures=len(pictures),
        steps=steps,
        first_loss=_mean(training.losses[:_LOSSES_SAID]),
        last_loss=_mean(training.losses[-_LOSSES_SAID:]),
        largest_difference=largest,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchabilityResult:
    """Result of a training. `unseen` has by kind of network, by sort of picture (`generated` changes and `real`
    queries) and by site the area under the ROC curve on a site that was left out (None: all its pictures are alike);
    `kind` is the one that was better, and is written. `classes` counts the pictures that are good or confusing (they
    look like another place more than half of their site does), and matched or mismatched (by most techniques)."""

    model: str
    card: str
    kind: str
    frames: int
    unseen: dict[str, dict[str, dict[str, float | None]]]
    classes: dict[str, int]
    largest_difference: float


def train_matchability(folders: Sequence[str], looks_down: Sequence[str], out: Path, seed: int) -> MatchabilityResult:
    """Label the frames of data sets, fit both kinds of network, and write the better one to `out` (ONNX) with its card.

    A data set is a folder with ref/, and query/ and ground_truth.csv where there are any; those of `looks_down` were
    taken looking straight down. Raises UsageError for settings that make no sense or files that exist already, and what
    `label_site` raises.
    """
    require_new(out)
    sets = [(Path(name), False) for name in folders] + [(Path(name), True) for name in looks_down]
    if len(sets) < _FEWEST_SITES:
        raise UsageError(f"{len(sets)} data sets are too few: give {_FEWEST_SITES} at least, each of another site.")
    for folder, _ in sets:
        if len(list_images(folder / "ref")) < _FEWEST_FRAMES:
            raise UsageError(f"{folder}/ref has too few images to tell places apart: {_FEWEST_FRAMES} at least.")
    require_packages()

    from edgevpr.lab.training.matchability import compared, fit, site_of, write_network

    labels = {folder.name: label_site(folder, down, seed, progress) for folder, down in sets}
    sites = [site_of(name, labelled) for name, labelled in labels.items()]
    kind, unseen = compared(sites, seed)
    network = fit(kind, sites, seed)
    frames = sum(map(len, labels.values()))
    source = (
        f"edgevpr train matchability --seed {seed}; {kind}; {frames} pictures of {', '.join(labels)}; on a site left "
        f"out {unseen[kind].mean:.2f} of pairs of changed pictures in the right order"
    )
    file, largest = write_network(network, out, "Matchability, trained by edgevpr", source, sites[0])
    return MatchabilityResult(
        model=str(out),
        card=str(file.card),
        kind=kind,
        frames=frames,
        unseen={name: asdict(result) for name, result in unseen.items()},
        classes=_classes(labels),
        largest_difference=largest,
    )


def _classes(labels: dict[str, list[Labelled]]) -> dict[str, int]:
    """Count the frames of the four classes of thesis 7.2, item 2."""
    counts = dict.fromkeys(("good, matched", "good, mismatched", "confusing, matched", "confusing, mismatched"), 0)
    for labelled in labels.values():
        usual = float(np.median([label.alike for label in labelled]))
        for label in labelled:
            like = "confusing" if label.alike > usual else "good"
            counts[f"{like}, {'matched' if label.found >= MATCHED else 'mismatched'}"] += 1
    return counts


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
