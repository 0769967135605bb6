"""The whole job of `edgevpr train calc`: pictures in, a checked ONNX file and its card out."""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.files import require_folder
from edgevpr.core.text import progress
from edgevpr.frames.images import cv2
from edgevpr.lab.training.pictures import batch, read_pictures, require_enough, small_grey

_CHECKED_INPUTS = 16
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


def require_packages() -> None:
    """Raise EdgevprError if the packages of the extra `train` (torch, onnx) cannot be imported."""
    for package in ("torch", "onnx"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise EdgevprError(
                f"Training needs {package}, which cannot be imported ({error}): pip install 'edgevpr[train]'."
            ) from error


def train_calc(
    folders: Sequence[str], out: Path, steps: int, seed: int, resume: bool, unusable: list[ImageError]
) -> TrainingResult:
    """Train on the images of `folders` and write `out` (ONNX) and its card beside it; see `calc.Training`.

    A checkpoint beside `out` is kept until both are written. Images that cannot be used are added to `unusable`. Raises
    UsageError for settings that make no sense or files that exist already, and what `read_pictures`,
    `require_packages`, `Training` and `export` raise.
    """
    if steps < 1 or seed < 0:
        raise UsageError(f"--steps {steps} --seed {seed}: give at least 1 step and a seed of 0 or more.")
    if out.suffix != ".onnx":
        raise UsageError(f"--out {out}: give a name that ends in .onnx.")
    card, checkpoint = out.with_suffix(".yaml"), out.with_suffix(".checkpoint")
    for path in (out, card):
        if path.exists():
            raise UsageError(f"{path} is there already: give another --out, or delete it.")
    if checkpoint.exists() and not resume:
        raise UsageError(f"{checkpoint} is of a training that was stopped: add --resume to go on, or delete it.")
    require_folder(out)
    pictures = [small_grey(picture) for picture in read_pictures(folders, "reading", unusable)]
    require_enough(pictures)
    require_packages()
    cv2.setNumThreads(1)

    from edgevpr.lab.training import export
    from edgevpr.lab.training.calc import Training

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
    encoder = training.encoder()
    export.write_onnx(encoder, out)
    inputs, _ = batch(pictures, _CHECKED_INPUTS, np.random.default_rng(seed))
    try:
        largest = export.require_equal(encoder, out, inputs)
    except EdgevprError:
        out.unlink()  # a wrong file must not be taken for a model, nor be in the way of another try
        raise
    names = ", ".join(Path(folder).as_posix() for folder in folders)
    source = f"edgevpr train calc --steps {steps} --seed {seed}; {len(pictures)} images of {names}"
    export.write_card(card, out, "CALC (Merrill and Huang 2018), trained by edgevpr", source)
    checkpoint.unlink()
    first, last = _mean(training.losses[:_LOSSES_SAID]), _mean(training.losses[-_LOSSES_SAID:])
    return TrainingResult(
        model=str(out),
        card=str(card),
        pictures=len(pictures),
        steps=steps,
        first_loss=first,
        last_loss=last,
        largest_difference=largest,
    )


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
