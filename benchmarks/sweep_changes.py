"""Changes of pictures by degrees, for `sweeps.py`: each sweep changes one thing, from nothing to far beyond what flies.

A change of the camera is a homography over flat ground; one of the picture is made of its pixels.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.mapmaking.changes import change_season

FOV_DEG = 66.0  # of the camera that is supposed
_FOG_GREY_LEVEL = 200.0
_READ_NOISE_SD = 1.5
_BLUR_WIDTH_PX = 640  # blur is told in pixels of a picture of this width


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One thing that changes: `levels` from none on, in `unit`. `ahead` are those of a camera that looks ahead (None:
    the same)."""

    title: str
    unit: str
    levels: tuple[float, ...]
    ahead: tuple[float, ...] | None = None

    def list_levels(self, camera: str) -> tuple[float, ...]:
        return self.ahead if self.ahead is not None and camera == "forward" else self.levels


SWEEPS = {
    "yaw": Sweep(title="yaw", unit="degrees", levels=(0, 20, 45, 90, 135, 180), ahead=(0, 5, 10, 20, 30, 40)),
    "pitch": Sweep(title="pitch", unit="degrees", levels=(0, 10, 20, 30, 40)),
    "roll": Sweep(title="roll", unit="degrees", levels=(0, 10, 20, 30, 40)),
    "height": Sweep(title="height (ahead: distance)", unit="times the map's", levels=(0.4, 0.5, 0.7, 1, 1.4, 2, 2.5)),
    "shift": Sweep(title="shift", unit="of a picture", levels=(0, 0.2, 0.4, 0.6, 0.8)),
    "dark": Sweep(title="darkening", unit="of the light is left", levels=(1, 0.35, 0.15, 0.06, 0.03)),
    "fog": Sweep(title="fog", unit="of the picture is veil", levels=(0, 0.4, 0.7, 0.85, 0.95)),
    "blur": Sweep(title="blur", unit="pixels of 640 (sigma)", levels=(0, 2, 4, 8, 13)),
    "jpeg": Sweep(title="JPEG", unit="quality (100: as it is)", levels=(100, 25, 10, 5, 2)),
    "hidden": Sweep(title="occlusion", unit="of the picture", levels=(0, 0.15, 0.3, 0.5, 0.7)),
    "season": Sweep(title="season", unit="strength", levels=(0, 0.4, 0.7, 1, 1.3)),
}
UNCHANGED_LEVELS = {"height": 1, "dark": 1, "jpeg": 100}  # the level that changes nothing, where it is not 0
CAMERA_SWEEPS = ("yaw", "pitch", "roll", "height", "shift")  # the others change the picture


def make_view(camera: str, sweep: str, level: float, size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return the homography (3, 3) from a picture of this size (width, height) to that of the camera after the change.
    The camera turns in its place; it shifts to a random direction, ahead to the left or right."""
    turned, height, shift = {}, 1.0, np.zeros(2)
    if sweep in ("yaw", "pitch", "roll"):
        turned[sweep] = math.radians(level) * (1 if level == 180 else rng.choice((-1, 1)))
    elif sweep == "height":
        height = level
    elif sweep == "shift":
        towards = rng.uniform(0, 2 * math.pi) if camera == "nadir" else rng.choice((0, math.pi))
        shift = level * np.array([math.cos(towards), math.sin(towards)]) * size
    focal_px = size[0] / 2 / math.tan(math.radians(FOV_DEG / 2))
    centre = (np.array(size) - 1) / 2
    lens = np.array([[focal_px, 0, centre[0]], [0, focal_px, centre[1]], [0, 0, 1.0]])
    # Axes of the lens: right, down the picture, where it looks.
    axes = {"pitch": 0, "roll": 1, "yaw": 2} if camera == "nadir" else {"pitch": 0, "yaw": 1, "roll": 2}
    turn = np.eye(3)
    for name, angle in turned.items():
        turn = turn @ cv2.Rodrigues(angle * np.eye(3)[axes[name]])[0]
    onto = np.array([[1, 0, -shift[0] / focal_px], [0, 1, -shift[1] / focal_px], [0, 0, height]])
    return lens @ turn @ onto @ np.linalg.inv(lens)


def degrade_image(sweep: str, level: float, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a picture after the change, uint8. What hides a share of it is one plain patch of the picture's shape."""
    if level == UNCHANGED_LEVELS.get(sweep, 0):
        return image
    high, wide = image.shape[:2]
    if sweep == "blur":
        return cv2.GaussianBlur(image, (0, 0), level * wide / _BLUR_WIDTH_PX)
    if sweep == "jpeg":
        coded = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, int(level)))[1]
        return cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
    if sweep == "hidden":
        hidden, sides = image.copy(), [round(math.sqrt(level) * side) for side in (high, wide)]
        top, left = (rng.integers(0, side - part + 1) for side, part in zip((high, wide), sides, strict=True))
        hidden[top : top + sides[0], left : left + sides[1]] = rng.integers(0, 256)
        return hidden
    if sweep == "season":
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        changed = 255 * change_season(grey.astype(np.float32) / 255, rng, level)
    else:
        changed = level * image if sweep == "dark" else (1 - level) * image + level * _FOG_GREY_LEVEL
        changed = changed + _READ_NOISE_SD * rng.normal(size=image.shape)
    return np.clip(changed, 0, 255).round().astype(np.uint8)
