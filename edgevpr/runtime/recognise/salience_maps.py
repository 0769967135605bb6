"""The three maps of a frame and their scores (thesis 3.2): memorability, staticity, entropy."""

from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.core.types import Salience
from edgevpr.runtime.recognise.memorability import Memorability, as_map
from edgevpr.techniques.entropy import filled_bins

# Of the longer side on which entropy is computed: a larger copy costs more and says the same.
_LONGEST_PX = 320


@dataclass(frozen=True, slots=True)
class Maps:
    """`memorability` float32 in 0..1, `is_static` bool, `entropy` float32 in 0..1 (bits over 8): (H, W) each, of one
    size; None for what is not looked at."""

    memorability: np.ndarray | None
    is_static: np.ndarray | None
    entropy: np.ndarray


def maps_of(image: np.ndarray, memorability: Memorability | None, is_static: np.ndarray | None) -> Maps:
    """Compute the maps of uint8 (H, W[, 3]), the longer side of each 320 pixels at most.

    `is_static` bool (H, W) is what a detector says of the picture (None: there is none). Raises ModelError.
    """
    grey = _small_grey(image)
    if is_static is not None:
        covered = cv2.resize((~is_static).astype(np.float32), grey.shape[::-1], interpolation=cv2.INTER_AREA)
        is_static = covered < 0.5
    return Maps(
        memorability=None if memorability is None else as_map(memorability.matrix(image), grey.shape),
        is_static=is_static,
        entropy=filled_bins(grey),
    )


def scores_of(maps: Maps) -> Salience:
    """Average the maps over the whole picture. What is not static counts as 0 in the other two, because less is known
    of such a picture."""
    static = 1.0 if maps.is_static is None else maps.is_static
    return Salience(
        memorability=None if maps.memorability is None else float((maps.memorability * static).mean()),
        staticity=None if maps.is_static is None else float(maps.is_static.mean()),
        entropy=float((maps.entropy * static).mean()),
    )


def _small_grey(image: np.ndarray) -> np.ndarray:
    shrink = _LONGEST_PX / max(image.shape[:2])
    if shrink < 1:
        size = tuple(max(1, round(side * shrink)) for side in image.shape[1::-1])
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
