"""Live sources: cameras and network streams. Only the newest image is used; a source that delivers none is reopened.

A call into a driver or a decoder may never return, and a thread that hangs in one cannot be killed. So one thread opens
and reads the source, another converts the images that are used, and a third, which makes no calls that can hang,
replaces both if they hang; the process exits without them (`cli.main`). A separate process could be killed, but needs
40 MB more and a copy of every image, and a driver that hangs in the kernel blocks it too."""

import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue

from edgevpr.core.arrays import Image
from edgevpr.core.types import Frame
from edgevpr.frames.liveness import LOST_AFTER_S, Fault, Liveness
from edgevpr.frames.shot import Capture, Condition, OpeningError, Refusal, RepeatDetector, Shot
from edgevpr.frames.source import Source
from edgevpr.frames.stereo import StereoCheck

_FIRST_WAIT_S = 0.5
_MAX_WAIT_S = 10.0
_CLOSE_TIMEOUT_S = 0.5
_POLL_PERIOD_S = 0.2
_OPENING_TIMEOUT_S = 90.0  # longer than any opening that does not hang, see `frames.programs`
_STALE_PICTURE_S = 1.0
_MAX_HANGING_THREADS = 3  # a source that hangs at every opening must not use up threads


class _Opening:
    """One opening of a camera or stream. `opened_s`: when it succeeded (None: not yet). `cause`: why it could not be
    opened or read further, in a few words (None: lost or cancelled). `thread` runs `read` with this object."""

    def __init__(self, read: Callable[["_Opening"], None], start_s: float) -> None:
        self.start_s = start_s
        self.opened_s: float | None = None
        self.cause: str | None = None
        self.capture: Capture | None = None
        self.is_cancelled = False
        self.thread = threading.Thread(target=read, args=(self,), name="capture", daemon=True)
        self.thread.start()

    def cancel(self) -> None:
        """Let the thread end as soon as its current call returns."""
        self.is_cancelled = True
        if self.capture is not None:
            self.capture.cancel()


class _Conversion:
    """The conversion of an image, requested at `start_s`. `image`: result once `done` is set; None if it failed."""

    def __init__(self, number: int, shot: Shot, start_s: float) -> None:
        self.number, self.shot, self.start_s = number, shot, start_s
        self.image: Image | None = None
        self.done = threading.Event()


class _Converter:
    """A thread that converts the images in `requests` one by one until it receives None."""

    def __init__(self) -> None:
        self.requests: SimpleQueue[_Conversion | None] = SimpleQueue()
        self.thread = threading.Thread(target=self._run, name="convert", daemon=True)
        self.thread.start()

    def _run(self) -> None:
        while (conversion := self.requests.get()) is not None:
            with suppress(Exception):  # an image that cannot be decoded is skipped
                conversion.image = conversion.shot.convert()
            conversion.done.set()
            del conversion  # its image is large


class LiveSource(Source):
    """Delivers the newest frame of the camera or stream that `open_capture` opens, unless it raises OpeningError.

    `dropped` counts frames that were not read in time, and `refused` images that were not new and complete, by
    reason. `latency_s` grows while no new image arrives. If none arrives in time (`Liveness`), the source is
    reopened, after increasing pauses, until it delivers. `read` and `close` never wait for a call that hangs."""

    def __init__(self, open_capture: Callable[[], Capture], clock: Callable[[], float]):
        self.is_live, self.total, self.ended = True, 0, False
        self.condition, self.state = Condition.OPENING, "opening, no picture yet"
        self.dropped: int = 0
        self.refused = {reason.value: 0 for reason in Refusal}
        self.latency_s = None
        self.stereo = StereoCheck()
        self._open_capture, self._clock = open_capture, clock
        self._t_start_s = clock()
        self._capture_count = 0
        self._last_taken_s = float("-inf")
        self._repeats = RepeatDetector()  # kept across openings: a server may begin with a stored image
        self._liveness = Liveness()
        self._newest: tuple[int, Shot] | None = None
        self._conversion: _Conversion | None = None
        self._converter = _Converter()
        self._opening: _Opening | None = None
        self._hung_threads: list[threading.Thread] = []  # abandoned because they hang
        self._changed = threading.Condition()  # guards all attributes above
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._supervise, name="camera", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        with self._changed:
            if self._conversion is None:
                self._changed.wait_for(lambda: self._newest is not None, timeout_s)
                if self._newest is None or self._closing.is_set():
                    return None
                self._conversion = _Conversion(*self._newest, self._clock())
                self._newest = None
                self._converter.requests.put(self._conversion)
            conversion = self._conversion
        if not conversion.done.wait(timeout_s):  # the next call continues to wait
            return None
        with self._changed:
            if conversion is not self._conversion:  # abandoned
                return None
            self._conversion = None
            if conversion.image is None:
                self.refused[Refusal.DAMAGED.value] += 1
                return None
        shot = conversion.shot
        name = f"frame {conversion.number:06d} t={shot.t_mono_s - self._t_start_s:.3f} s"
        image = self.stereo.refuse_stereo(conversion.image)
        return Frame(image=image, name=name, t_mono_s=shot.t_mono_s, t_sd_s=shot.t_sd_s, delay_sd_s=shot.delay_sd_s)

    def close(self) -> None:
        """Stop all threads. Returns after about a second at most, whether or not they have ended."""
        with self._changed:
            self._closing.set()
            opening = self._opening
        if opening:
            opening.cancel()
            opening.thread.join(_CLOSE_TIMEOUT_S)
        self._converter.requests.put(None)
        self._converter.thread.join(_POLL_PERIOD_S)
        self._thread.join(_CLOSE_TIMEOUT_S)
        self.end()

    def _supervise(self) -> None:
        wait_s = 0.0
        while not self._closing.is_set():
            with self._changed:
                opening = self._opening = _Opening(self._read_capture, self._clock())
            captured = self._capture_count
            fault = self._watch(opening)
            opening.cancel()
            self._hung_threads.append(opening.thread)
            has_failed_again = wait_s and self._capture_count == captured and fault.condition is not Condition.FROZEN
            wait_s = min(2 * wait_s, _MAX_WAIT_S) if has_failed_again else _FIRST_WAIT_S
            self._liveness.record_reopening(fault)
            self._set_condition(fault.condition, f"{fault.text}, reopening in {wait_s:g} s")
            self._closing.wait(wait_s)
            self._wait_for_threads(fault)

    def _watch(self, opening: _Opening) -> Fault:
        """Wait until the source must be reopened, and return the reason."""
        while opening.thread.is_alive() and not self._closing.is_set():
            opening.thread.join(_POLL_PERIOD_S)
            with self._changed:
                if opening.thread.is_alive() and (fault := self._find_fault(opening)):
                    self._set_condition(fault.condition, fault.text)
                    if fault.must_reopen:
                        return fault
        return Fault(Condition.LOST, opening.cause or ("lost" if self._capture_count else "no picture arrived"), True)

    def _find_fault(self, opening: _Opening) -> Fault | None:
        now_s, conversion = self._clock(), self._conversion
        if self._capture_count and now_s - self._last_taken_s > _STALE_PICTURE_S:
            self.latency_s = now_s - self._last_taken_s
        if conversion and not conversion.done.is_set() and now_s - conversion.start_s > LOST_AFTER_S:
            self._converter.requests.put(None)
            self._hung_threads.append(self._converter.thread)
            self._converter, self._conversion = _Converter(), None
            self._newest = None  # from the same decoder
            return Fault(Condition.LOST, "lost: a picture cannot be converted", True)
        if opening.opened_s is not None:
            return self._liveness.find_fault(now_s)
        is_hung = now_s - opening.start_s > _OPENING_TIMEOUT_S
        return Fault(Condition.LOST, "lost: the opening hangs", True) if is_hung else None

    def _wait_for_threads(self, fault: Fault) -> None:
        while not self._closing.is_set():
            self._hung_threads = [thread for thread in self._hung_threads if thread.is_alive()]
            if len(self._hung_threads) < _MAX_HANGING_THREADS:
                return
            self._set_condition(fault.condition, f"{fault.text}; {len(self._hung_threads)} calls to it hang")
            self._closing.wait(_FIRST_WAIT_S)

    def _read_capture(self, opening: _Opening) -> None:
        """Open the source, handle its images until it is lost or cancelled, and release it. Runs in a thread."""
        try:
            capture = opening.capture = self._open_capture()
            try:
                with self._changed:
                    if self._is_current(opening):
                        opening.opened_s = self._clock()
                        self._liveness.record_opening(opening.opened_s)
                while not opening.is_cancelled and (shot := capture.read()) is not None:
                    self._handle_shot(opening, shot)
            finally:
                capture.release()
        except OpeningError as error:
            opening.cause = str(error)
        except Exception as error:  # any error of a driver or a decoder
            opening.cause = f"{type(error).__name__}: {error}"

    def _is_current(self, opening: _Opening) -> bool:
        return opening is self._opening and not opening.is_cancelled

    def _handle_shot(self, opening: _Opening, shot: Shot | Refusal) -> None:
        """Store or count a picture read by an opening, unless the opening was abandoned."""
        with self._changed:
            if not self._is_current(opening):
                return
            now_s = self._clock()
            refusal = shot if isinstance(shot, Refusal) else self._store_shot(shot, now_s)
            if refusal is None:
                self.facts = self.facts or (opening.capture.facts if opening.capture else None)
            else:
                self.refused[refusal.value] += 1
                self._liveness.record_refusal(refusal, now_s)

    def _store_shot(self, shot: Shot, now_s: float) -> Refusal | None:
        """Store an image as the newest one, or return why it is rejected."""
        if refusal := self._repeats.find_repeat(shot.thumbnail):
            return refusal
        if shot.t_mono_s < self._last_taken_s:
            return Refusal.LATE
        if refusal := self._liveness.record_picture(now_s):
            return refusal
        self._set_condition(Condition.RUNNING, "streaming")
        self.latency_s, self._last_taken_s = now_s - shot.t_mono_s, shot.t_mono_s
        self.dropped += self._newest is not None
        self._newest = self._capture_count, shot
        self._capture_count += 1
        self._changed.notify_all()
        return None

    def _set_condition(self, condition: Condition, state: str) -> None:
        if not self.ended:
            self.condition, self.state = condition, state
