"""Recorded pictures, read in order to their end: a folder of images, a video file."""

import math
from collections.abc import Callable
from pathlib import Path

from edgevpr.errors import SourceError, UsageError
from edgevpr.frames.condition import Condition
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.opencv import cv2
from edgevpr.frames.positions import find_positions, read_positions
from edgevpr.helpers.text import decoded_name
from edgevpr.types import Frame

_TIMESTAMP_ROUNDING_S = 0.001  # Matroska counts in milliseconds
_USUAL_RATE_HZ = 25.0


class _Recording:
    """The common part of all recordings; a subclass sets `ended`."""

    is_live = False
    dropped = None
    ended: bool

    @property
    def condition(self) -> Condition:
        return Condition.ENDED if self.ended else Condition.RUNNING

    @property
    def state(self) -> str:
        return "ended" if self.ended else "reading"


class FolderSource(_Recording):
    """Each image of a folder once, with the position of its line in positions.csv, else that of its EXIF data."""

    def __init__(self, folder: Path, positions: Path | None, clock: Callable[[], float]):
        self._paths = list_images(folder)
        self.total = len(self._paths)
        self._read = 0
        self._clock = clock
        csv_path = positions or find_positions(folder)
        self._tags = read_positions(csv_path) if csv_path else {}
        if positions and not any(decoded_name(path.name) in self._tags for path in self._paths):
            raise UsageError(f"{positions} names none of the images in {folder}: its column `file` must.")

    @property
    def ended(self) -> bool:
        return self._read == self.total

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next image, None after the last. Raises ImageError for an image that cannot be used; the next call
        goes on with the image after it."""
        if self.ended:
            return None
        path = self._paths[self._read]
        self._read += 1
        image = read_image(path)
        name = decoded_name(path.name)  # a map and a positions.csv hold UTF-8 only
        tag = self._tags.get(name) or read_exif(path)
        return Frame(
            image=image,
            name=name,
            t_mono_s=self._clock(),
            t_utc_s=tag.t_utc_s,
            position=tag.position,
            heading_deg=tag.heading_deg,
        )

    def close(self) -> None:
        """Do nothing: no file is held open between images."""


class VideoSource(_Recording):
    """The frames of a video file, at least `step_s` seconds of video time apart: the same frames in every run."""

    def __init__(self, path: Path, step_s: float, clock: Callable[[], float]):
        self.ended = False
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise SourceError(f"{path} is not a video that can be decoded: give a video file or a folder of images.")
        self._step_s = step_s
        self._clock = clock
        self._frame_s = 1 / (self._capture.get(cv2.CAP_PROP_FPS) or _USUAL_RATE_HZ)
        frames = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)  # below zero where the file does not say
        self.total = max(0, math.ceil(frames * self._frame_s / max(step_s, self._frame_s)))
        self._index = -1
        self._t_s = -self._frame_s
        self._t_due_s = 0.0

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame that is due; None at the end, or where decoding takes longer than `timeout_s`."""
        deadline_s = self._clock() + timeout_s
        while self._advance():
            if self._t_s >= self._t_due_s - _TIMESTAMP_ROUNDING_S:
                there, image = self._capture.retrieve()
                if there:
                    self._t_due_s = self._t_s + self._step_s
                    return Frame(
                        image=image, name=f"frame {self._index:06d} t={self._t_s:.3f} s", t_mono_s=self._clock()
                    )
            if self._clock() >= deadline_s:
                break
        return None

    def close(self) -> None:
        self.ended = True
        self._capture.release()

    def _advance(self) -> bool:
        """Advance by one frame; return False at the end."""
        if not self._capture.grab():
            self.ended = True
            return False
        self._index += 1
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        # A bare H.264 or MJPEG file has no time stamps (they read as zero or are wrong): the frame rate is used.
        self._t_s = stamp_s if stamp_s > self._t_s else self._t_s + self._frame_s
        return True
