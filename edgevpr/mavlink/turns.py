"""Turns: the lock of a conversation. A turn is the time in which one thread, that of a link or of the flight, uses the
conversation alone, while its clock stands still. Turns are recorded on the tape, the record of all that comes into a
flight (`core.types.Tape`), so that the flight can be replayed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

from edgevpr.core.types import NO_TAPE, Tape


class Turns:
    """Gives turns to one thread at a time. All that happens in a turn has the same time, so a conversation depends only
    on that time and on its input, and a replay gives the same result. `tape` records the turns in their order."""

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
        """Context manager: take a turn (wait for the lock, then hold it) in the flight's thread. `what` is the name of
        the turn on the tape. Inside another turn of the same thread this has no effect: it is part of that turn."""
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
        """Context manager, for a replay: repeat a link's turn that was taken at `t_s`."""
        self._t_s = t_s
        try:
            yield
        finally:
            self._t_s = None

    @contextmanager
    def of_link(self, name: str) -> Iterator[Callable[..., None]]:
        """Context manager: take a turn in the thread of the link `name`. It yields a function `step(event, *values)`
        that notes what happens in the turn, such as `step("heard", data)`. At its end, all steps go to the tape as one
        record; a turn without a step is not recorded."""
        steps: list[tuple[Any, ...]] = []
        with self._lock:
            self._t_s = t_s = self._clock()
            try:
                yield lambda *step: steps.append(step)
            finally:
                self._t_s = None
                if steps:
                    self._tape.note(name, t_s, steps)
