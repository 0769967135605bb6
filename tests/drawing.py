"""Tools to draw pictures of nothing real with, each by a generator of random numbers."""

import cv2
import numpy as np

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_PLAIN, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def fill(height: int, width: int, colour) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def draw_colour(rng: np.random.Generator, low: int = 0, high: int = 256) -> tuple[int, ...]:
    return tuple(int(value) for value in rng.integers(low, high, 3))


def write_text(
    picture: np.ndarray, rng: np.random.Generator, text: str, at: tuple[float, float], size: float = 1.0
) -> None:
    """Write a text that begins at shares of the width and the height, in white or a light colour."""
    height, width = picture.shape[:2]
    scale = size * height / 480 * rng.uniform(0.8, 1.2)
    where = int(at[0] * width), int(at[1] * height)
    colour = (255, 255, 255) if rng.random() < 0.7 else draw_colour(rng, 150)
    cv2.putText(picture, text, where, int(rng.choice(_FONTS)), scale, colour, int(rng.integers(1, 4)), cv2.LINE_AA)


def add_grain(picture: np.ndarray, rng: np.random.Generator, sigma: float) -> np.ndarray:
    return np.clip(picture + rng.normal(0, sigma, picture.shape), 0, 255).astype(np.uint8)


def make_clouds(rng: np.random.Generator, height: int, width: int, finest: float, octaves: int) -> np.ndarray:
    """Make noise of several octaves, float32 (H, W) 0..1; the finest has `finest` spots across the width."""
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        across = max(2, int(finest / 2**octave))
        small = rng.random((max(2, across * height // width), across), dtype=np.float32)
        total += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC) * 2**octave
    return cv2.normalize(total, None, 0, 1, cv2.NORM_MINMAX)


def blend_colours(share: np.ndarray, dark, light) -> np.ndarray:
    """Colour shares 0..1 (H, W) from one colour to another."""
    dark, light = (np.broadcast_to(np.asarray(colour, np.float32), 3) for colour in (dark, light))
    return np.clip(dark + share[..., None] * (light - dark), 0, 255).astype(np.uint8)
