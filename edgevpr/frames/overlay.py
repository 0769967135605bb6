"""Learning an overlay mask: the edges that stay where they are while the rest of the picture moves."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from edgevpr.core.errors import SourceError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.frames.mask import MOST_MASKED
from edgevpr.frames.opencv import cv2

FEWEST_FRAMES = 20
_LONGEST_SIDE_PX = 640
_STRONG = 12.0  # grey levels a pixel: the mean gradient of an edge; weaker ones are noise
# Mean of the gradients over the mean of their lengths: 1 where an edge stands still, near 0 where edges pass.
_STILL = 0.75
_ANY_EDGE = 2.0  # grey levels a pixel: less has no edge at all
_MOVING_AT_LEAST = 0.5  # share of the picture with edges; the rest may be the display
_AROUND_PX = 4  # masked beside each edge: figures of a display change, and a codec smears them


def learn_overlay(images: Iterable[np.ndarray], where: str) -> np.ndarray:
    """Find what stands still in pictures that otherwise move; return bool (H, W), True where they show ground.

    `images` are uint8 (H, W[, 3]) of one size, some time apart; `where` names their source in messages. Raises
    SourceError for too few pictures, for a scene that stands still as a whole, and where too much would be masked.
    """
    count, size, sums = 0, None, None
    for image in images:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
        size = size or (round(grey.shape[1] * scale), round(grey.shape[0] * scale))
        grey = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 1)
        gradient = np.stack([cv2.Sobel(grey, -1, 1, 0, scale=1 / 8), cv2.Sobel(grey, -1, 0, 1, scale=1 / 8)])
        now = np.stack([*gradient, np.hypot(*gradient)])
        sums = now if sums is None else sums + now
        count += 1
    if count < FEWEST_FRAMES:
        raise SourceError(
            f"{where} gave {count} pictures, and {FEWEST_FRAMES} are needed to learn a mask: give a longer recording."
        )
    across, down, length = sums / count
    still = np.hypot(across, down) / np.maximum(length, 1e-6)
    edged = length >= _ANY_EDGE
    if not edged.any() or (still[edged] < _STILL).mean() < _MOVING_AT_LEAST:
        raise SourceError(
            f"{where} shows a scene that stands still: a mask is learnt from what moves, so record it in flight."
        )
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1))
    display = cv2.dilate(((still >= _STILL) & (length >= _STRONG)).astype(np.uint8), around)
    allowed = display == 0
    if (masked := 1 - allowed.mean()) > MOST_MASKED:
        raise SourceError(
            f"{where}: {masked:.0%} of the picture stands still, and {MOST_MASKED:.0%} at most can be masked: record "
            "more of the flight."
        )
    return allowed


def require_png(path: Path) -> None:
    """Raise UsageError for a file name that is not one of a PNG."""
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: a mask is a PNG file: choose a name that ends in .png.")


def write_mask(path: Path, allowed: np.ndarray) -> None:
    """Write a mask as PNG: white where frames show ground, black elsewhere. Raises OSError."""
    data = cv2.imencode(".png", allowed.astype(np.uint8) * 255)[1].tobytes()
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))
