"""The whole job of `edgevpr train calc`: from folders of pictures to a checked ONNX file and its card.

PyTorch is imported only after everything has been checked that can be checked without it.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.files import require_folder
from edgevpr.frames.images import cv2
from edgevpr.lab.training.pictures import HEIGHT, WIDTH, batch, read_pictures, small_grey
from edgevpr.techniques.card import InputRule

MIN_PICTURES = 16
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
_LOSSES_SAID = 50  # steps over which the reported loss is averaged: one batch says little


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingResult:
    """Result of a training: paths of network and card, the numbers of pictures and steps, the mean loss of the last 50
    steps, and the largest difference between the outputs of the file and of PyTorch."""

    model: str
    card: str
    pictures: int
    steps: int
    loss: float
    largest_difference: float


def train_calc(folders: Sequence[str], out: Path, steps: int, seed: int, unusable: list[ImageError]) -> TrainingResult:
    """Train on the images of `folders` and write `out` (ONNX) and its card beside it; see `calc`.

    Images that cannot be used are added to `unusable`. Raises UsageError for settings that make no sense, files that
    exist already or fewer than 16 pictures, EdgevprError if a package of the extra `train` cannot be imported, and what
    `read_pictures` and `write_model` raise.
    """
    if steps < 1 or seed < 0:
        raise UsageError(f"--steps {steps} --seed {seed}: give at least 1 step and a seed of 0 or more.")
    _require_new(out)
    pictures = [small_grey(picture) for picture in read_pictures(folders, "reading", unusable)]
    if len(pictures) < MIN_PICTURES:
        raise UsageError(
            f"{len(pictures)} usable images are too few to learn from: give folders with {MIN_PICTURES} at the very "
            "least, better thousands, of the kind of ground that will be flown over."
        )
    for package in ("torch", "onnx", "onnxscript"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise EdgevprError(
                f"Training needs {package}, which cannot be imported ({error}): pip install 'edgevpr[train]'."
            ) from error
    cv2.setNumThreads(1)

    from edgevpr.lab.training.calc import fitted
    from edgevpr.lab.training.onnxfile import ModelFile, write_model

    encoder, losses = fitted(pictures, steps, seed)
    inputs, _ = batch(pictures, _CHECKED_INPUTS, np.random.default_rng(seed))
    names = ", ".join(Path(folder).as_posix() for folder in folders)
    file = ModelFile(
        path=out,
        title="CALC (Merrill and Huang 2018), trained by edgevpr",
        source=f"edgevpr train calc --steps {steps} --seed {seed}; {len(pictures)} images of {names}",
        input="image",
        rule=_INPUT,
        outputs={"descriptor": "descriptor", "features": "features"},
    )
    largest = write_model(file, encoder, list(inputs[:, None]))
    return TrainingResult(
        model=str(out),
        card=str(file.card),
        pictures=len(pictures),
        steps=steps,
        loss=float(np.mean(losses[-_LOSSES_SAID:])),
        largest_difference=largest,
    )


def _require_new(out: Path) -> None:
    if out.suffix != ".onnx":
        raise UsageError(f"--out {out}: give a name that ends in .onnx.")
    for path in (out, out.with_suffix(".yaml")):
        if path.exists():
            raise UsageError(f"{path} is there already: give another --out, or delete it.")
    require_folder(out)
