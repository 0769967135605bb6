"""Pictures of a camera or stream (`Shot`), their source (`Capture`), and the detection of repeats (`RepeatDetector`).

Decoders that fill lost parts from older pictures, and cameras that hang, do not always report it. But noise makes every
new picture of a camera different, so coarse grey copies of the pictures are compared in bands of rows."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from edgevpr.core.arrays import Image
from edgevpr.core.types import FRAME_TIME_SD_S

Plane = TypeVar("Plane", bound=NDArray[Any])

_MIN_THUMBNAIL_PX = (60, 80)  # rows and columns of a coarse copy
_BANDS = 12
_HISTORY_PICTURES = 6  # decoders rotate through about as many buffers
# Bands are equal if this fraction of their pixels differs by at most this many grey levels.
_MIN_EQUAL_FRACTION = 0.99
_MAX_EQUAL_LEVELS = 1
_MIN_TEXTURE_LEVELS = 8.0  # standard deviation in grey levels; bands with a smaller one are not judged
_MIN_CHANGE_LEVELS = 3.0  # mean difference in grey levels; a band with a larger one has certainly changed
_MIN_BANDS = 2
_LEARNING_PICTURES = 8  # time constant of the fraction of pictures in which a band changed
_MIN_CHANGE_RATE = 0.75  # a band that changed in a smaller fraction of pictures is not judged


class Condition(Enum):
    """The condition of a source. OPENING: no picture has arrived yet. RUNNING: new and complete pictures arrive.
    DAMAGED: no picture is complete. LATE: the age of pictures is unknown. FROZEN: the same picture arrives again and
    again. LOST: no picture arrives, and the source is being reopened. ENDED: no more pictures will come."""

    OPENING = auto()
    RUNNING = auto()
    DAMAGED = auto()
    LATE = auto()
    FROZEN = auto()
    LOST = auto()
    ENDED = auto()


class Refusal(Enum):
    """The reason why a picture is rejected. DAMAGED: it is incomplete, or was decoded from an incomplete one. PATCHED:
    parts of it are copies from an older picture. FROZEN: it equals the previous picture. LATE: its age is unknown
    because it was buffered before the source was opened, arrived out of order or has a bad timestamp; or it was
    skipped because decoding lags behind."""

    DAMAGED = "damaged"
    PATCHED = "patched"
    FROZEN = "frozen"
    LATE = "late"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A complete picture. `t_mono_s`: when it was taken, not later than its arrival (seconds of the monotonic clock).
    `t_sd_s`: standard deviation of `t_mono_s`. `delay_sd_s`: standard deviation of the hidden delay that such cameras
    usually have, in addition. `thumbnail`: coarse grey copy, uint8 (h, w). `convert`: called for pictures that are
    used, returns their pixels, uint8 (H, W, 3) BGR or (H, W) grey."""

    t_mono_s: float
    thumbnail: Image
    convert: Callable[[], Image]
    t_sd_s: float = FRAME_TIME_SD_S
    delay_sd_s: float = FRAME_TIME_SD_S


class OpeningError(Exception):
    """A camera or stream cannot be opened now. The text gives the cause in a few words, for `Source.state`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamFacts:
    """How a stream describes its pictures. `pixel_aspect`: width by height. `rate_hz`: None if not stated."""

    codec: str
    bits: int
    pixel_aspect: float
    rate_hz: float | None

    def __str__(self) -> str:
        shape = "square pixels" if self.pixel_aspect == 1 else f"pixel aspect ratio {self.pixel_aspect:.3g}"
        rate = f", {self.rate_hz:.3g} pictures per second" if self.rate_hz else ""
        return f"{self.codec}, {self.bits} bits per channel, {shape}{rate}"


class Capture:
    """Base class of open cameras and streams. One thread uses it throughout; others may only call `cancel`."""

    @property
    def facts(self) -> StreamFacts | None:
        """A stream's description of its pictures; None if it has none."""
        return None

    def read(self) -> Shot | Refusal | None:
        """Wait for the next picture and return it, or the reason for its rejection; None if the source is lost."""
        raise NotImplementedError

    def cancel(self) -> None:
        """Make a waiting `read` return soon, if possible. Returns immediately."""

    def release(self) -> None:
        """Close the camera or the connection, if it is still open."""


def make_thumbnail(plane: Plane) -> Plane:
    """Return a small copy of a picture's grey plane (H, W[, C]): every n-th row and column, 60 x 80 pixels or slightly
    more. Pixels are not averaged, because that would remove the noise that distinguishes new pictures from repeats."""
    height, width = plane.shape[:2]
    return plane[:: max(1, height // _MIN_THUMBNAIL_PX[0]), :: max(1, width // _MIN_THUMBNAIL_PX[1])].copy()  # type: ignore[return-value]


class RepeatDetector:
    """Compares every picture of one source with the previous six.

    A picture is PATCHED if at least two bands of rows equal those of an older picture while at least two others have
    changed. Only textured bands that changed in nearly all pictures so far count, which excludes borders, text overlays
    and static parts of a scene."""

    def __init__(self) -> None:
        self._history: deque[NDArray[np.int16]] = deque(maxlen=_HISTORY_PICTURES)  # pictures as bands, newest first
        self._change_rate = np.zeros(_BANDS)  # fraction of the latest pictures in which each band changed

    def find_repeat(self, thumbnail: Image) -> Refusal | None:
        """Return why the picture with the coarse copy `thumbnail`, uint8 (h, w), is not new; None if it is new."""
        bands = thumbnail[: len(thumbnail) // _BANDS * _BANDS].reshape(_BANDS, -1).astype(np.int16)
        if not self._history or self._history[0].shape != bands.shape:
            self._history.clear()
            self._history.appendleft(bands)
            return None
        differences = np.abs(np.stack(self._history) - bands)
        is_equal = (differences <= _MAX_EQUAL_LEVELS).mean(-1) >= _MIN_EQUAL_FRACTION  # (pictures, bands)
        if is_equal[0].all():
            return Refusal.FROZEN  # not stored, so that it does not displace an older picture
        self._history.appendleft(bands)
        has_changed = (differences[0].mean(-1) > _MIN_CHANGE_LEVELS) & ~is_equal[0]
        should_change = (bands.std(-1) > _MIN_TEXTURE_LEVELS) & (self._change_rate > _MIN_CHANGE_RATE)
        is_patched = ((is_equal & should_change).sum(-1) >= _MIN_BANDS).any()
        if is_patched and has_changed.sum() >= _MIN_BANDS:
            return Refusal.PATCHED  # not counted below: a band that stays patched must not count as static
        self._change_rate += (has_changed - self._change_rate) / _LEARNING_PICTURES
        return None
