"""Live pictures: a thread that holds the newest frame of a camera or network stream, and reopens a lost source."""

import contextlib
import threading
from collections.abc import Callable

import numpy as np

from edgevpr.frames.condition import Condition
from edgevpr.frames.opencv import cv2
from edgevpr.types import Frame

_OPEN_TIMEOUT_MS = 5000
_READ_TIMEOUT_MS = 3000
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 10.0
_CLOSE_TIMEOUT_S = 1.0


def open_stream(uri: str) -> cv2.VideoCapture:
    """Open a network stream with time-outs: without them FFmpeg would wait for ever."""
    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_TIMEOUT_MS]
    return cv2.VideoCapture(uri, cv2.CAP_FFMPEG, timeouts)


def open_camera(device: str) -> cv2.VideoCapture:
    """Open a V4L2 device (/dev/video0, /dev/v4l/by-id/...)."""
    return cv2.VideoCapture(device, cv2.CAP_V4L2)


def wait_before_reopening_s(failures: int) -> float:
    """Return 0.5 s after the first failure in a row, twice as long after each further one, 10 s at most."""
    return min(_FIRST_WAIT_S * 2.0 ** min(failures - 1, 10), _LONGEST_WAIT_S)


class LiveSource:
    """The newest frame of the capture that `open_capture` opens. Frames not read in time are counted in `dropped`.

    Only the capture thread touches the capture, from opening to release: a call into a stream that hangs cannot be
    interrupted. `close` waits one second, then leaves the thread to its time-out.
    """

    is_live = True
    total = 0

    def __init__(self, open_capture: Callable[[], cv2.VideoCapture], clock: Callable[[], float]):
        self._condition, self.state = Condition.OPENING, "opening"
        self.ended = False
        self.dropped = 0
        self._open_capture = open_capture
        self._clock = clock
        self._t_start_s = clock()
        self._captured = 0
        self._newest: Frame | None = None
        self._arrived = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._capture, name="capture", daemon=True)
        self._thread.start()

    @property
    def condition(self) -> Condition:
        return Condition.ENDED if self.ended else self._condition

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame, if it was not read before; None where none comes within `timeout_s`."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest is not None, timeout_s)
            frame, self._newest = self._newest, None
            return frame

    def close(self) -> None:
        """End the capture, within about a second."""
        self.ended = True
        self._closing.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _capture(self) -> None:
        failures = 0
        while not self._closing.is_set():
            before = self._captured
            capture = self._open_capture()
            with contextlib.suppress(cv2.error):  # a picture that cannot be converted counts as a loss
                self._take_frames(capture)
            capture.release()
            failures = 1 if self._captured > before else failures + 1
            wait_s = wait_before_reopening_s(failures)
            self._condition = Condition.LOST
            self.state = f"{'lost' if self._captured else 'nothing there'}, reopening in {wait_s:g} s"
            self._closing.wait(wait_s)

    def _take_frames(self, capture: cv2.VideoCapture) -> None:
        while not self._closing.is_set():
            there, image = capture.read()
            if not there:  # the only sign of a lost source: `isOpened` stays true
                return
            self._condition, self.state = Condition.RUNNING, "streaming"
            self._put(image)

    def _put(self, image: np.ndarray) -> None:
        t_mono_s = self._clock()
        frame = Frame(
            image=image, name=f"frame {self._captured:06d} t={t_mono_s - self._t_start_s:.3f} s", t_mono_s=t_mono_s
        )
        self._captured += 1
        with self._arrived:
            self.dropped += self._newest is not None
            self._newest = frame
            self._arrived.notify()
