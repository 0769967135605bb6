"""Images of more than 8 bits per channel, such as those of thermal cameras. A scene uses only a small part of their
range of counts, somewhere in the middle: the upper 8 bits alone would show nothing. Streams, video files and folders of
images are all converted here, so that a map and a flight use the same grey levels."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from edgevpr.core.arrays import Image
from edgevpr.frames.shot import make_thumbnail

Counts: TypeAlias = NDArray[np.uint16]
Limits: TypeAlias = tuple[int, int]  # the counts that become grey levels 0 and 255

_RANGE_PERCENTILES = (1.0, 99.0)  # dead pixels and small hot spots lie outside
_MIN_SPAN_COUNTS = 64  # so that an image of pure sensor noise stays flat
_TIME_CONSTANT_PICTURES = 30  # so slow that a passing object does not change the grey levels around it
_MAX_CLIPPED_FRACTION = 0.25  # of an image; if more is outside the range, the camera or the scene has changed
_MIN_USED_FRACTION = 0.25  # of the range; an image that used less would have too little contrast


class DepthRange:
    """The range of counts of one source. It adapts slowly to the images, which must be passed in order."""

    def __init__(self) -> None:
        self._low = 0.0
        self._high = 0.0

    def update(self, counts: Counts) -> Limits:
        """Update the range with this image, uint16 (H, W[, C]), and return it. The first image, and any image
        that does not fit the range, sets the range to its own."""
        sample = make_thumbnail(counts)
        low, high = _find_limits(sample)
        clipped_fraction = float(((sample < self._low) | (sample > self._high)).mean())
        has_contrast = high - low >= _MIN_USED_FRACTION * (self._high - self._low)
        fits_range = self._high > 0 and has_contrast and clipped_fraction <= _MAX_CLIPPED_FRACTION
        gain = 1 / _TIME_CONSTANT_PICTURES if fits_range else 1.0
        self._low += gain * (low - self._low)
        self._high += gain * (high - self._high)
        return round(self._low), round(self._high)

    def to_8_bits(self, counts: Counts) -> Image:
        """Update the range with the image, and return the image in grey levels, uint8 of the same shape."""
        return to_8_bits(counts, self.update(counts))


def make_counts_thumbnail(counts: Counts) -> Image:
    """Return a coarse copy of an image (see `shot.make_thumbnail`), scaled so that copies of a frozen one are equal."""
    sample = make_thumbnail(counts)
    return to_8_bits(sample, _find_limits(sample))


def to_8_bits(counts: Counts, limits: Limits) -> Image:
    """Return an image in grey levels, uint8 of the same shape; counts outside `limits` become black or white."""
    low, high = limits
    levels = (np.clip(counts, low, high).astype(np.float32) - low) * (255 / (high - low))
    return np.asarray(np.rint(levels), np.uint8)


def _find_limits(sample: Counts) -> Limits:
    low, high = (int(count) for count in np.percentile(sample, _RANGE_PERCENTILES))
    missing_counts = max(0, _MIN_SPAN_COUNTS - (high - low))
    low = max(0, low - missing_counts // 2)
    return low, max(high, low + _MIN_SPAN_COUNTS)
