"""Live sources: cameras and network streams. The newest picture counts; a source that gives none is opened anew."""

import threading
from collections.abc import Callable

from edgevpr.core.types import Frame
from edgevpr.frames.calls import Conversion, Converter, Opening
from edgevpr.frames.liveness import LOST_S, Fault, Liveness
from edgevpr.frames.shot import Capture, Condition, Newness, Refusal, Shot
from edgevpr.frames.source import Source
from edgevpr.frames.twins import TwinCheck

_FIRST_WAIT_S = 0.5
_LONGEST_WAIT_S = 10.0
_CLOSE_TIMEOUT_S = 0.5
_TICK_S = 0.2
_OPENING_S = 90.0  # longer than any opening that ends by itself, see `frames.programs`
_AGED_S = 1.0
_MOST_HANGING = 3  # calls that have not returned: a source that hangs each time must not take ever more threads


class LiveSource(Source):
    """Gives the newest frame of the camera or stream that `open_capture` opens. Where that returns None or raises
    OpeningError, it could not be opened.

    `dropped` counts frames not read in time, and `refused` pictures that were not new and complete, by their reason.
    `latency_s` grows while no new picture comes.

    One thread opens the source and reads it (`Opening`), another converts the pictures that are used (`Converter`). A
    third calls nothing that could hang: it gives up on the others if no new picture comes in time (`Liveness`), and has
    the source opened anew after pauses that grow, for ever. `read` and `close` wait for no call that hangs.
    """

    def __init__(self, open_capture: Callable[[], Capture | None], clock: Callable[[], float]):
        self.is_live, self.total, self.ended = True, 0, False
        self.condition, self.state = Condition.OPENING, "opening, no picture yet"
        self.dropped: int = 0
        self.refused = {reason.value: 0 for reason in Refusal}
        self.latency_s = None
        self.twins = TwinCheck()
        self._open_capture, self._clock = open_capture, clock
        self._t_start_s = clock()
        self._captured = 0
        self._last_taken_s = float("-inf")
        self._newness = Newness()  # over all openings: a server may begin with the picture that it has kept
        self._liveness = Liveness()
        self._newest: tuple[int, Shot] | None = None
        self._conversion: Conversion | None = None
        self._converter = Converter()
        self._opening: Opening | None = None
        self._is_open_noted = False
        self._hanging: list[Callable[[], bool]] = []  # for each call that was given up: has it returned?
        self._changed = threading.Condition()  # guards all of these
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_open, name="camera", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        with self._changed:
            if self._conversion is None:
                self._changed.wait_for(lambda: self._newest is not None, timeout_s)
                if self._newest is None or self._closing.is_set():
                    return None
                self._conversion = Conversion(*self._newest, self._clock())
                self._newest = None
                self._converter.ask(self._conversion)
            conversion = self._conversion
        if not conversion.done.wait(timeout_s):  # the next call waits on
            return None
        with self._changed:
            if conversion is not self._conversion:  # given up
                return None
            self._conversion = None
            if conversion.image is None:
                self.refused[Refusal.DAMAGED.value] += 1
                return None
        t_mono_s, t_sd_s = conversion.shot.t_mono_s, conversion.shot.t_sd_s
        name = f"frame {conversion.number:06d} t={t_mono_s - self._t_start_s:.3f} s"
        image = self.twins.require_single(conversion.image)
        return Frame(image=image, name=name, t_mono_s=t_mono_s, t_sd_s=t_sd_s)

    def close(self) -> None:
        """Stop all threads; return after about a second at most, whether they have ended or not."""
        with self._changed:
            self._closing.set()
            opening = self._opening
        if opening:
            opening.cancel()
            opening.ended.wait(_CLOSE_TIMEOUT_S)
        self._converter.end(_TICK_S)
        self._thread.join(_CLOSE_TIMEOUT_S)
        self.end()

    def _keep_open(self) -> None:
        wait_s = 0.0
        while (opening := self._open()) is not None:
            before = self._captured
            fault = self._watch(opening)
            opening.cancel()
            self._hanging.append(opening.ended.is_set)
            has_failed_again = wait_s and self._captured == before and fault.condition is not Condition.FROZEN
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S) if has_failed_again else _FIRST_WAIT_S
            self._liveness.reopen(fault)
            self._set_condition(fault.condition, f"{fault.text}, reopening in {wait_s:g} s")
            self._closing.wait(wait_s)
            self._wait_for_calls(fault)

    def _open(self) -> Opening | None:
        """Begin to open the source; None if it is to be closed."""
        with self._changed:
            if self._closing.is_set():
                return None
            self._is_open_noted = False
            self._opening = Opening(self._open_capture, self._take, self._clock)
            return self._opening

    def _watch(self, opening: Opening) -> Fault:
        """Wait until a source that is being opened, or is open, must be opened anew, and return why."""
        while not (opening.ended.wait(_TICK_S) or self._closing.is_set()):
            with self._changed:
                if fault := self._fault(opening):
                    self._set_condition(fault.condition, fault.text)
                    if fault.must_reopen:
                        return fault
        cause = "no picture came" if opening.opened_s else "nothing there"
        return Fault(Condition.LOST, opening.cause or ("lost" if self._captured else cause), True)

    def _fault(self, opening: Opening) -> Fault | None:
        now_s, conversion = self._clock(), self._conversion
        if self._captured and now_s - self._last_taken_s > _AGED_S:
            self.latency_s = now_s - self._last_taken_s
        if conversion and not conversion.done.is_set() and now_s - conversion.began_s > LOST_S:
            self._converter.end()
            self._hanging.append(self._converter.has_ended)
            self._converter, self._conversion = Converter(), None
            self._newest = None  # of the same decoder
            return Fault(Condition.LOST, "lost: a picture cannot be converted", True)
        if opening.opened_s is None:
            is_late = now_s - opening.began_s > _OPENING_S
            return Fault(Condition.LOST, "lost: the opening hangs", True) if is_late else None
        self._note_open(opening)
        return self._liveness.fault(now_s)

    def _note_open(self, opening: Opening) -> None:
        if not self._is_open_noted and opening.opened_s is not None:
            self._is_open_noted = True
            self._liveness.open(opening.opened_s)

    def _wait_for_calls(self, fault: Fault) -> None:
        while not self._closing.is_set():
            self._hanging = [has_returned for has_returned in self._hanging if not has_returned()]
            if len(self._hanging) < _MOST_HANGING:
                return
            self._set_condition(fault.condition, f"{fault.text}; {len(self._hanging)} calls into it hang")
            self._closing.wait(_FIRST_WAIT_S)

    def _take(self, opening: Opening, shot: Shot | Refusal) -> None:
        """Take what an opening has read, unless it has been given up."""
        with self._changed:
            if opening is not self._opening or opening.is_cancelled:
                return
            self._note_open(opening)
            now_s = self._clock()
            found = shot if isinstance(shot, Refusal) else self._put(shot, now_s)
            if found is None:
                self.facts = self.facts or opening.facts
            else:
                self.refused[found.value] += 1
                self._liveness.refuse(found, now_s)

    def _put(self, shot: Shot, now_s: float) -> Refusal | None:
        """Keep a picture as the newest one, or return why it is none."""
        if refusal := self._newness.refusal(shot.look):
            return refusal
        if shot.t_mono_s < self._last_taken_s:
            return Refusal.LATE
        if refusal := self._liveness.take(now_s):
            return refusal
        self._set_condition(Condition.RUNNING, "streaming")
        self.latency_s, self._last_taken_s = now_s - shot.t_mono_s, shot.t_mono_s
        self.dropped += self._newest is not None
        self._newest = self._captured, shot
        self._captured += 1
        self._changed.notify_all()
        return None

    def _set_condition(self, condition: Condition, state: str) -> None:
        if not self.ended:
            self.condition, self.state = condition, state
