"""Turns: the threads of the links and that of the flight use one conversation, one after another."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

from edgevpr.core.types import NO_TAPE, Tape


class Turns:
    """One turn at a time. During a turn time stands still, so that what is said and heard follows from its time, and
    from what came in, alone. The `tape` takes note of the turns in their order."""

    def __init__(self, clock: Callable[[], float], tape: Tape = NO_TAPE) -> None:
        self._clock, self._tape = clock, tape
        self._lock = RLock()
        self._t_s: float | None = None  # of the turn that is taken

    def now_s(self) -> float:
        """Return the time of the turn, between two turns that of the clock."""
        t_s = self._t_s
        return self._clock() if t_s is None else t_s

    @contextmanager
    def taken(self, what: str) -> Iterator[None]:
        """Take a turn in the thread of the flight. Inside another one this is a part of it."""
        with self._lock:
            if self._t_s is not None:
                yield
                return
            self._t_s = self._tape.read(f"turn: {what}", self._clock)
            try:
                yield
            finally:
                self._t_s = None

    @contextmanager
    def again(self, t_s: float) -> Iterator[None]:
        """Take the turn of a link again that was taken at `t_s`."""
        self._t_s = t_s
        try:
            yield
        finally:
            self._t_s = None

    @contextmanager
    def of_link(self, name: str) -> Iterator[Callable[..., None]]:
        """Take a turn in the thread of the link of this name. What is yielded takes note of each step of it: a word,
        and what belongs to it."""
        steps: list[tuple[Any, ...]] = []
        with self._lock:
            self._t_s = t_s = self._clock()
            try:
                yield lambda *step: steps.append(step)
            finally:
                self._t_s = None
                if steps:
                    self._tape.note(name, t_s, steps)
