"""Gradual changes of pictures for `sweeps.py`: each changes one property, from unchanged to far beyond any flight.

Changes of the camera are homographies over flat ground; the others change the pixels of the picture.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.mapmaking.changes import change_season

FOV_DEG = 66.0  # horizontal field of view of the simulated camera
_FOG_GREY_LEVEL = 200.0
_READ_NOISE_SD = 1.5
_BLUR_WIDTH_PX = 640  # the width of a picture for which blur is given in pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One property that changes: its `levels`, in `unit`, which include the unchanged one. `forward_levels` are those
    of a forward camera (None: the same)."""

    title: str
    unit: str
    levels: tuple[float, ...]
    forward_levels: tuple[float, ...] | None = None

    def list_levels(self, camera: str) -> tuple[float, ...]:
        return self.forward_levels if self.forward_levels is not None and camera == "forward" else self.levels


SWEEPS = {
    "yaw": Sweep(title="yaw", unit="degrees", levels=(0, 20, 45, 90, 135, 180), forward_levels=(0, 5, 10, 20, 30, 40)),
    "pitch": Sweep(title="pitch", unit="degrees", levels=(0, 10, 20, 30, 40)),
    "roll": Sweep(title="roll", unit="degrees", levels=(0, 10, 20, 30, 40)),
    "height": Sweep(title="height (forward: distance)", unit="ratio to map", levels=(0.4, 0.5, 0.7, 1, 1.4, 2, 2.5)),
    "shift": Sweep(title="shift", unit="share of a picture", levels=(0, 0.2, 0.4, 0.6, 0.8)),
    "dark": Sweep(title="darkening", unit="share of the light left", levels=(1, 0.35, 0.15, 0.06, 0.03)),
    "fog": Sweep(title="fog", unit="share of veil", levels=(0, 0.4, 0.7, 0.85, 0.95)),
    "blur": Sweep(title="blur", unit="sigma in pixels of 640", levels=(0, 2, 4, 8, 13)),
    "jpeg": Sweep(title="JPEG", unit="quality (100: unchanged)", levels=(100, 25, 10, 5, 2)),
    "hidden": Sweep(title="occlusion", unit="share of the picture", levels=(0, 0.15, 0.3, 0.5, 0.7)),
    "season": Sweep(title="season", unit="strength", levels=(0, 0.4, 0.7, 1, 1.3)),
}
UNCHANGED_LEVELS = {"height": 1, "dark": 1, "jpeg": 100}  # the level without change, where it is not 0
CAMERA_SWEEPS = ("yaw", "pitch", "roll", "height", "shift")  # the others change pixels


def make_view(camera: str, sweep: str, level: float, size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return the homography (3, 3) from a picture of this size (width, height) to the picture after the camera moved.
    The camera rotates about itself; it shifts in a random direction (a forward camera: to the left or right)."""
    rotations, height, shift = {}, 1.0, np.zeros(2)
    if sweep in ("yaw", "pitch", "roll"):
        rotations[sweep] = math.radians(level) * (1 if level == 180 else rng.choice((-1, 1)))
    elif sweep == "height":
        height = level
    elif sweep == "shift":
        direction = rng.uniform(0, 2 * math.pi) if camera == "nadir" else rng.choice((0, math.pi))
        shift = level * np.array([math.cos(direction), math.sin(direction)]) * size
    focal_px = size[0] / 2 / math.tan(math.radians(FOV_DEG / 2))
    centre = (np.array(size) - 1) / 2
    lens = np.array([[focal_px, 0, centre[0]], [0, focal_px, centre[1]], [0, 0, 1.0]])
    # Axes of the lens: right and down in the picture, and the viewing direction.
    axes = {"pitch": 0, "roll": 1, "yaw": 2} if camera == "nadir" else {"pitch": 0, "yaw": 1, "roll": 2}
    rotation = np.eye(3)
    for name, angle in rotations.items():
        rotation = rotation @ cv2.Rodrigues(angle * np.eye(3)[axes[name]])[0]
    translation = np.array([[1, 0, -shift[0] / focal_px], [0, 1, -shift[1] / focal_px], [0, 0, height]])
    return lens @ rotation @ translation @ np.linalg.inv(lens)


def degrade_image(sweep: str, level: float, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a picture, uint8, after a change of its pixels. Occlusion is one plain patch of the picture's shape."""
    if level == UNCHANGED_LEVELS.get(sweep, 0):
        return image
    height, width = image.shape[:2]
    if sweep == "blur":
        return cv2.GaussianBlur(image, (0, 0), level * width / _BLUR_WIDTH_PX)
    if sweep == "jpeg":
        encoded = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, int(level)))[1]
        return cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    if sweep == "hidden":
        occluded, sides = image.copy(), [round(math.sqrt(level) * side) for side in (height, width)]
        top, left = (rng.integers(0, side - part + 1) for side, part in zip((height, width), sides, strict=True))
        occluded[top : top + sides[0], left : left + sides[1]] = rng.integers(0, 256)
        return occluded
    if sweep == "season":
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        changed = 255 * change_season(grey.astype(np.float32) / 255, rng, level)
    else:
        changed = level * image if sweep == "dark" else (1 - level) * image + level * _FOG_GREY_LEVEL
        changed = changed + _READ_NOISE_SD * rng.normal(size=image.shape)
    return np.clip(changed, 0, 255).round().astype(np.uint8)
