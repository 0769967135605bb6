"""The overlay mask: marks the part of every frame that shows ground, and not an on-screen display or the aircraft.

A mask can also be learnt from a recording: edges that stay in place while the rest of the picture moves are masked.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core import arrays
from edgevpr.core.arrays import Bools, Image
from edgevpr.core.errors import ImageError, SourceError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.frames.images import read_image, write_png

MOST_MASKED = 0.6  # share of the frame: with more masked, too little ground is left
_WHITE = 128  # grey level from which on a pixel of a mask file shows ground
FEWEST_FRAMES = 20
_LONGEST_SIDE_PX = 640
_STRONG = 12.0  # mean gradient, in grey levels per pixel, of an edge of a display; weaker ones are noise
# Length of the mean gradient vector over the mean length: 1 if an edge stands still, near 0 if many edges pass.
_STILL = 0.75
_ANY_EDGE = 2.0  # mean gradient, in grey levels per pixel, below which a pixel has no edge
_MOVING_AT_LEAST = 0.5  # share of the pixels with edges that must move; the others may be the display
_AROUND_PX = 4  # pixels masked around each edge: digits of a display change, and video compression smears them


@dataclass(frozen=True, slots=True)
class Mask:
    """An overlay mask. `allowed`, bool (H, W), is True where frames show ground; `fitted` scales it to a frame's size.
    `sha256` is the hash of the mask's pixels, not of its file."""

    allowed: Bools
    sha256: str

    def fitted(self, image: Image) -> arrays.Mask:
        """Return the mask scaled to the size of `image`, bool (H, W), True where it shows ground."""
        height, width = image.shape[:2]
        return cv2.resize(self.allowed.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)


def mask_of(path: str | None) -> Mask | None:
    """Read the mask file that the configuration names (`source.mask`); None if it names none. Raises the errors of
    `read_mask`."""
    try:
        return read_mask(path) if path else None
    except ImageError as error:  # its message sounds as if a frame were meant
        raise ImageError(f"The mask of `source.mask` (--mask) cannot be used: {error}") from error


def read_mask(path: str | Path) -> Mask:
    """Read an image as a mask: bright pixels show ground, dark ones are ignored.

    Raises ImageError for a file that is no image, and UsageError for a mask that leaves too little of the frame.
    """
    allowed = _grey(read_image(path)) >= _WHITE
    if (masked := 1 - allowed.mean()) > MOST_MASKED:
        raise UsageError(
            f"{path} masks {masked:.0%} of the frame, and {MOST_MASKED:.0%} is the most: leave more of it white."
        )
    return Mask(allowed, hashlib.sha256(repr(allowed.shape).encode() + np.packbits(allowed).tobytes()).hexdigest())


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)  # type: ignore[return-value]  # uint8


def learn_overlay(images: Iterable[Image], where: str) -> arrays.Mask:
    """Find the overlay in pictures of a moving scene: the edges that stand still. Returns the mask, bool (H, W), True
    where pictures show ground, with the pictures' aspect ratio and a longest side of 640 pixels at most.

    `images` are uint8 (H, W[, 3]) of one size, some time apart; `where` names their source in messages. Raises
    SourceError for too few pictures, for a scene that does not move, and if too much would be masked.
    """
    count, size, sums = 0, None, np.zeros((3, 1, 1), np.float32)
    for image in images:
        count += 1
        grey = _grey(image)
        scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
        size = size or (round(grey.shape[1] * scale), round(grey.shape[0] * scale))
        soft = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 1)
        gradient = np.stack([cv2.Sobel(soft, -1, 1, 0, scale=1 / 8), cv2.Sobel(soft, -1, 0, 1, scale=1 / 8)])
        sums = sums + np.stack([*gradient, np.hypot(*gradient)])
    if count < FEWEST_FRAMES:
        raise SourceError(
            f"{where} gave {count} pictures, and {FEWEST_FRAMES} are needed to learn a mask: give a longer recording."
        )
    across, down, length = sums / count
    still = np.hypot(across, down) / np.maximum(length, 1e-6)
    edged = length >= _ANY_EDGE
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1))
    display = cv2.dilate(((still >= _STILL) & (length >= _STRONG)).astype(np.uint8), around) > 0
    moving = (still[edged] < _STILL).mean() if edged.any() else 0.0
    if moving < _MOVING_AT_LEAST or display.mean() > MOST_MASKED:
        raise SourceError(
            f"{where} shows a scene most of which stands still: a mask is learnt from what moves, so record it in "
            "flight, and for longer."
        )
    return ~display


def require_png(path: Path) -> None:
    """Raise UsageError for a file name that does not end in .png."""
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: a mask is a PNG file: choose a name that ends in .png.")


def write_mask(path: Path, allowed: arrays.Mask) -> None:
    """Write the mask `allowed`, bool (H, W), as PNG: white where it is True, else black. Raises OSError."""
    write_whole(path, lambda unfinished: write_png(unfinished, allowed.astype(np.uint8) * 255))
