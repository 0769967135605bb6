"""Plays a recorded flight back to code with another configuration: `edgevpr replay --config`, a "what if".

Frames and messages are those of the recording, but the flight may ask for and send other things than it did.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.review.tape import Note, Playback, ReplayedLink

T = TypeVar("T")
# Kinds of questions: those answered by the newest answer on the tape, and those with always the same answer.
_AS_FOUND = "is_live", "limit_c", "heat", "load", "rss_mb", "memory_mb", "port", "picked", "cannot_learn"
_ALWAYS: dict[str, Any] = {
    "stop": False,
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
    """A link on which the autopilot sends what it sent in the flight. A packet to it counts as sent at once."""

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
    """The link to the ground station, replayed as `SupposedLink` is."""


class Supposed(Playback):
    """Playback for a flight that may take another course. Its time is that of the tape and goes on from frame to frame;
    computing takes no time. Questions about the machine get the newest answer on the tape."""

    link, ground = SupposedLink, SupposedGround

    def __init__(self, notes: Iterator[Note]) -> None:
        super().__init__(notes)
        self._has_ended = False
        self._utc_ahead_s = 0.0

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return an answer that the flight could have got to a question of `kind`; `look` asks the real machine."""
        return cast(T, look() if kind == "outlook" else self._answer(kind, look))

    def sleep(self, seconds: float) -> None:
        """Advance the time by `seconds`. The notes of that time are taken off the tape, up to the next frame."""
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
        """Return the next frame (None: the tape has no more). If the time is past several frames, return the newest of
        them, as a camera would."""
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
        """Take the next note off the tape and act on it. Return False if the tape has no more."""
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
