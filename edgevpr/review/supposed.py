"""Supposing: the frames and messages of a recorded flight with another configuration, beside what was flown."""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.review.tape import Note, Playback, ReplayedLink

T = TypeVar("T")
_AS_FOUND = "is_live", "limit_c", "heat", "load", "rss_mb", "memory_mb", "port", "picked", "cannot_learn"
_ALWAYS: dict[str, Any] = {
    "stop": False,
    "reread": False,
    "log is written": True,
    "process_cpu_s": 0.0,
    "thread_cpu_s": 0.0,
    "refused": {},
    "dropped": 0,
    "latency_s": None,
    "condition": "RUNNING",
    "state": "replayed",
}


class SupposedLink(ReplayedLink):
    """A link to an autopilot that says what it said then; what is said to it leaves at once."""

    def _said(self, then: str | None) -> None:
        while chosen := self._conversation.next_packet():
            if sending := chosen[1]:
                sending.settle(True)
                self._conversation.note_departed([sending])

    def _departed(self, count: int) -> None:
        pass

    def _ring(self) -> None:
        with self.turn("ring"):
            self._said(None)


class SupposedGround(GroundLink, SupposedLink):
    """The link to the ground, likewise."""


class Supposed(Playback):
    """A tape for a flight that may go another way: its time is that of the tape, which goes on from frame to frame, and
    work takes none. What the machine was asked is answered as it was last."""

    link, ground = SupposedLink, SupposedGround

    def __init__(self, notes: Iterator[Note]) -> None:
        super().__init__(notes)
        self._has_ended = False
        self._utc_ahead_s = 0.0

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Answer as the flight could have been answered."""
        return cast(T, look() if kind == "outlook" else self._answer(kind, look))

    def sleep(self, seconds: float) -> None:
        """Let time go on, up to the next frame."""
        until_s = self.t_s + seconds
        while (note := self._peek()) and note[0] != "frame" and self._time_of(note) <= until_s:
            self._step()
        self.t_s = max(self.t_s, until_s)

    def _answer(self, kind: str, look: Callable[[], Any]) -> Any:
        if kind == "frame":
            return self._frame()
        if kind == "ended":
            return self._has_ended
        if kind in _ALWAYS:
            return _ALWAYS[kind]
        if kind in _AS_FOUND:
            while kind not in self._known and self._step():
                pass
            return self._known[kind] if kind in self._known else look()
        return self.t_s + (self._utc_ahead_s if kind == "utc_s" else 0.0)

    def _frame(self) -> dict[str, Any] | None:
        """Return the next frame; of several that time has passed over, the newest, as a camera gives it."""
        frame: dict[str, Any] | None = None
        while note := self._peek():
            if frame and self._time_of(note) > self.t_s:
                break
            if note[0] == "frame" and note[1] is not None:
                frame = note[1]
            self._step()
        self._has_ended |= frame is None
        return frame

    def _peek(self) -> Note | None:
        return next(self._upcoming(), None)

    def _step(self) -> bool:
        """Go on by one note; return False at the end of the tape."""
        if (note := self._peek()) is None:
            return False
        self._ahead.popleft()
        kind, *values = note
        self.t_s = max(self.t_s, self._time_of(note))
        if perform := self.links.get(kind):
            perform(*values)
        elif kind == "utc_s":
            self._utc_ahead_s = values[0] - self.t_s
        elif values:
            self._known[kind] = values[0]
        return True

    def _time_of(self, note: Note) -> float:
        return float(note[1]) if note[0] == "mono_s" or note[0] in self.links else self.t_s
