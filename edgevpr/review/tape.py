"""The tape of a recorded flight, played back: every question gets the answer that it got then."""

import json
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from edgevpr.core.errors import EdgevprError
from edgevpr.review.packets import Packets
from edgevpr.runtime.flight.world import StopNow

T = TypeVar("T")
_CLOCKS = "mono_s", "wall_s", "utc_s", "process_cpu_s", "thread_cpu_s"
Perform = Callable[[float, list[list[Any]]], None]  # a turn of a link: its time, and its steps


class TapeEnded(BaseException):
    """Raised where the tape has no more: the flight was killed, or the recording had ended before it."""


class Playback:
    """A tape that is played back. The turns of the links (`links`, by name) are taken where they were taken, and
    `packets` compares what they say.

    Code that has changed since the flight may ask more, less, or in another order. The frames then keep both in step:
    a question that has no answer before the next frame gets the newest one of its kind. `guessed` counts the questions
    out of turn; where it is 0, the replay has asked what the flight asked.
    """

    def __init__(self, notes: Iterator[list[Any]]) -> None:
        self.links: dict[str, Perform] = {}
        self.packets = Packets()
        self.guessed = 0
        self.t_s = 0.0  # of the newest turn or look at the clock
        self._notes = notes
        self._ahead: deque[list[Any]] = deque()
        self._known: dict[str, Any] = {}
        self._is_stopping = False

    def read(self, kind: str, look: Callable[[], T]) -> Any:
        """Return the answer of the flight. Raises StopNow where the flight was ended meanwhile, and TapeEnded."""
        if self._head()[0] == "stopped":
            self._ahead.popleft()
            self._is_stopping = True
        # What was broken off may have asked, on its way out, what its undisturbed end asks.
        if self._is_stopping and self._head()[0] != kind:
            self._is_stopping = False
            raise StopNow
        if self._head()[0] != kind:
            self.guessed += 1
            steps = self._steps_to(kind)
            if steps is None:
                return self._guess(kind, look)
            for _ in range(steps):
                self._take()
        note = self._take()
        found = self._known[kind] = note[1]
        if _is_moment(kind):
            self.t_s = max(self.t_s, found)
        return found

    def note(self, kind: str, *values: Any) -> None:
        """Do nothing: what happens is on the tape."""

    def _head(self) -> list[Any]:
        """Return the next answer, after the turns of the links before it. Raises TapeEnded."""
        for note in self._from(0):
            perform = self.links.get(note[0])
            if perform is None:
                return note
            self._ahead.popleft()
            _, t_s, steps = note
            self.t_s = max(self.t_s, t_s)
            perform(t_s, steps)
        raise TapeEnded

    def _take(self) -> list[Any]:
        """Take the next answer off the tape. Raises StopNow where it is the end that was asked for, and TapeEnded."""
        note = self._head()
        self._ahead.popleft()
        if note[0] == "stopped":
            raise StopNow
        return note

    def _steps_to(self, kind: str) -> int | None:
        """Count the answers before the next one of a kind; None where there is none before the next frame. A look at a
        clock is not worth going on."""
        steps = 0
        for note in self._from(0) if kind not in _CLOCKS else ():
            if note[0] in (kind, "stopped"):
                return steps
            if note[0] == "frame":
                return None
            steps += note[0] not in self.links
        return None

    def _from(self, at: int) -> Iterator[list[Any]]:
        """Yield the notes ahead, the first of which may be taken away meanwhile."""
        while True:
            if at == len(self._ahead):
                if (note := next(self._notes, None)) is None:
                    return
                self._ahead.append(note)
            before = len(self._ahead)
            yield self._ahead[at]
            at += len(self._ahead) == before

    def _guess(self, kind: str, look: Callable[[], T]) -> Any:
        if kind == "frame":
            raise TapeEnded
        if _is_moment(kind):
            return self.t_s
        if kind in _CLOCKS:
            return self._known.get(kind, 0.0)
        return self._known[kind] if kind in self._known else look()


def _is_moment(kind: str) -> bool:
    """Tell whether an answer is a time on the clock of the flight."""
    return kind == "mono_s" or kind.startswith("turn: ")


def read_tape(path: Path) -> Iterator[list[Any]]:
    """Yield the notes of a tape; a last line that was cut is left out. Raises EdgevprError where there is none."""
    try:
        with open(path, "rb") as file:
            for line in file:
                try:
                    yield json.loads(line)
                except ValueError:
                    return
    except OSError as error:
        raise EdgevprError(
            f"{path} cannot be read ({error.strerror}): give the log of a flight with `log.record`, and its recording."
        ) from error
