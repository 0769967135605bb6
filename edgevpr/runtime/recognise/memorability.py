"""Memorability: how well the parts of a frame can be remembered, by a network with a card (thesis 3.2.1).

The picture is cut into 5x5 crops that do not overlap. The network says of each how memorable it is, 0..1; between the
middles of the crops the map is interpolated. `benchmarks/matchability.py` fits a network that says how likely such a
part is to be found again.
"""

from typing import Any

import cv2
import numpy as np

from edgevpr.core.errors import ModelError
from edgevpr.techniques.card import Card, InputRule, load_card
from edgevpr.techniques.session import open_session, prepare, run_outputs

CROPS = 5  # a side: C = 5x5 of the thesis
_SEED = 7


class Memorability:
    """A network of memorability that has run successfully."""

    def __init__(self, card: Card, session: Any) -> None:
        self.card, self._session = card, session
        self._takes_many = type(session.get_inputs()[0].shape[0]) is not int

    def matrix(self, image: np.ndarray) -> np.ndarray:
        """Compute M of thesis 3.2.1 for uint8 (H, W[, 3]): the memorability of each crop, float32 (5, 5) in 0..1.

        Raises ModelError for numbers that are not finite, or are outside 0..1.
        """
        rule, name = self.card.input, self.card.outputs.memorability
        crops = prepared_crops(image, rule)
        batches = [crops] if self._takes_many else np.split(crops, len(crops))
        said = [run_outputs(self.card, self._session, [name], batch)[0] for batch in batches]
        if any(part.size != len(batch) for part, batch in zip(said, batches, strict=True)):
            raise ModelError(f"{self.card.path}: `{name}` must be one number a picture: correct `outputs`.")
        values = np.concatenate([part.ravel() for part in said]).astype(np.float32)
        if values.min() < 0 or values.max() > 1:
            raise ModelError(f"{self.card.path}: `{name}` is {values.max():g} for a picture: it must be from 0 to 1.")
        return values.reshape(CROPS, CROPS)


def prepared_crops(image: np.ndarray, rule: InputRule) -> np.ndarray:
    """Cut uint8 (H, W[, 3]), 5 pixels a side at least, into its crops, row by row, each prepared for a network: float32
    (25, C, height, width), or (25, height, width, C) for NHWC."""
    rows, columns = (np.array_split(np.arange(side), CROPS) for side in image.shape[:2])
    return np.concatenate([prepare(image[y[0] : y[-1] + 1, x[0] : x[-1] + 1], rule) for y in rows for x in columns])


def as_map(matrix: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Interpolate the matrix of the crops to (height, width) pixels, bilinearly: float32."""
    return cv2.resize(matrix, size_px[::-1], interpolation=cv2.INTER_LINEAR)


def open_memorability(model: str, threads: int = 1) -> Memorability:
    """Open the network of the card `model` as `memorability_of` does."""
    return memorability_of(load_card(model), threads)


def memorability_of(card: Card, threads: int = 1) -> Memorability:
    """Open the network of a card, and run it once. Raises ModelError, one sentence, for a card without memorability and
    for whatever keeps it from flying."""
    if card.outputs.memorability is None:
        raise ModelError(f"{card.path} has no `outputs.memorability`: name the card of a network that has.")
    network = Memorability(card, open_session(card, threads))
    network.matrix(np.random.default_rng(_SEED).integers(0, 256, (480, 640, 3), np.uint8))
    return network
