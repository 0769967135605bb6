"""The `Line`: an open port together with the packets written into it. It makes sure that no position fix leaves late
from a buffer, be it ours or that of the operating system. Used by `link`."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress

from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.ports import Port
from edgevpr.mavlink.wire import Tap, untapped

LOST = "the link was lost before it had left"
STUCK_S = 0.5  # a port that has accepted no byte for this time is reopened: bytes that wait in it would leave late


class Line:
    """Writes packets to a port, one after another.

    A fix counts as sent when all its bytes have left the operating system (over TCP: when the other end has confirmed
    them). If that has not happened by the fix's `Sending.due_s`, `departed` raises ConnectionError; closing the port
    then throws the bytes away. `tap` is called with each packet that the port has accepted in full. `unsent` are the
    bytes of the last packet that the port has not accepted yet.
    """

    def __init__(self, port: Port, clock: Callable[[], float], tap: Tap = untapped) -> None:
        self.port = port
        self._tap = tap
        self._clock = clock
        self._packet = self.unsent = b""
        self._taken = 0  # number of bytes that the port has accepted so far
        self._leaving: deque[tuple[int, Sending]] = deque()  # fixes not sent yet; `_taken` at their last byte
        self._blocked_since_s: float | None = None

    @property
    def is_watched(self) -> bool:
        """True while a fix given to `put` has not left the operating system: the link must then look often whether it
        has, and whether it is late."""
        return bool(self._leaving)

    @property
    def is_idle(self) -> bool:
        """True if every byte has left the operating system."""
        return not self.unsent and self.port.unsent() == 0

    def put(self, packet: bytes, sending: Sending | None) -> None:
        """Set the next packet to be written, and `sending`, the fix that it contains (None: it contains none). The port
        must have accepted the previous packet in full."""
        self._packet = self.unsent = packet
        if sending:
            self._leaving.append((self._taken + len(packet), sending))

    def write(self) -> None:
        """Write as much of the packet as the port accepts without blocking. Raises OSError if the connection is lost,
        and if the port has accepted no byte for STUCK_S seconds."""
        if not self.unsent:
            return
        taken = self.port.write(self.unsent)
        self.unsent = self.unsent[taken:]
        self._taken += taken
        if not self.unsent:
            self._tap(self._packet)
        if taken:
            self._blocked_since_s = None
        elif self._blocked_since_s is None:
            self._blocked_since_s = self._clock()
        elif self._clock() - self._blocked_since_s > STUCK_S:
            raise ConnectionError("the port takes no more bytes")

    def departed(self) -> list[Sending]:
        """Return the fixes that have left the operating system since the last call, and mark them as sent. Raises
        ConnectionError if none has left and the oldest one is past its `due_s`."""
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
        """Close the port, throw away all bytes that have not left, mark their fixes as not sent, and return the number
        of these fixes."""
        with suppress(OSError):
            if not self.is_idle:
                self.port.throw_away()
        self.port.close()
        for _, sending in self._leaving:
            sending.settle(False, LOST)
        return len(self._leaving)
