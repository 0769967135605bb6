"""The overlay mask: which part of every frame shows ground, and which a display or the aircraft itself.

A mask can be learnt from a recording: the edges that stay where they are while the rest of the picture moves.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core import arrays
from edgevpr.core.arrays import Bools, Image
from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.errors import ImageError, SourceError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.frames.images import read_image, write_png

MOST_MASKED = 0.6  # share of the frame; too little ground is left beside more
_WHITE = 128
FEWEST_FRAMES = 20
_LONGEST_SIDE_PX = 640
_STRONG = 12.0  # grey levels a pixel: the mean gradient of an edge; weaker ones are noise
# Mean of the gradients over the mean of their lengths: 1 where an edge stands still, near 0 where edges pass.
_STILL = 0.75
_ANY_EDGE = 2.0  # grey levels a pixel: less has no edge at all
_MOVING_AT_LEAST = 0.5  # share of the picture with edges; the rest may be the display
_AROUND_PX = 4  # masked beside each edge: figures of a display change, and a codec smears them


class NoMask:
    """Stands in for a `Mask` where the whole frame shows ground."""

    sha256 = None

    def fitted(self, image: Image) -> None:
        """Return None: all of the image shows ground."""


@dataclass(frozen=True, slots=True)
class Mask:
    """A mask: `allowed` bool (H, W) is True where frames show ground. It is scaled to each frame. `sha256` is that of
    the pixels, not of the file."""

    allowed: Bools
    sha256: str

    def fitted(self, image: Image) -> arrays.Mask:
        """Return the mask in the size of an image, bool (H, W)."""
        height, width = image.shape[:2]
        return cv2.resize(self.allowed.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)


AnyMask = NoMask | Mask


def encoded(technique: Technique, image: Image, allowed: arrays.Mask | None) -> Descriptor:
    """Encode the part of an image that `allowed`, bool (H, W), lets through; None: all of it."""
    return technique.encode(image) if allowed is None else technique.encode(image, allowed)


def mask_of(path: str | None) -> AnyMask:
    """Read the mask of a configuration (`source.mask`); None gives `NoMask`. Raises as `read_mask`."""
    try:
        return NoMask() if path is None else read_mask(path)
    except ImageError as error:  # it speaks of an image, as of a frame
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
    """Find what stands still in pictures that otherwise move; return bool (H, W), True where they show ground.

    `images` are uint8 (H, W[, 3]) of one size, some time apart; `where` names their source in messages. Raises
    SourceError for too few pictures, for a scene that stands still as a whole, and where too much would be masked.
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
    if not edged.any() or (still[edged] < _STILL).mean() < _MOVING_AT_LEAST:
        raise SourceError(
            f"{where} shows a scene that stands still: a mask is learnt from what moves, so record it in flight."
        )
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1))
    display = cv2.dilate(((still >= _STILL) & (length >= _STRONG)).astype(np.uint8), around) > 0
    if (masked := display.mean()) > MOST_MASKED:
        raise SourceError(
            f"{where}: {masked:.0%} of the picture stands still, and {MOST_MASKED:.0%} at most can be masked: record "
            "more of the flight."
        )
    return ~display


def require_png(path: Path) -> None:
    """Raise UsageError for a file name that is not one of a PNG."""
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: a mask is a PNG file: choose a name that ends in .png.")


def write_mask(path: Path, allowed: arrays.Mask) -> None:
    """Write a mask as PNG: white where frames show ground, black elsewhere. Raises OSError."""
    write_whole(path, lambda unfinished: write_png(unfinished, allowed.astype(np.uint8) * 255))
