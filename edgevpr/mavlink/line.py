"""An open port, and what was written into it: no fix leaves a buffer late, be it ours or the system's."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress

from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.ports import Port
from edgevpr.mavlink.wire import Tap, untapped

LOST = "the link was lost before it had left"
STUCK_S = 0.5  # a port that has taken no byte for this time is reopened: bytes that wait in it would leave late


class Line:
    """A port into which one packet after another is written.

    A fix counts as sent when its bytes have left the system (over TCP: when the other end has confirmed them). One that
    has not left when it is due makes the line fail: the bytes are thrown away with the port. `tap` gets each
    packet that the port has taken in full.
    """

    def __init__(self, port: Port, clock: Callable[[], float], tap: Tap = untapped) -> None:
        self.port = port
        self._tap = tap
        self._clock = clock
        self._packet = b""  # the last one put
        self._unsent = b""  # the rest of it, where the port has not taken it in full
        self._taken = 0  # bytes that the port has taken so far
        self._leaving: deque[tuple[int, Sending]] = deque()  # fixes on their way out, and where in the bytes each ends
        self._blocked_since_s: float | None = None

    @property
    def is_writing(self) -> bool:
        """True where a packet is not yet taken in full."""
        return bool(self._unsent)

    @property
    def is_watched(self) -> bool:
        """True where a fix is on its way out."""
        return bool(self._leaving)

    @property
    def is_idle(self) -> bool:
        """True where every byte has left."""
        return not self._unsent and self.port.unsent() == 0

    def put(self, packet: bytes, sending: Sending | None) -> None:
        """Take the next packet, with the fix in it if it holds one. The packet before must have been taken in full."""
        self._packet = self._unsent = packet
        if sending:
            self._leaving.append((self._taken + len(packet), sending))

    def write(self) -> None:
        """Write what the port takes at once. Raises OSError where the connection is lost, or takes nothing for long."""
        if not self._unsent:
            return
        taken = self.port.write(self._unsent)
        self._unsent = self._unsent[taken:]
        self._taken += taken
        if not self._unsent:
            self._tap(self._packet)
        if taken:
            self._blocked_since_s = None
        elif self._blocked_since_s is None:
            self._blocked_since_s = self._clock()
        elif self._clock() - self._blocked_since_s > STUCK_S:
            raise ConnectionError("the port takes no more bytes")

    def departed(self) -> list[Sending]:
        """Return the fixes that have left since the last call, settled as sent. Raises ConnectionError where there are
        none, and one has waited too long."""
        departed = []
        # Read before the bytes are asked for: a clock that jumps meanwhile must not condemn what has just left.
        now_s = self._clock()
        left = self._taken - self.port.unsent() if self._leaving else 0
        while self._leaving and self._leaving[0][0] <= left:
            departed.append(self._leaving.popleft()[1])
            departed[-1].settle(True)
        if not departed and self._leaving and now_s > self._leaving[0][1].due_s:
            raise ConnectionError("a position fix has waited too long in it")
        return departed

    def close(self) -> int:
        """Close the port, throw away what has not left, and return the number of fixes in it."""
        with suppress(OSError):
            if not self.is_idle:
                self.port.throw_away()
        self.port.close()
        lost = len(self._leaving)
        for _, sending in self._leaving:
            sending.settle(False, LOST)
        self._leaving.clear()
        self._unsent = b""
        return lost
