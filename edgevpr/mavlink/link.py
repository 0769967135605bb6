"""The link to the flight controller: one thread, the only one to touch the socket or serial port."""

import logging
import select
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from edgevpr.errors import LinkError
from edgevpr.mavlink import messages
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.messages import Fix, Health
from edgevpr.mavlink.outbox import Outbox, Sending
from edgevpr.mavlink.peer import Autopilot
from edgevpr.mavlink.transport import Transport, open_transport
from edgevpr.mavlink.wire import Message, Receiver, mavlink
from edgevpr.types import Vehicle

HEARTBEAT_S = 1.0
TURN_S = 0.25  # longest sleep of the thread when nothing wakes it
RETRY_FIRST_S, RETRY_MAX_S = 0.2, 2.0
HEALTH_GOOD_FOR_S = 10.0  # a hung main loop must not look healthy because this thread still runs
ASK_AGAIN_S = 5.0
STUCK_S = 0.5  # a port that has taken no byte for this time is reopened: bytes that wait in it would leave late
FLUSH_S = 0.5

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counts and state of a link. `trouble` is the reason why it is or last was not open, None once data arrives."""

    connected: bool
    trouble: str | None
    autopilot_heard: bool
    autopilot_system_id: int | None
    sent: dict[str, int]
    received: dict[str, int]
    acks: dict[str, int]
    dropped_stale_fixes: int
    dropped_queue_full: int
    bad_bytes: int
    reopened: int

    @property
    def fixes_sent(self) -> int:
        """Number of position fixes sent."""
        return self.sent.get("COMMAND_INT", 0)


class Link:
    """The link to one flight controller. It sends the queued messages and one heartbeat a second, listens, and reopens
    the port after every loss of the other end.

    `send`, `send_fix`, `set_health`, `want_position`, `vehicle`, `listens` and `stats` may be called from any thread;
    they never block and never raise.
    """

    def __init__(self, address: LinkAddress, component_id: int = 197, clock: Callable[[], float] = time.monotonic):
        self._address = address
        self._clock = clock
        self._health, self._health_set_s = Health.BOOT, clock()
        self._outbox = Outbox()
        self._autopilot = Autopilot(component_id)
        self._receiver = Receiver()
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=component_id)
        self._transport: Transport | None = None
        self._unsent = b""  # the rest of a message that the port has taken only in part
        self._sending: Sending | None = None  # the fix in `_unsent`, if it holds one
        self._last_sent: Sending | None = None
        self._blocked_since_s: float | None = None
        self._heartbeat_due_s = clock()
        self._ask_position_s: float | None = None  # when to ask next; None: not wanted
        self._sent: Counter[str] = Counter()
        self._reopened = 0
        self._retry_s = RETRY_FIRST_S
        self._trouble: str | None = None
        self._closing = threading.Event()
        self._bell, self._bell_button = socket.socketpair()  # wakes the thread when there is something to send
        self._bell_button.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def start(self) -> None:
        """Open the port and start the thread.

        Raises LinkError for a fault that the user must correct. A missing device or server is no error: the link tries
        to open it again and again, and `stats` gives the reason.
        """
        try:
            self._transport = open_transport(self._address)
        except OSError as error:
            self._note_trouble(error)
        except LinkError:
            self.close()
            raise
        self._thread.start()

    def send(self, *outgoing: Message) -> None:
        """Queue messages. If the queue is full, the oldest messages are dropped and counted."""
        for message in outgoing:
            self._outbox.put(message)
        self._ring()

    def send_fix(self, fix: Fix) -> Sending:
        """Queue a position fix, to be sent within one second and only to an autopilot that is there, or never. The
        returned `Sending` gives the outcome as soon as it is known."""
        sending = self._outbox.put_fix(fix, self._clock())
        self._ring()
        return sending

    def set_health(self, health: Health) -> None:
        """Set the health in the heartbeats of the next ten seconds. After that, without a new call, it is CRITICAL."""
        self._health, self._health_set_s = health, self._clock()

    def want_position(self) -> None:
        """Ask the autopilot for its position, at once and again whenever it has stopped reporting it."""
        self._ask_position_s = self._clock()

    def vehicle(self) -> Vehicle | None:
        """Return the last report of the autopilot on its vehicle; None where there is none, or it had no position."""
        return self._autopilot.vehicle

    def listens(self) -> bool:
        """Tell whether there is an autopilot that a fix can be sent to at this moment."""
        transport = self._transport
        return transport is not None and transport.connected and self._autopilot.listens(self._clock())

    def stats(self) -> LinkStats:
        transport = self._transport
        return LinkStats(
            connected=transport is not None and transport.connected,
            trouble=self._trouble,
            autopilot_heard=self._autopilot.listens(self._clock()),
            autopilot_system_id=self._autopilot.system_id,
            sent=dict(self._sent),
            received=dict(self._receiver.received),
            acks=dict(self._autopilot.acks),
            dropped_stale_fixes=self._outbox.dropped_stale_fixes,
            dropped_queue_full=self._outbox.dropped_queue_full,
            bad_bytes=self._receiver.bad_bytes,
            reopened=self._reopened,
        )

    def close(self) -> None:
        """Send the queued messages, receive the answers to the fixes sent, both for half a second at most, and close
        the port."""
        self._closing.set()
        self._ring()
        if self._thread.ident is None:  # never started
            self._close_all()
        else:
            self._thread.join(2 * FLUSH_S)

    def __enter__(self) -> "Link":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # The methods below run in the link's own thread.

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                if self._transport is None:
                    self._reopen()
                else:
                    self._turn(self._transport, timeout_s=TURN_S)
            except (OSError, LinkError) as error:
                self._lose(error)
        self._flush()
        self._close_all()

    def _reopen(self) -> None:
        if self._closing.wait(self._retry_s):
            return
        self._retry_s = min(2 * self._retry_s, RETRY_MAX_S)
        self._outbox.drop_stale_fixes(self._clock())
        self._transport = open_transport(self._address)
        self._reopened += 1

    def _turn(self, transport: Transport, timeout_s: float) -> None:
        """Write what the port takes, wait until there is something to do or the time is up, and read."""
        if transport.connected:
            self._transmit(transport)
        writing = [transport] if self._unsent else []
        readable, _, _ = select.select([transport, self._bell], writing, [], timeout_s)
        if self._bell in readable:
            self._bell.recv(4096)
        if transport in readable:
            self._receive(transport)

    def _receive(self, transport: Transport) -> None:
        data = transport.read()
        if data:
            self._retry_s = RETRY_FIRST_S
            if self._trouble is not None:
                log.info("%s is back", self._address)
                self._trouble = None
        now_s = self._clock()
        for message in self._receiver.feed(data):
            if self._autopilot.hear(message, now_s):
                self._packer.srcSystem = self._autopilot.system_id
                transport.answer_sender()
            if self._last_sent and (answer := self._autopilot.take_answer()):
                self._last_sent.answer = answer  # an answer names no fix: it is taken for the last one sent

    def _transmit(self, transport: Transport) -> None:
        while self._unsent or self._pack_next():
            taken = transport.write(self._unsent)
            self._unsent = self._unsent[taken:]
            if taken:
                self._blocked_since_s = None
                if self._sending and not self._unsent:
                    self._sending.settle(True)
                    self._last_sent, self._sending = self._sending, None
            elif self._blocked_since_s is None:
                self._blocked_since_s = self._clock()
            elif self._clock() - self._blocked_since_s > STUCK_S:
                raise ConnectionError("the port takes no more bytes")
            if self._unsent:
                return

    def _pack_next(self) -> bool:
        """Choose the next message and pack it; return False where there is none."""
        while (message := self._next_message(self._clock())) is not None:
            try:
                self._unsent = message.pack(self._packer)
            except (struct.error, OverflowError) as error:  # a value that its field cannot hold must not end the link
                log.error("%s is not sent: %s", message, error)
                if self._sending:
                    self._sending.settle(False, f"it does not fit its message ({error})")
                    self._sending = None
                continue
            self._packer.seq = (self._packer.seq + 1) % 256
            self._sent[message.get_type()] += 1
            return True
        return False

    def _next_message(self, now_s: float) -> Message | None:
        late_s = now_s - self._heartbeat_due_s
        if late_s >= 0:
            self._heartbeat_due_s = now_s + HEARTBEAT_S - late_s % HEARTBEAT_S  # keeps the rhythm after missed beats
            stuck = now_s - self._health_set_s > HEALTH_GOOD_FOR_S
            return messages.heartbeat(Health.CRITICAL if stuck else self._health)
        if self._autopilot.listens(now_s):
            self._ask_for_position(now_s)
            self._sending = self._outbox.next_fix(now_s)
            if self._sending is not None:
                return messages.position_fix(self._sending.fix, now_s, self._autopilot.system_id)
        else:
            self._outbox.drop_stale_fixes(now_s)
        return self._outbox.next_message()

    def _ask_for_position(self, now_s: float) -> None:
        """Ask for positions again where none came: an autopilot that has restarted has forgotten the request."""
        if self._ask_position_s is None or now_s < self._ask_position_s:
            return
        self._ask_position_s = now_s + ASK_AGAIN_S
        vehicle = self._autopilot.vehicle
        if vehicle is None or now_s - vehicle.t_heard_s > ASK_AGAIN_S:
            for request in messages.position_requests(self._autopilot.system_id):
                self._outbox.put(request)

    def _lose(self, error: Exception) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._unsent = b""
        if self._sending:
            self._sending.settle(False, "the link was lost before it had left")
            self._sending = None
        self._blocked_since_s = None
        self._receiver.forget_partial_message()
        self._note_trouble(error)

    def _note_trouble(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or str(error)
        if reason != self._trouble:
            self._trouble = reason
            log.warning("%s is not there (%s); trying again", self._address, reason)

    def _flush(self) -> None:
        give_up_s = time.monotonic() + FLUSH_S
        with suppress(OSError):
            while self._transport is not None and self._transport.connected and time.monotonic() < give_up_s:
                self._turn(self._transport, timeout_s=0.01)
                if not self._outbox and not self._unsent and self._transport.idle() and self._all_answered():
                    break

    def _all_answered(self) -> bool:
        """Tell whether as many answers came as fixes were sent, so that the final counts include all answers."""
        return self._autopilot.acks.total() >= self.stats().fixes_sent

    def _close_all(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._bell.close()
        self._bell_button.close()

    def _ring(self) -> None:
        with suppress(OSError):  # it rings already, or the link is closed
            self._bell_button.send(b"!")
