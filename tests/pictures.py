"""Small pictures for tests, made from a seed."""

from functools import lru_cache

import cv2
import numpy as np


def textured(seed: int, height: int = 120, width: int = 160) -> np.ndarray:
    """A grey picture with texture at several scales and a flat corner (regions that say nothing)."""
    return _textured(seed, height, width).copy()


@lru_cache(maxsize=100)  # flights ask for the same few again and again
def _textured(seed: int, height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    picture = np.zeros((height, width), np.float32)
    for octave in range(2, 6):
        small = rng.random((2**octave, 2**octave), dtype=np.float32)
        picture += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC) / octave
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    picture[: height // 3, : width // 3] = 90
    return picture
