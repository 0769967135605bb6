"""The conversation with the autopilot: what is said next, and what the answers mean. It knows no port and no thread."""

import logging
import math
import struct
from collections import Counter
from collections.abc import Callable

from edgevpr.mavlink import messages
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.answers import Answers
from edgevpr.mavlink.messages import Health, Severity
from edgevpr.mavlink.outbox import Outbox, Sending
from edgevpr.mavlink.peer import Autopilot
from edgevpr.mavlink.signing import NOT_SIGNING, NotSigning, Signing
from edgevpr.mavlink.wire import Message, Receiver, mavlink

HEARTBEAT_S = 1.0
HEALTH_GOOD_FOR_S = 10.0  # a hung main loop must not look healthy because the link's thread still runs
ASK_AGAIN_S = 5.0

log = logging.getLogger(__name__)


class Conversation:
    """Packets to be sent, one after another, and the messages that arrive. It holds the `outbox` of what waits, the
    state of the `autopilot`, the row of `answers` to our fixes, and the count of messages `sent`.

    `set_health` and `want_position` may be called from any thread, all else from that of the link.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        component_id: int,
        system_id: int | None,
        max_fix_age_s: float,
        *,
        signing: Signing | NotSigning = NOT_SIGNING,
    ) -> None:
        self.outbox = Outbox(max_fix_age_s)
        self.autopilot = Autopilot(component_id, system_id)
        self.answers = Answers()
        self.signing = signing
        self.receiver = Receiver(self.signing.admits)
        self.sent: Counter[str] = Counter()
        self.component_id = component_id
        self._clock = clock
        self._health, self._health_set_s = Health.BOOT, clock()
        self._packer = mavlink.MAVLink(None, srcSystem=system_id or 1, srcComponent=component_id)
        self._last_sent: Sending | None = None
        self._heartbeat_due_s = clock()
        self._ask_position_s: float | None = None  # when to ask next; None: not wanted

    def set_health(self, health: Health) -> None:
        """Set the health in the heartbeats of the next ten seconds. After that, without a new call, it is CRITICAL."""
        self._health, self._health_set_s = health, self._clock()

    def want_position(self) -> None:
        """Ask the autopilot for its position, how well it knows it, attitude and height, at once and again whenever it
        has stopped reporting its position or its attitude."""
        self._ask_position_s = self._clock()

    def next_packet(self) -> tuple[bytes, Sending | None] | None:
        """Choose and pack the next message; return it with the fix in it, if it holds one. None: there is none."""
        while (chosen := self._next_message(self._clock())) is not None:
            message, sending = chosen
            self.signing.stamp(self._packer)
            try:
                packet = message.pack(self._packer)
            except (struct.error, OverflowError) as error:  # a value that its field cannot hold must not end the link
                log.error("%s is not sent: %s", message, error)
                if sending:
                    sending.settle(False, f"it does not fit its message ({error})")
                continue
            self._packer.seq = (self._packer.seq + 1) % 256
            if sending:
                self.answers.note_sent(self._clock())
            else:
                self.sent[message.get_type()] += 1
            return packet, sending
        return None

    def note_departed(self, fixes: list[Sending]) -> None:
        """Note the fixes that have left. This comes before `hear` takes in the answer to one of them."""
        for self._last_sent in fixes:
            self.sent["COMMAND_INT"] += 1

    def hear(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        """Take in bytes that arrived from `sender` (None: there is only one); return True where they hold a heartbeat
        of the autopilot."""
        is_ours = False
        for message in self.receiver.feed(data, sender):
            if self.autopilot.hear(message, now_s, sender):
                is_ours = True
                self._packer.srcSystem = self.autopilot.system_id
                if news := self.autopilot.identity.take_news():
                    self.answers, self._last_sent = Answers(), None  # those of another
                    self._announce(Severity.WARNING, news)
            if answer := self.autopilot.take_answer():
                self.answers.note_answer(now_s)
                if self._last_sent:
                    self._last_sent.answer = answer  # an answer names no fix: it is taken for the last one sent
                    if answer == "ACCEPTED":
                        self.autopilot.certainty.note_known(self._last_sent.fix.accuracy_m, now_s)
        return is_ours

    def tell_of_answers(self) -> None:
        """Say once to the ground that fixes have no answers any more, or have them again."""
        if news := self.answers.news(self._clock()):
            self._announce(Severity.WARNING if self.answers.is_stopped else Severity.INFO, news)

    def break_off(self, lost_fixes: int) -> None:
        """Forget what ends with the port, with which so many fixes were thrown away."""
        self.answers.note_lost(lost_fixes)
        self.autopilot.forget_presence()
        self.receiver.forget_partial_message()

    def _next_message(self, now_s: float) -> tuple[Message, Sending | None] | None:
        """Return the message that is next and the fix in it, if it holds one; None: there is no message."""
        late_s = now_s - self._heartbeat_due_s
        if late_s >= 0:
            self._heartbeat_due_s = now_s + HEARTBEAT_S - late_s % HEARTBEAT_S  # keeps the rhythm after missed beats
            stuck = now_s - self._health_set_s > HEALTH_GOOD_FOR_S
            return messages.heartbeat(Health.CRITICAL if stuck else self._health), None
        if self.autopilot.listens(now_s):
            self._ask_for_position(now_s)
            if why := self.answers.why_not(now_s):
                self.outbox.withhold_fixes(why)
            elif sending := self.outbox.next_fix(now_s):
                return messages.position_fix(sending.fix, now_s, self.autopilot.system_id), sending
        else:
            self.outbox.drop_stale_fixes(now_s)
        message = self.outbox.next_message()
        return message and (message, None)

    def _ask_for_position(self, now_s: float) -> None:
        """Ask again where no reports came: an autopilot that has restarted has forgotten the request."""
        if self._ask_position_s is None or now_s < self._ask_position_s:
            return
        self._ask_position_s = now_s + ASK_AGAIN_S
        vehicle = self.autopilot.vehicle
        heard_s = min(vehicle.t_heard_s if vehicle else -math.inf, self.autopilot.attitudes.t_heard_s)
        if now_s - heard_s > ASK_AGAIN_S:
            for request in messages.report_requests(self.autopilot.system_id, self.autopilot.firmware):
                self.outbox.put(request)

    def _announce(self, severity: Severity, text: str) -> None:
        self.outbox.put(messages.status_text(severity, f"edgevpr: {text}"))
