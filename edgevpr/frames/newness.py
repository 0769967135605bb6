"""The second line of defence against old pictures, on pixels: the picture before again, and one patched from others.

A decoder that fills in what it did not get, and a camera that hangs, are not always heard. Nothing that a camera sees
from the air repeats itself to the grey level, though: its noise alone does not. All is done on a coarse copy.
"""

from collections import deque

import numpy as np

from edgevpr.frames.shot import Refusal

_LOOK_PX = (120, 160)  # of the coarse copy, at least: rows and columns
_BANDS = 12
_REMEMBERED = 6  # pictures: decoders use as many buffers by turns
_SAME_LEVELS, _SAME_SHARE = 1, 0.99  # so many pixels of what is the same differ by no more
_TEXTURE_LEVELS = 8.0  # standard deviation of a band of which it can be said that it stands still
_MOVED_LEVELS = 3.0  # mean difference of a band that has moved for certain
_BANDS_TO_TELL = 2


def coarse(plane: np.ndarray) -> np.ndarray:
    """Return a copy of every n-th row and column of a picture's plane, (H, W) uint8: about 120 x 160 pixels. Pixels are
    picked and not averaged, which would hide the noise by which a picture is known as new."""
    height, width = plane.shape
    return plane[:: max(1, height // _LOOK_PX[0]), :: max(1, width // _LOOK_PX[1])].copy()


class Newness:
    """Compares every picture of one source with the ones before.

    A picture is patched where textured bands of rows are exactly those of an older picture, while the rest has moved. A
    band that has never moved says nothing: a border, a line of text over the picture."""

    def __init__(self) -> None:
        self._seen: deque[np.ndarray] = deque(maxlen=_REMEMBERED)  # the newest last
        self._has_moved = np.zeros(_BANDS, bool)

    def refusal(self, look: np.ndarray) -> Refusal | None:
        """Tell why the picture with this coarse copy is not new; None where it is."""
        if self._seen and self._seen[-1].shape != look.shape:
            self._seen.clear()
        if not self._seen:
            self._seen.append(look)
            return None
        steps = [_differences(look, old) for old in reversed(self._seen)]
        since_last, same_as_last = steps[0]
        if same_as_last.all():
            return Refusal.FROZEN  # and not remembered: the older ones would be forgotten for it
        self._seen.append(look)
        moved = (since_last > _MOVED_LEVELS) & ~same_as_last
        textured = np.array([band.std() > _TEXTURE_LEVELS for band in _bands(look)])
        stands = textured & self._has_moved
        self._has_moved |= moved
        if moved.sum() < _BANDS_TO_TELL:
            return None
        if any((same & stands).sum() >= _BANDS_TO_TELL for _, same in steps):
            return Refusal.PATCHED
        return None


def _bands(picture: np.ndarray) -> list[np.ndarray]:
    return np.array_split(picture, _BANDS)


def _differences(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each band the mean difference in grey levels, and True where the two are the same."""
    apart = np.maximum(one, other) - np.minimum(one, other)
    means = np.array([band.mean() for band in _bands(apart)])
    shares = np.array([(band <= _SAME_LEVELS).mean() for band in _bands(apart)])
    return means, shares >= _SAME_SHARE
