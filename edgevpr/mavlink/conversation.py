"""The conversation with the autopilot: what is said next, and what the answers mean. It knows no port and no thread."""

import logging
import math
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from edgevpr.mavlink import messages
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.answers import TRIED_AGAIN_AFTER_S, Answers
from edgevpr.mavlink.messages import Health, Severity
from edgevpr.mavlink.outbox import Outbox, Sending
from edgevpr.mavlink.peer import Autopilot
from edgevpr.mavlink.reasons import why_silent
from edgevpr.mavlink.replies import Replies
from edgevpr.mavlink.wire import Message, Receiver, mavlink
from edgevpr.types import Vehicle

HEARTBEAT_S = 1.0
HEALTH_GOOD_FOR_S = 10.0  # a hung main loop must not look healthy because the link's thread still runs
ASK_AGAIN_S = 5.0

log = logging.getLogger(__name__)


class Conversation:
    """Packets to be sent, one after another, and the messages that arrive. It holds the `outbox` of what waits, the
    state of the `autopilot`, the fixes that wait for `replies`, the row of those without `answers`, and the count of
    messages `sent`.

    `set_health`, `want_position` and `vehicle_at` may be called from any thread, all else from that of the link.
    """

    def __init__(
        self, clock: Callable[[], float], component_id: int, system_id: int | None, max_fix_age_s: float
    ) -> None:
        self.outbox = Outbox(max_fix_age_s)
        self.autopilot = Autopilot(component_id, system_id)
        self.answers, self.replies = Answers(), Replies()
        self.receiver = Receiver()
        self.sent: Counter[str] = Counter()
        self._clock = clock
        self._health, self._health_set_s = Health.BOOT, clock()
        self._packer = mavlink.MAVLink(None, srcSystem=system_id or 1, srcComponent=component_id)
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
            try:
                packet = message.pack(self._packer)
            except (struct.error, OverflowError) as error:  # a value that its field cannot hold must not end the link
                log.error("%s is not sent: %s", message, error)
                if sending:
                    sending.settle(False, f"it does not fit its message ({error})")
                continue
            self._packer.seq = (self._packer.seq + 1) % 256
            if sending:
                self.answers.note_sent(now_s := self._clock())
                self.replies.note_sent(sending, now_s)
            else:
                self.sent[message.get_type()] += 1
            return packet, sending
        return None

    def note_departed(self, fixes: list[Sending]) -> None:
        """Note the fixes that have left. This comes before `hear` takes in the answer to one of them."""
        self.sent["COMMAND_INT"] += len(fixes)

    def hear(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        """Take in bytes that arrived from `sender` (None: there is only one); return True where they hold a heartbeat
        of the autopilot."""
        is_ours = False
        for message in self.receiver.feed(data, sender):
            if self.autopilot.hear(message, now_s, sender):
                is_ours = True
                self._packer.srcSystem = self.autopilot.system_id
                if news := self.autopilot.identity.take_news():
                    self.answers = Answers()  # those of another
                    self.replies.break_off("another autopilot has taken its place")
                    self._announce(Severity.WARNING, news)
            if answer := self.autopilot.take_answer():
                self._hear_answer(answer, now_s)
        return is_ours

    def tell_of_answers(self) -> None:
        """Give up the fixes that have waited too long for their answers, and say once to the ground that fixes have no
        answers any more, or have them again, or are refused, or taken again."""
        now_s = self._clock()
        self.replies.time_out(now_s)
        if self.answers.has_changed(now_s):
            self._say_silence(now_s)
        if news := self.replies.take_news():
            is_alarming, text = news
            self._announce(Severity.WARNING if is_alarming else Severity.INFO, text)

    def vehicle_at(self, t_mono_s: float) -> Vehicle | None:
        """Return the autopilot's last report, with its attitude at the time of a frame, and the time of the newest fix
        that may be in its position."""
        vehicle = self.autopilot.vehicle_at(t_mono_s)
        return vehicle and replace(vehicle, t_fix_s=self.replies.t_fix_s)

    def break_off(self, lost_fixes: int) -> None:
        """Forget what ends with the port, with which so many fixes were thrown away."""
        self.answers.note_lost(lost_fixes)
        self.replies.break_off("the link was lost before its answer came")
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

    def _hear_answer(self, answer: str, now_s: float) -> None:
        self.answers.note_answer(now_s)
        readiness = self.autopilot.readiness
        sending = self.replies.hear(answer, readiness.state(now_s), now_s)
        if sending and answer == "ACCEPTED":
            self.autopilot.certainty.note_known(sending.fix.accuracy_m, now_s)
        if answer == "FAILED" and readiness.asks_origin(now_s):
            self.outbox.put(messages.origin_request(self.autopilot.system_id))

    def _say_silence(self, now_s: float) -> None:
        if self.answers.is_stopped:
            reason = why_silent(self.autopilot.readiness.state(now_s))
            log.warning(
                "five fixes in a row had no answer, and only one every %g s is sent until one is answered: %s",
                TRIED_AGAIN_AFTER_S,
                reason.sentence,
            )
            self._announce(Severity.WARNING, f"fixes unanswered: {reason.brief}")
        else:
            log.warning("position fixes are answered again: they are sent again")
            self._announce(Severity.INFO, "fixes are answered again")

    def _announce(self, severity: Severity, text: str) -> None:
        self.outbox.put(messages.status_text(severity, f"edgevpr: {text}"))
