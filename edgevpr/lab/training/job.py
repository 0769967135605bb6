"""The whole job of `edgevpr train calc`: from folders of pictures to a checked ONNX file and its card.

PyTorch is imported only after everything has been checked that can be checked without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import progress
from edgevpr.frames.images import cv2
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
_LOSSES_SAID = 50  # steps over which a reported loss is averaged: one batch says little


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingResult:
    """Result of a training: paths of network and card, the numbers of pictures and steps, the mean loss of the first
    and last 50 steps of this run (None if the checkpoint was of the last step), and the largest difference between the
    outputs of the file and of PyTorch."""

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
    """Train on the images of `folders` and write `out` (ONNX) and its card beside it; see `calc.Training`. `resume`
    continues from the checkpoint beside `out`, which is kept until both are written.

    Images that cannot be used are added to `unusable`. Raises UsageError for settings that make no sense or files that
    exist already, and what `read_pictures`, `require_packages`, `Training` and `write_model` raise.
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


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
