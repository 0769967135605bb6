"""One picture of a camera or stream as it arrives, the contract of all that gives such pictures, and the second line
of defence against old ones.

A decoder that fills in what it did not get, and a camera that hangs, do not always say so. Nothing that a camera sees
from the air repeats itself to the grey level, though: its noise alone does not. All is done on a coarse copy.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edgevpr.core.arrays import Image

_LOOK_PX = (60, 80)  # of the coarse copy, at least: rows and columns
_BANDS = 12
_REMEMBERED = 6  # pictures: decoders use as many buffers by turns
_SAME_LEVELS, _SAME_SHARE = 1, 0.99  # so many pixels of what is the same differ by no more
_TEXTURE_LEVELS = 8.0  # standard deviation of a band of which it can be said that it stands still
_MOVED_LEVELS = 3.0  # mean difference of a band that has moved for certain
_BANDS_TO_TELL = 2
_PICTURES_TO_LEARN = 8  # as a time constant
_MOVES_ALWAYS = 0.75  # share of pictures: of a scene that stands nothing is asked


class Condition(Enum):
    """The condition of a source: OPENING until the first picture comes or the opening fails, RUNNING while new and
    whole pictures come, DAMAGED while none of those that come is whole, FROZEN while the same picture comes over and
    over, LOST while none come and the source is reopened again and again, ENDED when no more will come."""

    OPENING = auto()
    RUNNING = auto()
    DAMAGED = auto()
    FROZEN = auto()
    LOST = auto()
    ENDED = auto()


class Refusal(Enum):
    """The reason for which a picture is refused. DAMAGED: it is not whole, or predicted from one that is not. PATCHED:
    parts of it are those of an older one. FROZEN: it is the one before again. LATE: how old it is cannot be told, as it
    has waited since before the opening, or comes out of turn; or it came sooner than those before could be decoded."""

    DAMAGED = "damaged"
    PATCHED = "patched"
    FROZEN = "frozen"
    LATE = "late"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A whole picture. `t_mono_s` is the time at which it was taken, as far as that is known: never later than it
    arrived. `look` is a coarse copy in grey, uint8, (h, w). `pixels` makes the picture, uint8, (H, W, 3) BGR or (H, W)
    grey: only a picture that is read costs its conversion."""

    t_mono_s: float
    look: Image
    pixels: Callable[[], Image]


class Capture(Protocol):
    """An open camera or stream, used by one thread from opening to release."""

    def read(self) -> Shot | Refusal | None:
        """Wait for the next picture and return it, or the reason why it is refused; None where the source is lost."""
        ...

    def release(self) -> None:
        """Close the camera or the connection."""
        ...


def coarse(plane: Image) -> Image:
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
        self._before: deque[NDArray[np.int16]] = deque(maxlen=_REMEMBERED)  # pictures as bands, the newest first
        self._moving = np.zeros(_BANDS)  # share of the latest pictures in which each band moved

    def refusal(self, look: Image) -> Refusal | None:
        """Tell why the picture with this coarse copy is not new; None where it is."""
        bands = look[: len(look) // _BANDS * _BANDS].reshape(_BANDS, -1).astype(np.int16)
        if not self._before or self._before[0].shape != bands.shape:
            self._before.clear()
            self._before.appendleft(bands)
            return None
        apart = np.abs(np.stack(self._before) - bands)
        same = (apart <= _SAME_LEVELS).mean(-1) >= _SAME_SHARE  # (pictures, bands)
        if same[0].all():
            return Refusal.FROZEN  # and not remembered: the older ones would be forgotten for it
        self._before.appendleft(bands)
        moved = (apart[0].mean(-1) > _MOVED_LEVELS) & ~same[0]
        must_move = (bands.std(-1) > _TEXTURE_LEVELS) & (self._moving > _MOVES_ALWAYS)
        is_patched = ((same & must_move).sum(-1) >= _BANDS_TO_TELL).any()
        if is_patched and moved.sum() >= _BANDS_TO_TELL:
            return Refusal.PATCHED  # and nothing is learnt from it: what is patched for long is not a scene that stands
        self._moving += (moved - self._moving) / _PICTURES_TO_LEARN
        return None
