"""Generated ground, and folders of pictures of several flights over it."""

from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.geodesy import moved
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, read_positions, write_positions

ORIGIN = 47.0, 8.0
FOV_DEG, HEIGHT_M = 60.0, 52.0
FOOTPRINT_M = 2 * HEIGHT_M * float(np.tan(np.radians(FOV_DEG / 2)))
SPOTS_M = ((60.0, 60.0), (140.0, 60.0), (60.0, 140.0), (140.0, 140.0))  # east and north of ORIGIN
DAY_S = 86_400.0
_WIDTH_PX, _HEIGHT_PX, _SIDE_M = 320, 240, 200.0
_METRE_PX = _WIDTH_PX / FOOTPRINT_M


def ground(seed: int) -> np.ndarray:
    """Grey ground, uint8, with texture at all scales, north up, ORIGIN at its lower left."""
    rng, side_px = np.random.default_rng(seed), round(_SIDE_M * _METRE_PX)
    grey = np.zeros((side_px, side_px), np.float32)
    for cells in (20, 40, 80, 160):
        grey += cv2.resize(rng.random((cells, cells), np.float32), (side_px, side_px), interpolation=cv2.INTER_CUBIC)
    return cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def fly(folder: Path, grounds, seed: int, start_s: float | None, off_m=(0.0, 0.0), numbers=range(4)) -> None:
    """Take a picture of each of the SPOTS_M with these numbers, `off_m` beside it, of its own one of `grounds`: each by
    some metres elsewhere, in other light, and five seconds after the one before (`start_s` None: at no known time)."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, table = np.random.default_rng(seed), folder / "positions.csv"
    tags = read_positions(table) if table.exists() else {}
    for number in numbers:
        east_m, north_m = np.add(SPOTS_M[number], off_m) + rng.uniform(-3, 3, 2)
        here = grounds[number]
        left, top = round(east_m * _METRE_PX - _WIDTH_PX / 2), round(len(here) - north_m * _METRE_PX - _HEIGHT_PX / 2)
        seen = here[top : top + _HEIGHT_PX, left : left + _WIDTH_PX] * rng.uniform(0.8, 1.0)
        name = f"{seed}{number}.png"
        cv2.imwrite(str(folder / name), np.clip(seen + rng.normal(0, 5, seen.shape), 0, 255).astype(np.uint8))
        tags[name] = GeoTag(
            position=Position(*moved(*ORIGIN, east_m, north_m)),
            t_utc_s=None if start_s is None else start_s + 5 * number,
            heading_deg=0.0,
            roll_deg=0.0,
            pitch_deg=0.0,
            height_m=HEIGHT_M,
        )
    write_positions(table, tags)
