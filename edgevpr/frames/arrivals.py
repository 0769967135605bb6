"""The packets of a stream, each with the time at which it came."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgevpr.frames.decoding import Fetched


@dataclass(frozen=True, slots=True)
class Arrival:
    """A packet that was asked for at `asked_s` and came at `t_mono_s`."""

    fetched: "Fetched"
    asked_s: float
    t_mono_s: float


class Arrivals:
    """Takes the packets from a stream as they come, in a thread of its own: on a board that is too slow to decode them
    they wait here, where it is known how long, and not in the network, where it is not."""

    def __init__(self, fetch: "Callable[[], Fetched | None]", clock: Callable[[], float]) -> None:
        self._fetch, self._clock = fetch, clock
        self._waiting: deque[Arrival] = deque()
        self._changed = threading.Condition()
        self._is_over = self._is_closing = False
        self._thread = threading.Thread(target=self._take, name="fetch", daemon=True)
        self._thread.start()

    def next(self) -> Arrival | None:
        """Wait for the next packet and return it; None where the stream is lost."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over)
            return self._waiting.popleft() if self._waiting else None

    def can_begin_anew(self) -> bool:
        """Tell whether a picture waits that can be decoded without those before it."""
        with self._changed:
            return any(arrival.fetched.packet.is_keyframe for arrival in self._waiting)

    def close(self) -> None:
        """Take no more, and wait for the packet that is being fetched."""
        self._is_closing = True
        self._thread.join()

    def _take(self) -> None:
        try:
            while not self._is_closing:
                asked_s = self._clock()
                fetched = self._fetch()
                if fetched is None:
                    break
                self._put(Arrival(fetched, asked_s, self._clock()))
        finally:
            with self._changed:
                self._is_over = True
                self._changed.notify()

    def _put(self, arrival: Arrival) -> None:
        with self._changed:
            self._waiting.append(arrival)
            self._changed.notify()
