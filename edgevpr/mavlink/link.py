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

from edgevpr.errors import LinkError
from edgevpr.mavlink import messages
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.answers import Answers
from edgevpr.mavlink.line import Line
from edgevpr.mavlink.messages import Fix, Health, Severity
from edgevpr.mavlink.outbox import MAX_FIX_WAIT_S, Outbox, Sending
from edgevpr.mavlink.peer import Autopilot
from edgevpr.mavlink.stats import LinkStats
from edgevpr.mavlink.transport import open_transport
from edgevpr.mavlink.wire import Message, Receiver, mavlink
from edgevpr.types import Vehicle

HEARTBEAT_S = 1.0
TURN_S = 0.25  # longest sleep of the thread when nothing wakes it
RETRY_FIRST_S, RETRY_MAX_S = 0.2, 2.0
HEALTH_GOOD_FOR_S = 10.0  # a hung main loop must not look healthy because this thread still runs
ASK_AGAIN_S = 5.0
WATCH_S = 0.01  # between two looks whether a fix has left
FLUSH_S = 0.5

log = logging.getLogger(__name__)


class Link:
    """The link to one flight controller. It sends the queued messages and one heartbeat a second, listens, and reopens
    the port after every loss of the other end.

    `system_id` is that of the autopilot (None: that of the first heard); a fix that has waited for `max_fix_age_s` is
    never sent. `send`, `send_fix`, `set_health`, `want_position`, `vehicle`, `listens` and `stats` may be called from
    any thread; they never block and never raise.
    """

    def __init__(
        self,
        address: LinkAddress,
        component_id: int = 197,
        clock: Callable[[], float] = time.monotonic,
        *,
        system_id: int | None = None,
        max_fix_age_s: float = MAX_FIX_WAIT_S,
    ) -> None:
        self._address = address
        self._clock = clock
        self._health, self._health_set_s = Health.BOOT, clock()
        self._outbox = Outbox(max_fix_age_s)
        self._autopilot = Autopilot(component_id, system_id)
        self._answers = Answers()
        self._receiver = Receiver()
        self._packer = mavlink.MAVLink(None, srcSystem=system_id or 1, srcComponent=component_id)
        self._line: Line | None = None
        self._last_sent: Sending | None = None
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
            self._line = Line(open_transport(self._address), self._clock)
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
        """Queue a position fix, to be sent within `max_fix_age_s` and only to an autopilot that is there, or never. The
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
        return self._is_connected() and self._autopilot.listens(self._clock())

    def stats(self) -> LinkStats:
        return LinkStats(
            connected=self._is_connected(),
            trouble=self._trouble,
            autopilot_heard=self._autopilot.listens(self._clock()),
            autopilot_system_id=self._autopilot.system_id,
            sent=dict(self._sent),
            received=dict(self._receiver.received),
            acks=dict(self._autopilot.acks),
            dropped_stale_fixes=self._outbox.dropped_stale_fixes,
            withheld_fixes=self._outbox.withheld_fixes,
            foreign_messages=self._autopilot.identity.foreign_messages,
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

    def _is_connected(self) -> bool:
        line = self._line
        return line is not None and line.transport.connected

    # The methods below run in the link's own thread.

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                if self._line is None:
                    self._reopen()
                else:
                    self._turn(self._line, timeout_s=TURN_S)
            except (OSError, LinkError) as error:
                self._lose(error)
            except Exception as error:  # a flight without a link is worse than one with a link opened anew
                log.exception("the link failed")
                self._lose(error)
        self._flush()
        self._close_all()

    def _reopen(self) -> None:
        if self._closing.wait(self._retry_s):
            return
        self._retry_s = min(2 * self._retry_s, RETRY_MAX_S)
        self._outbox.drop_stale_fixes(self._clock())
        self._line = Line(open_transport(self._address), self._clock)
        self._reopened += 1

    def _turn(self, line: Line, timeout_s: float) -> None:
        """Write what the port takes, wait until there is something to do or the time is up, and read."""
        if line.transport.connected:
            self._transmit(line)
        if news := self._answers.news(self._clock()):
            self._announce(Severity.WARNING if self._answers.is_stopped else Severity.INFO, news)
        writing = [line.transport] if line.is_writing else []
        timeout_s = min(timeout_s, WATCH_S) if line.is_watched else timeout_s
        readable, _, _ = select.select([line.transport, self._bell], writing, [], timeout_s)
        if self._bell in readable:
            self._bell.recv(4096)
        if line.transport in readable:
            self._receive(line)

    def _receive(self, line: Line) -> None:
        data = line.transport.read()
        if data:
            self._retry_s = RETRY_FIRST_S
            if self._trouble is not None:
                log.info("%s is back", self._address)
                self._trouble = None
        self._note_departed(line)  # before its answer is read
        now_s, sender = self._clock(), line.transport.sender
        for message in self._receiver.feed(data, sender):
            if self._autopilot.hear(message, now_s, sender):
                self._packer.srcSystem = self._autopilot.system_id
                line.transport.answer_sender()
                if news := self._autopilot.identity.take_news():
                    self._answers, self._last_sent = Answers(), None  # those of another
                    self._announce(Severity.WARNING, news)
            if answer := self._autopilot.take_answer():
                self._answers.note_answer(now_s)
                if self._last_sent:
                    self._last_sent.answer = answer  # an answer names no fix: it is taken for the last one sent

    def _transmit(self, line: Line) -> None:
        while True:
            self._note_departed(line)  # before writing: what has waited too long must not be written on
            if not line.is_writing and not self._put_next(line):
                return
            line.write()
            if line.is_writing:
                return

    def _note_departed(self, line: Line) -> None:
        for self._last_sent in line.departed():
            self._sent["COMMAND_INT"] += 1

    def _put_next(self, line: Line) -> bool:
        """Choose the next message, pack it and put it on the line; return False where there is none."""
        while (chosen := self._next_message(self._clock())) is not None:
            message, sending = chosen
            try:
                packet = message.pack(self._packer)
            except (struct.error, OverflowError) as error:  # a value that its field cannot hold must not end the link
                log.error("%s is not sent: %s", message, error)
                if sending:
                    sending.settle(False, f"it does not fit its message ({error})")
                continue
            self._packer.seq = (self._packer.seq + 1) % 256
            line.put(packet, sending)
            if sending:
                self._answers.note_sent(self._clock())
            else:
                self._sent[message.get_type()] += 1
            return True
        return False

    def _next_message(self, now_s: float) -> tuple[Message, Sending | None] | None:
        """Return the message that is next and the fix in it, if it holds one; None: there is no message."""
        late_s = now_s - self._heartbeat_due_s
        if late_s >= 0:
            self._heartbeat_due_s = now_s + HEARTBEAT_S - late_s % HEARTBEAT_S  # keeps the rhythm after missed beats
            stuck = now_s - self._health_set_s > HEALTH_GOOD_FOR_S
            return messages.heartbeat(Health.CRITICAL if stuck else self._health), None
        if self._autopilot.listens(now_s):
            self._ask_for_position(now_s)
            if why := self._answers.why_not(now_s):
                self._outbox.withhold_fixes(why)
            elif sending := self._outbox.next_fix(now_s):
                return messages.position_fix(sending.fix, now_s, self._autopilot.system_id), sending
        else:
            self._outbox.drop_stale_fixes(now_s)
        message = self._outbox.next_message()
        return message and (message, None)

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
        if self._line is not None:
            self._answers.note_lost(self._line.close())
            self._line = None
        self._autopilot.forget_presence()
        self._receiver.forget_partial_message()
        self._note_trouble(error)

    def _note_trouble(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or str(error)
        if reason != self._trouble:
            self._trouble = reason
            log.warning("%s is not there (%s); trying again", self._address, reason)

    def _announce(self, severity: Severity, text: str) -> None:
        self._outbox.put(messages.status_text(severity, f"edgevpr: {text}"))

    def _flush(self) -> None:
        give_up_s = time.monotonic() + FLUSH_S
        with suppress(OSError):
            while self._is_connected() and time.monotonic() < give_up_s:
                self._turn(self._line, timeout_s=0.01)
                if not self._outbox and self._line.is_idle and self._all_answered():
                    break

    def _all_answered(self) -> bool:
        """Tell whether as many answers came as fixes were sent, so that the final counts include all answers."""
        return self._autopilot.acks.total() >= self.stats().fixes_sent

    def _close_all(self) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None
        self._bell.close()
        self._bell_button.close()

    def _ring(self) -> None:
        with suppress(OSError):  # it rings already, or the link is closed
            self._bell_button.send(b"!")
