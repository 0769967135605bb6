"""The conversation with the autopilot: what is said next, and what the answers mean. It knows no port and no thread."""

import logging
import math
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from edgevpr.core.types import Position, Vehicle
from edgevpr.mavlink import messages, positions
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.answers import TRIED_AGAIN_AFTER_S, Answers
from edgevpr.mavlink.autopilots.channel import Channel
from edgevpr.mavlink.listener import Listener, NoListener
from edgevpr.mavlink.messages import Health, Severity
from edgevpr.mavlink.outbox import Outbox, Sending
from edgevpr.mavlink.peer import Autopilot
from edgevpr.mavlink.reasons import why_silent
from edgevpr.mavlink.replies import Replies
from edgevpr.mavlink.requests import Requests
from edgevpr.mavlink.signing import NOT_SIGNING, NotSigning, Signing
from edgevpr.mavlink.texts import Texts
from edgevpr.mavlink.wire import Message, Receiver, Tap, mavlink, untapped
from edgevpr.mavlink.wishes import Wishes

HEARTBEAT_S = 1.0
STATE_S = 0.1  # ArduPilot calls a receiver unhealthy whose positions come more than 215 ms apart
HEALTH_GOOD_FOR_S = 10.0  # a hung main loop must not look healthy because the link's thread still runs
ASK_AGAIN_S = 5.0
ORIGIN_WITHIN_S = 5.0  # an autopilot that has one tells it once a second when asked to

_NOBODY = NoListener()

log = logging.getLogger(__name__)


class Conversation:
    """Packets to be sent, one after another, and the messages that arrive. It holds the `outbox` of what waits, the
    state of the `autopilot`, the fixes that wait for `replies`, the row of those without `answers`, the `texts` for the
    ground, the `requests` to us and the `wishes` among them, and the count of messages `sent`.

    `set_health`, `want_position`, `vehicle_at`, `texts` and `wishes` may be used from any thread, all else from that of
    the link.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        component_id: int,
        system_id: int | None,
        max_fix_age_s: float,
        *,
        listener: Listener = _NOBODY,
        tap: Tap = untapped,
        signing: Signing | NotSigning = NOT_SIGNING,
        origin: Position | None = None,
    ) -> None:
        self.outbox = Outbox(max_fix_age_s)
        self._origin = origin  # for an autopilot that has none
        self.autopilot = Autopilot(component_id, system_id, listener)
        self._listener = listener
        self.answers, self.replies = Answers(), Replies()
        self.texts, self.wishes = Texts(), Wishes()
        self.requests = Requests(self.wishes)
        self.signing = signing
        self.receiver = Receiver(signing.admits, tap=tap)
        self.sent: Counter[str] = Counter()
        self.component_id = component_id
        self._clock = clock
        self._health, self._health_set_s = Health.BOOT, clock()
        self._packer = mavlink.MAVLink(None, srcSystem=system_id or 1, srcComponent=component_id)
        self._heartbeat_due_s = self._state_due_s = clock()
        self._ask_position_s: float | None = None  # when to ask next; None: not wanted
        self._asked_for_state = False
        self._channel = self.channel  # as the listener has heard it
        self._odometry_since_s = math.inf
        self._is_there = self._was_there = False

    def set_health(self, health: Health) -> None:
        """Set the health in the heartbeats of the next ten seconds. After that, without a new call, it is CRITICAL."""
        self._health, self._health_set_s = health, self._clock()

    def want_position(self) -> None:
        """Ask the autopilot for its position, how well it knows it, attitude and height, at once and again whenever it
        has stopped reporting its position or its attitude."""
        self._ask_position_s = self._clock()

    @property
    def channel(self) -> Channel:
        """The channel by which the autopilot is told positions."""
        return self.autopilot.interview.choice.channel

    def wait_s(self, longest_s: float) -> float:
        """Return how long the link may sleep, so long at most, until there is something to say."""
        if not self.channel.is_continuous:
            return longest_s
        return min(longest_s, max(0.0, self._state_due_s - self._clock()))

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
                now_s = self._clock()
                if message.get_type() == "COMMAND_INT":
                    self.answers.note_sent(now_s)
                    self.replies.note_sent(sending, now_s)
                else:
                    self.replies.note_unanswerable(sending, now_s)
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
                    self._announce(Severity.WARNING, news, "autopilot")
            if answer := self.autopilot.take_answer():
                self._hear_answer(answer, now_s)
            if not self.autopilot.identity.is_elsewhere(sender):
                self._hear_request(message, now_s)
        return is_ours

    def tell_of_answers(self) -> None:
        """Give up the fixes that have waited too long for their answers, and say once to the ground that the autopilot
        is silent, or back, and that fixes have no answers any more, or have them again, or are refused, or taken
        again."""
        now_s = self._clock()
        self._tell_of_presence(now_s)
        self.replies.time_out(now_s)
        if self.answers.has_changed(now_s):
            self._say_silence(now_s)
        if news := self.replies.take_news():
            is_alarming, text = news
            self._announce(Severity.WARNING if is_alarming else Severity.INFO, text, "fixes")

    def vehicle_at(self, t_mono_s: float) -> Vehicle | None:
        """Return the autopilot's last report, with its attitude at the time of a frame, and the time of the newest fix
        that may be in its position: a continuous position may be in it at any time."""
        vehicle = self.autopilot.vehicle_at(t_mono_s)
        t_fix_s = self._clock() if self.channel.is_continuous else self.replies.t_fix_s
        return vehicle and replace(vehicle, t_fix_s=t_fix_s)

    def break_off(self, lost_fixes: int) -> None:
        """Forget what ends with the port, with which so many fixes were thrown away."""
        self.answers.note_lost(lost_fixes)
        self.replies.break_off("the link was lost before its answer came")
        self.autopilot.forget_presence()
        self.receiver.forget_partial_message()

    def end(self) -> None:
        """Give up all fixes: those that wait for their answers, and those that wait to be sent."""
        self.replies.break_off("the flight ended before its answer came")
        self.outbox.drop_stale_fixes(math.inf)

    def _next_message(self, now_s: float) -> tuple[Message, Sending | None] | None:
        """Return the message that is next and the fix in it, if it holds one; None: there is no message."""
        late_s = now_s - self._heartbeat_due_s
        if late_s >= 0:
            self._heartbeat_due_s = now_s + HEARTBEAT_S - late_s % HEARTBEAT_S  # keeps the rhythm after missed beats
            return self._heartbeat(now_s), None
        if self.autopilot.listens(now_s):
            self._ask_for_position(now_s)
            if self.channel.is_continuous and (state := self._state(now_s)):
                return state, None
            if why := self.wishes.why_no_fix() or self.answers.why_not(now_s):
                self.outbox.withhold_fixes(why)
            elif sending := self.outbox.next_fix(now_s):
                if self.channel is Channel.SENSOR:
                    return positions.position_sensor(sending.fix, now_s), sending
                return messages.position_fix(sending.fix, now_s, self.autopilot.system_id), sending
        else:
            self.outbox.drop_stale_fixes(now_s)
        if text := self.texts.next(now_s):
            return text, None  # not by the outbox, of which the ground's link gets a copy: it has its own texts
        message = self.outbox.next_message()
        while message and not self.requests.admits(message, now_s):
            message = self.outbox.next_message()
        return message and (message, None)

    def _heartbeat(self, now_s: float) -> Message:
        stuck = now_s - self._health_set_s > HEALTH_GOOD_FOR_S
        return messages.heartbeat(Health.CRITICAL if stuck else self._health)

    def _state(self, now_s: float) -> Message | None:
        """Make the next message of a continuous position, where it is due."""
        if now_s < self._state_due_s:
            return None
        self._state_due_s = max(self._state_due_s + STATE_S, now_s)
        choice, autopilot = self.autopilot.interview.choice, self.autopilot
        t_s = now_s - choice.lag_s
        state = self._listener.state_at(t_s)
        if choice.channel is Channel.GPS_INPUT:
            return positions.gps_input(state, choice.receiver, t_s, autopilot.unix_s(t_s))
        if autopilot.origin is None and self._origin and now_s - self._odometry_since_s > ORIGIN_WITHIN_S:
            log.warning("the autopilot has no origin: it is set to the first place of the map")
            here, self._origin = self._origin, None
            return messages.origin(autopilot.system_id, here.lat_deg, here.lon_deg, here.alt_m or 0.0)
        if state and state.attitude and autopilot.origin:
            return positions.odometry(state, autopilot.origin)
        return None

    def _ask_for_position(self, now_s: float) -> None:
        """Ask again where no reports came: an autopilot that has restarted has forgotten the request."""
        if self._ask_position_s is None:
            return
        for question in self.autopilot.interview.questions(now_s, self.autopilot.system_id):
            self.outbox.put(question)
        if self.channel is not self._channel:
            self._channel, self._odometry_since_s = self.channel, now_s
            self._listener.hear_channel(self._channel)
        if now_s < self._ask_position_s:
            return
        self._ask_position_s = now_s + ASK_AGAIN_S
        vehicle = self.autopilot.vehicle
        heard_s = min(vehicle.t_heard_s if vehicle else -math.inf, self.autopilot.attitudes.t_heard_s)
        if now_s - heard_s > ASK_AGAIN_S or self._asked_for_state != self.channel.is_continuous:
            self._asked_for_state = self.channel.is_continuous
            for request in messages.report_requests(
                self.autopilot.system_id, self.autopilot.firmware, self._asked_for_state
            ):
                self.outbox.put(request)

    def _hear_request(self, message: Message, now_s: float) -> None:
        us = self._packer.srcSystem, self._packer.srcComponent
        for reply in self.requests.hear(message, us, now_s, lambda: self._heartbeat(now_s)):
            self.outbox.put(reply)

    def _hear_answer(self, answer: str, now_s: float) -> None:
        self.answers.note_answer(now_s)
        readiness = self.autopilot.readiness
        sending = self.replies.hear(answer, readiness.state(now_s), now_s)
        if sending and answer == "ACCEPTED":
            self.autopilot.certainty.note_known(sending.fix.accuracy_m, now_s)
        if answer == "FAILED" and readiness.asks_origin(now_s):
            origin = mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
            self.outbox.put(messages.message_request(self.autopilot.system_id, origin))

    def _tell_of_presence(self, now_s: float) -> None:
        is_there = self.autopilot.listens(now_s)
        if is_there == self._is_there:
            return
        if is_there and self._was_there:
            self._announce(Severity.INFO, "autopilot is back", "autopilot")
        elif not is_there:
            log.warning("the autopilot is silent")
            self._announce(Severity.WARNING, "autopilot is silent", "autopilot")
        self._is_there, self._was_there = is_there, self._was_there or is_there

    def _say_silence(self, now_s: float) -> None:
        if self.answers.is_stopped:
            reason = why_silent(self.autopilot.readiness.state(now_s))
            log.warning(
                "five fixes in a row had no answer, and only one every %g s is sent until one is answered: %s",
                TRIED_AGAIN_AFTER_S,
                reason.sentence,
            )
            self._announce(Severity.WARNING, f"fixes unanswered: {reason.brief}", "answers")
        else:
            log.warning("position fixes are answered again: they are sent again")
            self._announce(Severity.INFO, "fixes are answered again", "answers")

    def _announce(self, severity: Severity, text: str, topic: str | None = None) -> None:
        self.texts.put(severity, text, topic)
