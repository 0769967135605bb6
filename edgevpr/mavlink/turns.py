"""Turns: exclusive use of a conversation by one thread at a time. Its clock stands still during a turn."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock


class Turns:
    """Gives a turn to one thread at a time. A conversation depends only on its input and the times of its turns."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._lock = RLock()
        self._t_s: float | None = None  # time of the current turn; None between turns

    def now_s(self) -> float:
        """Return the time of the current turn or, between turns, the time of the clock."""
        t_s = self._t_s
        return self._clock() if t_s is None else t_s

    @contextmanager
    def take_turn(self, name: str) -> Iterator[None]:
        """Context manager: take a turn in the flight's thread, or continue its current one. `name` is for the tape."""
        with self._lock:
            if self._t_s is not None:
                yield
                return
            with self.freeze_clock(self._begin(name)):
                yield

    @contextmanager
    def freeze_clock(self, t_s: float) -> Iterator[None]:
        """Context manager: make the time stand still at `t_s`. A replay uses it to repeat the link's turns."""
        self._t_s = t_s
        try:
            yield
        finally:
            self._t_s = None

    @contextmanager
    def take_link_turn(self) -> Iterator[None]:
        """Context manager: take a turn in the link's thread."""
        with self._lock, self.freeze_clock(self._clock()):
            yield

    def _begin(self, name: str) -> float:
        """Begin a turn of the flight's thread, and return its time."""
        return self._clock()
