"""Live sources: cameras and network streams. A thread reads their pictures, holds the newest one, and reopens a source
that is lost."""

import contextlib
import threading
from collections.abc import Callable

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Image
from edgevpr.core.types import Frame
from edgevpr.frames.age import UnstampedTime
from edgevpr.frames.depth import DepthRange, find_limits, sample_counts, to_8_bits
from edgevpr.frames.shot import Capture, Condition, Newness, OpeningError, Refusal, Shot, coarse
from edgevpr.frames.source import Source
from edgevpr.frames.twins import TwinCheck

_FORMATS_OF_COUNTS = [cv2.VideoWriter.fourcc(*name) for name in ("Y16 ", "Y12 ", "Y10 ")]  # of thermal cameras
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 10.0
_CLOSE_TIMEOUT_S = 0.5
_FROZEN_S, _FROZEN_PICTURES = 1.0, 3  # both are needed: a slow camera may take less than three pictures a second
_DAMAGED_S = 5.0  # longer than streams need to recover from a lost packet
_LATE = "late: the age of its pictures is unknown, as time stamps do not keep time or decoding lags behind"


class DeviceCapture:
    """A V4L2 camera opened with OpenCV: a `Capture`. If it cannot be opened, the first `read` returns None. OpenCV does
    not report damaged pictures, so none is rejected here."""

    def __init__(self, capture: cv2.VideoCapture, clock: Callable[[], float]) -> None:
        self._capture, self._clock = capture, clock
        self._time, self._depth = UnstampedTime(clock()), DepthRange()
        if int(capture.get(cv2.CAP_PROP_FOURCC)) in _FORMATS_OF_COUNTS:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # else OpenCV keeps the upper 8 bits only

    def read(self) -> Shot | None:
        with contextlib.suppress(cv2.error):  # a picture that cannot be converted counts as a loss
            asked_s = self._clock()
            there, read = self._capture.read()
            if there:
                came_s = self._clock()
                sd_s = self._time.taken(asked_s, came_s).sd_s
                look, pixels = self._prepare(read)
                return Shot(t_mono_s=came_s, t_sd_s=sd_s, look=look, pixels=pixels)
        return None

    def _prepare(self, read: Array) -> tuple[Image, Callable[[], Image]]:
        """Return the coarse copy of a picture, and what converts the picture."""
        if read.dtype == np.uint16:
            counts = np.asarray(read, np.uint16)
            sample, limits = sample_counts(counts), self._depth.update(counts)
            return to_8_bits(sample, find_limits(sample)), lambda: to_8_bits(counts, limits)
        image: Image = np.asarray(read, np.uint8)
        return coarse(image if image.ndim == 2 else image[:, :, 1]), lambda: image

    def release(self) -> None:
        self._capture.release()


class LiveSource(Source):
    """Gives the newest frame of the camera or stream that `open_capture` opens. Where that returns None or raises
    OpeningError, it could not be opened.

    `dropped` counts frames not read in time, and `refused` pictures that were not new and complete, by their reason.
    Only the capture thread uses the capture, from opening to release: a call into a stream that hangs cannot be
    interrupted. `close` waits half a second, then leaves the thread to its time-out.
    """

    def __init__(self, open_capture: Callable[[], Capture | None], clock: Callable[[], float]):
        self.is_live, self.total, self.ended = True, 0, False
        self.condition, self.state = Condition.OPENING, "opening"
        self.dropped: int = 0
        self.refused = {reason.value: 0 for reason in Refusal}
        self.latency_s = None
        self._open_capture = open_capture
        self.twins = TwinCheck()
        self._clock = clock
        self._t_start_s = clock()
        self._captured = self._same = 0
        self._last_new_s = self._t_start_s
        self._last_taken_s = float("-inf")
        self._newest: tuple[int, Shot] | None = None
        self._arrived = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._capture, name="capture", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest is not None, timeout_s)
            newest, self._newest = self._newest, None
        if newest is None or self._closing.is_set():
            return None
        number, shot = newest
        name = f"frame {number:06d} t={shot.t_mono_s - self._t_start_s:.3f} s"
        image = self.twins.require_single(shot.pixels())
        return Frame(image=image, name=name, t_mono_s=shot.t_mono_s, t_sd_s=shot.t_sd_s)

    def close(self) -> None:
        """Stop the capture thread; return after about half a second at most."""
        self._closing.set()
        self._thread.join(_CLOSE_TIMEOUT_S)
        self.end()

    def _capture(self) -> None:
        wait_s = 0.0
        while not self._closing.is_set():
            before, capture, cause = self._captured, None, "nothing there"
            try:
                capture = self._open_capture()
            except OpeningError as error:
                cause = str(error)
            if capture is not None:
                cause = "no picture came"
                self._take_pictures(capture)
                capture.release()
            has_failed_again = wait_s and self._captured == before
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S) if has_failed_again else _FIRST_WAIT_S
            self.condition = Condition.LOST
            self.state = f"{'lost' if self._captured else cause}, reopening in {wait_s:g} s"
            self._closing.wait(wait_s)

    def _take_pictures(self, capture: Capture) -> None:
        newness, self._same, self._last_new_s = Newness(), 0, self._clock()
        while not self._closing.is_set():
            shot = capture.read()
            if shot is None:
                return
            if isinstance(shot, Refusal):
                self._refuse(shot)
            elif refusal := newness.refusal(shot.look):
                self._refuse(refusal)
            elif shot.t_mono_s < self._last_taken_s:
                self._refuse(Refusal.LATE)
            else:
                self.facts = self.facts or getattr(capture, "facts", None)
                self._put(shot)

    def _put(self, shot: Shot) -> None:
        now_s = self._clock()
        self.condition, self.state = Condition.RUNNING, "streaming"
        self.latency_s = now_s - shot.t_mono_s
        self._same, self._last_new_s, self._last_taken_s = 0, now_s, shot.t_mono_s
        with self._arrived:
            self.dropped += self._newest is not None
            self._newest = self._captured, shot
            self._captured += 1
            self._arrived.notify()

    def _refuse(self, refusal: Refusal) -> None:
        self.refused[refusal.value] += 1
        self._same = self._same + 1 if refusal is Refusal.FROZEN else 0
        silent_s = self._clock() - self._last_new_s
        if self._same >= _FROZEN_PICTURES and silent_s > _FROZEN_S:
            self.condition, self.state = Condition.FROZEN, "frozen: the same picture over and over"
        elif refusal is Refusal.LATE and silent_s > _DAMAGED_S:
            self.condition, self.state = Condition.LATE, _LATE
        elif not self._same and silent_s > _DAMAGED_S:
            self.condition, self.state = Condition.DAMAGED, "damaged: no picture is whole"
