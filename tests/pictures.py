"""Small pictures for tests, made from a seed."""

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions


def draw_texture(seed: int, height: int = 120, width: int = 160) -> np.ndarray:
    """A grey picture with texture at several scales and a flat corner (regions that say nothing)."""
    return _draw_texture(seed, height, width).copy()


@lru_cache(maxsize=100)  # flights ask for the same few again and again
def _draw_texture(seed: int, height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    picture = np.zeros((height, width), np.float32)
    for octave in range(2, 6):
        small = rng.random((2**octave, 2**octave), dtype=np.float32)
        picture += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC) / octave
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    picture[: height // 3, : width // 3] = 90
    return picture


def draw_rough_ground(side_px: int, seed: int = 3) -> np.ndarray:
    """Square grey ground with texture at all scales, of which pictures are taken."""
    rng = np.random.default_rng(seed)
    octaves = [rng.random((2**octave, 2**octave), dtype=np.float32) / octave for octave in range(4, 11)]
    rough = sum(cv2.resize(each, (side_px, side_px), interpolation=cv2.INTER_CUBIC) for each in octaves)
    return cv2.normalize(rough, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def draw_view(seed: int, height_ratio: float) -> np.ndarray:
    """384 pixels square of a place, from so many times the height of its map."""
    half_px = round(384 * height_ratio / 2)
    seen = draw_texture(seed, 800, 800)[400 - half_px : 400 + half_px, 400 - half_px : 400 + half_px]
    return cv2.resize(seen, (384, 384), interpolation=cv2.INTER_AREA if height_ratio > 1 else cv2.INTER_LINEAR)


def render_view(ground, side_px, rotation_deg=0.0, right_px=0.0, down_px=0.0, height=1.0) -> np.ndarray:
    """What a square camera sees over the middle of `ground`, rotated clockwise, moved and `height` times as high."""
    middle = (np.array(ground.shape[1::-1]) - 1) / 2 + (right_px, down_px)
    view = cv2.getRotationMatrix2D(middle.tolist(), rotation_deg, 1 / height)
    view[:, 2] += (side_px - 1) / 2 - middle
    return cv2.warpAffine(ground, view, (side_px, side_px))


def write_flight(folder: Path, pictures: Iterable[np.ndarray], step_deg: float = 0.001, start_s: float | None = None):
    """Write numbered pictures and their positions, each a second later and `step_deg` of latitude farther north."""
    folder.mkdir(parents=True)
    tags = {}
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number}.png"), picture)
        t_utc_s = None if start_s is None else start_s + number
        tags[f"{number}.png"] = GeoTag(position=Position(50 + number * step_deg, 8.0), t_utc_s=t_utc_s)
    write_positions(folder / "positions.csv", tags)
