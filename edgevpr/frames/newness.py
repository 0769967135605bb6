"""The second line of defence against old pictures, on pixels: the picture before again, and one patched from others.

A decoder that fills in what it did not get, and a camera that hangs, are not always heard. Nothing that a camera sees
from the air repeats itself to the grey level, though: its noise alone does not. All is done on a coarse copy.
"""

from collections import deque

import numpy as np

from edgevpr.frames.shot import Refusal

_LOOK_PX = (60, 80)  # of the coarse copy, at least: rows and columns
_BANDS = 12
_REMEMBERED = 6  # pictures: decoders use as many buffers by turns
_SAME_LEVELS, _SAME_SHARE = 1, 0.99  # so many pixels of what is the same differ by no more
_TEXTURE_LEVELS = 8.0  # standard deviation of a band of which it can be said that it stands still
_MOVED_LEVELS = 3.0  # mean difference of a band that has moved for certain
_BANDS_TO_TELL = 2
_PICTURES_TO_LEARN = 8  # as a time constant
_MOVES_ALWAYS = 0.75  # share of pictures: of a scene that stands nothing is asked


def coarse(plane: np.ndarray) -> np.ndarray:
    """Return a copy of every n-th row and column of a picture's plane, (H, W) uint8: 60 x 80 pixels or a few more.
    Pixels are picked and not averaged, which would hide the noise by which a picture is known as new."""
    height, width = plane.shape
    return plane[:: max(1, height // _LOOK_PX[0]), :: max(1, width // _LOOK_PX[1])].copy()


class Newness:
    """Compares every picture of one source with the ones before.

    A picture is patched where textured bands of rows, which have moved in every picture so far, are exactly those of an
    older picture while the rest has moved. Other bands say nothing: borders, text over the picture, a scene that stands
    and of which parts move."""

    def __init__(self) -> None:
        self._seen: deque[np.ndarray] = deque(maxlen=_REMEMBERED)  # the newest first
        self._moving = np.zeros(_BANDS)  # share of the latest pictures in which each band moved

    def refusal(self, look: np.ndarray) -> Refusal | None:
        """Tell why the picture with this coarse copy is not new; None where it is."""
        bands = look[: len(look) // _BANDS * _BANDS].reshape(_BANDS, -1).astype(np.int16)
        if self._seen and self._seen[0].shape != bands.shape:
            self._seen.clear()
        if not self._seen:
            self._seen.appendleft(bands)
            return None
        apart = np.abs(np.stack(self._seen) - bands)
        same = (apart <= _SAME_LEVELS).mean(-1) >= _SAME_SHARE  # (pictures, bands)
        if same[0].all():
            return Refusal.FROZEN  # and not remembered: the older ones would be forgotten for it
        self._seen.appendleft(bands)
        moved = (apart[0].mean(-1) > _MOVED_LEVELS) & ~same[0]
        must_move = (bands.std(-1) > _TEXTURE_LEVELS) & (self._moving > _MOVES_ALWAYS)
        is_patched = ((same & must_move).sum(-1) >= _BANDS_TO_TELL).any()
        if is_patched and moved.sum() >= _BANDS_TO_TELL:
            return Refusal.PATCHED  # and nothing is learnt from it: what is patched for long is not a scene that stands
        self._moving += (moved - self._moving) / _PICTURES_TO_LEARN
        return None
