"""Alters pictures as if taken on another day, in another season, from another height and on another course.

No single change is realistic. Together they reduce the fraction of agreeing regions as much as real changes do, so that
correct and wrong matches are as hard to distinguish as in flight. `strength`: from about 0 (hardly any change) to 1.3.
"""

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Doubles, Floats, Image, Mask, Singles
from edgevpr.frames.images import resize

_STRENGTH_RANGE = (0.3, 1.3)  # from a slight change, such as a cloud, to a strong one, such as snow
# Size of the pictures in the sets on which the strengths were chosen. Larger pictures take long to alter, and their
# noise, which is per pixel, would be averaged away.
_MAX_PX = 640
_TONE_POINTS = 6  # points of a tone curve
_MAX_PATCHES = 2  # uniform patches that hide part of the picture


def change_picture(
    image: Image, rng: np.random.Generator, looks_down: bool, mask: Mask | None = None
) -> tuple[Image, Mask | None]:
    """Alter a picture, uint8 (H, W[, 3]), at random as if taken at another time. With `looks_down`, it is also rotated
    by a random angle. `mask`, bool (H, W), is False where it shows no ground (None: it shows ground everywhere).
    Returns the altered picture, uint8 grey, at most 640 pixels long, and its mask."""
    strength = rng.uniform(*_STRENGTH_RANGE)
    if (shrink := _MAX_PX / max(image.shape[:2])) < 1:
        size_px = round(shrink * image.shape[1]), round(shrink * image.shape[0])
        image = resize(image, size_px)
        if mask is not None:
            mask = cv2.resize(mask.view(np.uint8), size_px, interpolation=cv2.INTER_NEAREST).view(bool)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    warp = _change_viewpoint(grey.shape, rng, strength, looks_down)
    warped = _warp_image(grey.astype(np.float32) / 255, warp, cv2.INTER_LINEAR)
    warped = change_season(warped, rng, strength)
    lit = _change_light(warped, rng, strength)
    _cover_patches(lit, rng, strength)
    if mask is not None:
        mask = _warp_image(mask.view(np.uint8), warp, cv2.INTER_NEAREST).view(bool)
    return (255 * np.clip(lit, 0, 1)).round().astype(np.uint8), mask


def _change_viewpoint(shape: tuple[int, int], rng: np.random.Generator, strength: float, looks_down: bool) -> Doubles:
    """Return a random pixel homography, (3, 3), like a change of position, height, course and tilt of the camera."""
    height, width = shape
    scale = np.exp(rng.uniform(-1, 1) * 0.15 * strength)
    turn_deg = rng.uniform(0, 360) if looks_down else rng.uniform(-3, 3) * strength
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn_deg, scale)
    matrix[0, 2] += rng.uniform(-0.15, 0.15) * width * strength
    matrix[1, 2] += rng.uniform(-0.15, 0.15) * height * strength * (1.0 if looks_down else 0.4)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved_corners = corners + (rng.uniform(-0.05, 0.05, (4, 2)) * (width, height) * strength).astype(np.float32)
    return np.asarray(cv2.getPerspectiveTransform(corners, moved_corners) @ np.vstack([matrix, (0, 0, 1)]))


def _warp_image(image: Array, warp: Doubles, flags: int) -> Array:
    return cv2.warpPerspective(image, warp, image.shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)


def change_season(grey: Singles, rng: np.random.Generator, strength: float) -> Singles:
    """Map grey levels through random tone curves that differ between parts of the picture, like leaves and snow, and
    add a random texture. `grey` is float32 (H, W), 0..1. Returns float32 (H, W), which may slightly exceed 0..1."""
    height, width = grey.shape
    tones = np.clip(255 * grey, 0, 255).astype(np.uint8)
    first, second = (_make_tone_curve(rng, strength)[tones] for _ in range(2))
    blend = np.clip(0.5 + _make_smooth_field(rng, (height, width), 6), 0, 1)
    texture = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), max(1.0, width / 200))
    return np.asarray(blend * first + (1 - blend) * second + 0.36 * strength * texture)


def _change_light(grey: Singles, rng: np.random.Generator, strength: float) -> Floats:
    """Add soft shadows, a different exposure, blur (to half of the pictures) and noise to `grey`, float (H, W)."""
    lit: Floats = np.clip(grey * np.exp(0.5 * strength * _make_smooth_field(rng, grey.shape, 3)), 0, 1)
    lit = lit ** np.exp(rng.uniform(-1, 1) * 0.7 * strength)
    if rng.random() < 0.5:
        lit = np.asarray(cv2.GaussianBlur(lit, (0, 0), 0.3 + strength * grey.shape[1] / 400), lit.dtype)
    return lit + (0.03 * strength * rng.normal(size=grey.shape)).astype(np.float32)


def _cover_patches(grey: Floats, rng: np.random.Generator, strength: float) -> None:
    """Cover `grey`, float (H, W), in place with up to two uniform patches."""
    height, width = grey.shape
    for _ in range(rng.integers(0, _MAX_PATCHES + 1)):
        x, y, half = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.05, 0.2) * width * strength
        rows, columns = (slice(max(0, int(centre - half)), int(centre + half)) for centre in (y, x))
        grey[rows, columns] = rng.uniform(0, 1)


def _make_tone_curve(rng: np.random.Generator, strength: float) -> Singles:
    points = np.linspace(0, 1, _TONE_POINTS)
    levels = np.clip(points + 0.45 * strength * rng.normal(size=_TONE_POINTS), 0, 1)
    return np.interp(np.linspace(0, 1, 256), points, levels).astype(np.float32)


def _make_smooth_field(rng: np.random.Generator, shape: tuple[int, int], cells: int) -> Singles:
    """Return a random smooth field, float32 of this shape, of values about -1..1; more `cells` vary faster."""
    coarse = rng.normal(size=(cells, cells)).astype(np.float32)
    field = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(field / max(float(np.abs(field).max()), 1e-6), np.float32)
