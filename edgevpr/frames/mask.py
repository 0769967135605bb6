"""The overlay mask: the part of every frame that shows ground and not an on-screen display or the aircraft."""

import hashlib
from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.core import arrays
from edgevpr.core.arrays import Bools, Image
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.frames.images import read_image

MAX_MASKED_FRACTION = 0.6  # of the frame: with a larger mask, too little ground is left
_MIN_WHITE_LEVEL = 128  # min grey level at which a pixel of a mask file shows ground


@dataclass(frozen=True, slots=True)
class OverlayMask:
    """An overlay mask. `allowed`, bool (H, W): True where frames show ground; `fit_to` scales it to a frame's size.
    `sha256` is the hash of the mask's pixels, not of its file."""

    allowed: Bools
    sha256: str

    def fit_to(self, image: Image) -> arrays.Mask:
        """Return the mask scaled to the size of `image`, bool (H, W), True where it shows ground."""
        height, width = image.shape[:2]
        return cv2.resize(self.allowed.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)


def load_mask(path: str | None) -> OverlayMask | None:
    """Read the mask image set as `source.mask` in the configuration (None: no mask): bright pixels show ground.
    Raises ImageError for a file that is not an image, and UsageError for a mask that leaves too little of the frame."""
    if not path:
        return None
    try:
        image = read_image(path)
    except ImageError as error:  # its message refers to a frame
        raise ImageError(f"The mask of `source.mask` (--mask) cannot be used: {error}") from error
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    allowed = grey >= _MIN_WHITE_LEVEL
    if (masked := 1 - allowed.mean()) > MAX_MASKED_FRACTION:
        raise UsageError(
            f"{path} masks {masked:.0%} of the frame, but at most {MAX_MASKED_FRACTION:.0%} is allowed: mask less."
        )
    pixels = repr(allowed.shape).encode() + np.packbits(allowed).tobytes()
    return OverlayMask(allowed, hashlib.sha256(pixels).hexdigest())
