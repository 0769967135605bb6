"""Turns: one thread at a time uses a conversation, while its clock stands still. They go to the tape."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

from edgevpr.core.types import NO_TAPE, Tape


class Turns:
    """Gives turns to one thread at a time. A conversation depends only on their times and on its input."""

    def __init__(self, clock: Callable[[], float], tape: Tape = NO_TAPE) -> None:
        self._clock, self._tape = clock, tape
        self._lock = RLock()
        self._t_s: float | None = None  # time of the current turn; None between turns

    def now_s(self) -> float:
        """Return the time of the current turn, or that of the clock between turns."""
        t_s = self._t_s
        return self._clock() if t_s is None else t_s

    @contextmanager
    def taken(self, what: str) -> Iterator[None]:
        """Context manager: take a turn, named `what` on the tape, in the flight's thread, or go on with its own."""
        with self._lock:
            if self._t_s is not None:
                yield
                return
            with self.again(self._tape.read(f"turn: {what}", self._clock)):
                yield

    @contextmanager
    def again(self, t_s: float) -> Iterator[None]:
        """Context manager: let the time stand still at `t_s`; in a replay, this repeats a link's turn."""
        self._t_s = t_s
        try:
            yield
        finally:
            self._t_s = None

    @contextmanager
    def of_link(self, name: str) -> Iterator[Callable[..., None]]:
        """Context manager: take a turn in the thread of the link `name`. It yields a function that notes a step of the
        turn, such as `step("heard", data)`; all go to the tape as one record."""
        steps: list[tuple[Any, ...]] = []
        with self._lock:
            t_s = self._clock()
            try:
                with self.again(t_s):
                    yield lambda *step: steps.append(step)
            finally:
                if steps:
                    self._tape.note(name, t_s, steps)
