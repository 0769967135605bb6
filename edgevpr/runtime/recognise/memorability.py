"""Memorability, for the gate: how well parts of a frame can be remembered, by a network with a card (thesis 3.2.1).

The picture is cut into 5x5 crops that do not overlap. For each crop the network gives its memorability, 0..1. Between
the middles of the crops values are interpolated. `benchmarks/matchability.py` fits a network of another meaning: how
likely a crop is to be found again in another picture.
"""

import cv2
import numpy as np

from edgevpr.core.arrays import Image, Singles
from edgevpr.core.errors import ModelError
from edgevpr.techniques.card import Card, InputRule
from edgevpr.techniques.session import open_session, prepare, run_outputs

CROPS = 5  # along each side; the thesis's C is 5x5
_SEED = 7


class Memorability:
    """The network of memorability that a card describes; the constructor runs it once as a test. Raises ModelError for
    a card without memorability, and for an unusable network."""

    def __init__(self, card: Card, threads: int = 1) -> None:
        if card.outputs.memorability is None:
            raise ModelError(f"{card.path} has no `outputs.memorability`: name the card of a network that has.")
        self.card, self._output = card, card.outputs.memorability
        self._session = open_session(card, threads)
        self._takes_many = type(self._session.get_inputs()[0].shape[0]) is not int
        self.matrix(np.random.default_rng(_SEED).integers(0, 256, (480, 640, 3), np.uint8))

    def matrix(self, image: Image) -> Singles:
        """Compute the memorability of each crop of uint8 (H, W[, 3]): float32 (5, 5) in 0..1, the M of thesis 3.2.1.

        Raises ModelError for numbers that are not finite, or are outside 0..1.
        """
        name, crops = self._output, prepared_crops(image, self.card.input)
        batches = [crops] if self._takes_many else np.split(crops, len(crops))
        said = [run_outputs(self.card, self._session, [name], batch)[0] for batch in batches]
        if any(part.size != len(batch) for part, batch in zip(said, batches, strict=True)):
            raise ModelError(f"{self.card.path}: `{name}` must be one number a picture: correct `outputs`.")
        values = np.concatenate([part.ravel() for part in said]).astype(np.float32)
        if values.min() < 0 or values.max() > 1:
            raise ModelError(f"{self.card.path}: `{name}` is {values.max():g} for a picture: it must be from 0 to 1.")
        return values.reshape(CROPS, CROPS)


def prepared_crops(image: Image, rule: InputRule) -> Singles:
    """Cut uint8 (H, W[, 3]), at least 5 pixels along each side, into crops, row by row, and prepare them for a network:
    float32 (25, C, height, width), or (25, height, width, C) for an input in the order NHWC."""
    rows, columns = (np.array_split(np.arange(side), CROPS) for side in image.shape[:2])
    return np.concatenate([prepare(image[y[0] : y[-1] + 1, x[0] : x[-1] + 1], rule) for y in rows for x in columns])


def as_map(matrix: Singles, size_px: tuple[int, int]) -> Singles:
    """Interpolate the memorability of the crops, float32 (5, 5), bilinearly to float32 `size_px` (height, width)."""
    return np.asarray(cv2.resize(matrix, size_px[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
