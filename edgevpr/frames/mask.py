"""The overlay mask: which part of every frame shows ground, and which a display or the aircraft itself."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.frames.images import read_image
from edgevpr.frames.opencv import cv2

MOST_MASKED = 0.6  # share of the frame; too little ground is left beside more
_WHITE = 128


class NoMask:
    """Stands in for a `Mask` where the whole frame shows ground."""

    sha256 = None

    def fitted(self, image: np.ndarray) -> None:
        """Return None: all of the image shows ground."""


@dataclass(frozen=True, slots=True)
class Mask:
    """A mask: `allowed` bool (H, W) is True where frames show ground. It is scaled to each frame. `sha256` is that of
    the pixels, not of the file."""

    allowed: np.ndarray
    sha256: str

    def fitted(self, image: np.ndarray) -> np.ndarray:
        """Return the mask in the size of an image, bool (H, W)."""
        height, width = image.shape[:2]
        return cv2.resize(self.allowed.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)


AnyMask = NoMask | Mask


def encoded(technique: Technique, image: np.ndarray, allowed: np.ndarray | None) -> Descriptor:
    """Encode the part of an image that `allowed`, bool (H, W), lets through; None: all of it."""
    return technique.encode(image) if allowed is None else technique.encode(image, allowed)


def mask_of(path: str | None) -> AnyMask:
    """Read the mask of a configuration (`source.mask`); None gives `NoMask`. Raises as `read_mask`."""
    if path is None:
        return NoMask()
    try:
        return read_mask(path)
    except ImageError as error:  # it speaks of an image, as of a frame
        raise ImageError(f"The mask of `source.mask` (--mask) cannot be used: {error}") from error


def read_mask(path: str | Path) -> Mask:
    """Read an image as a mask: bright pixels show ground, dark ones are ignored.

    Raises ImageError for a file that is no image, and UsageError for a mask that leaves too little of the frame.
    """
    image = read_image(path)
    allowed = (image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) >= _WHITE
    if (masked := 1 - allowed.mean()) > MOST_MASKED:
        raise UsageError(
            f"{path} masks {masked:.0%} of the frame, and {MOST_MASKED:.0%} is the most: leave more of it white."
        )
    return Mask(allowed, hashlib.sha256(repr(allowed.shape).encode() + np.packbits(allowed).tobytes()).hexdigest())
