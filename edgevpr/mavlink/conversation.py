"""The conversation with the autopilot, independent of port and thread. It is used only inside turns (see `turns`)."""

import logging
import math
import struct
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Position, Vehicle
from edgevpr.mavlink import messages
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.clock import HEARTBEAT_TIMEOUT_S
from edgevpr.mavlink.fixes import MAX_FIX_WAIT_S, Fixes, FixTransmission, compensate_lag
from edgevpr.mavlink.ground import Requests, Texts
from edgevpr.mavlink.messages import AUTOPILOT, Fix, Health, Severity
from edgevpr.mavlink.peer import Autopilot, Listener
from edgevpr.mavlink.signing import NOT_SIGNING, Signing
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

MAX_MESSAGES = 64
HEARTBEAT_INTERVAL_S = 1.0
STATE_INTERVAL_S = 0.1  # ArduPilot treats a GPS receiver as unhealthy if its positions are more than 215 ms apart
HEALTH_TIMEOUT_S = 10.0  # a hung main loop must not look healthy while the link's thread still runs
INTERIM_FIX_INTERVAL_S = 0.5  # between fixes sent without a new match
REQUEST_INTERVAL_S = 5.0
MAX_UNREPORTED_INPUTS = 100  # GPS_INPUT of ten seconds: an autopilot that uses this receiver reports it
ORIGIN_TIMEOUT_S = 5.0  # an autopilot with an origin sends it once a second on request

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """The settings of a link. `system_id`: system id of the autopilot (None: accept the first one). A fix that has
    waited for `max_fix_age_s` is never sent. `clock`: the monotonic clock of all timestamps. `origin`: the origin to
    set on an autopilot that accepts ODOMETRY and has no origin (None: never set one)."""

    component_id: int = 197
    system_id: int | None = None
    max_fix_age_s: float = MAX_FIX_WAIT_S
    clock: Callable[[], float] = time.monotonic
    listener: Listener = field(default_factory=Listener)
    signing: Signing = NOT_SIGNING
    origin: Position | None = None


class Conversation:
    """Makes the packets to send, one at a time, and processes received bytes. `sent` counts messages by name."""

    def __init__(self, settings: LinkSettings, clock: Callable[[], float]) -> None:
        self.settings = settings
        self.autopilot = Autopilot(
            settings.component_id, settings.system_id, settings.listener, lambda *report: self._reports.append(report)
        )
        self.fixes = Fixes(settings.max_fix_age_s, lambda *report: self._reports.append(report))
        self.texts, self.requests = Texts(), Requests()
        self.reader = PacketReader(settings.signing.admits)
        self.interim_fixes: deque[FixTransmission] = deque(maxlen=MAX_MESSAGES)
        self.sent: Counter[str] = Counter()
        self._reports: list[tuple[Severity, str, str]] = []
        self._messages: deque[Message] = deque(maxlen=MAX_MESSAGES)
        self._clock = clock
        self._health, self._health_set_s = Health.BOOT, clock()
        self._packer = mavlink.MAVLink(None, srcSystem=settings.system_id or 1, srcComponent=settings.component_id)
        self._heartbeat_due_s = self._state_due_s = self._interim_fix_due_s = clock()
        self._next_request_s: float | None = None  # when to request reports next; None: they are not needed
        self._restarts, self._restart_reported_s = 0, -math.inf
        self._reported_channel: Channel | None = self.channel  # last one reported to the listener
        self._has_requested_continuous: bool | None = None
        self._origin_missing_since_s, self._has_set_origin = math.inf, False
        self._has_requested_pressure = False
        self._was_alive: bool | None = None  # last announced state; None: no heartbeat yet
        self._silence_due_s = clock() + HEALTH_TIMEOUT_S  # when to report that no heartbeat has arrived
        self._is_gps_silent = self._is_ignored = False  # last announced states
        self._own_report_s = -math.inf  # time of the autopilot's last report of the receiver that we simulate
        self._reported_inputs = 0  # number of GPS_INPUT messages sent until then

    @property
    def channel(self) -> Channel:
        """The channel used to send positions."""
        return self.autopilot.selector.choice.channel

    @property
    def has_pending(self) -> bool:
        """True if a message or text is queued, or a fix awaits its answer."""
        return bool(self._messages or self.texts or self.fixes)

    def send(self, *outgoing: Message) -> None:
        """Queue messages. If the queue is full, the oldest messages are dropped."""
        self._messages.extend(outgoing)

    def send_fix(self, fix: Fix) -> FixTransmission:
        """Queue a position fix. It is sent within `max_fix_age_s` seconds if the autopilot is alive, or never."""
        now_s = self._clock()
        self._interim_fix_due_s = now_s + INTERIM_FIX_INTERVAL_S
        return self.fixes.put(fix, now_s)

    def take_interim_fixes(self) -> list[FixTransmission]:
        """Return the fixes sent between matches since the last call."""
        fixes, self.interim_fixes = list(self.interim_fixes), deque(maxlen=MAX_MESSAGES)
        return fixes

    def announce(self, severity: Severity, text: str, topic: str | None = None) -> None:
        """Queue a status text; at most one is sent every five seconds. `topic`: see `Texts`."""
        self.texts.put(severity, text, topic)

    def set_health(self, health: Health) -> None:
        """Set the health to send in heartbeats. Unless it is set again within ten seconds, it becomes CRITICAL."""
        self._health, self._health_set_s = health, self._clock()

    def request_position(self) -> None:
        """Start to request the autopilot's reports, and request them again whenever they stop or become rare."""
        self._next_request_s = self._clock()

    def predict_vehicle(self, t_mono_s: float) -> Vehicle | None:
        """Return the last report of the vehicle, extrapolated to `t_mono_s`, the time of a frame, as far as velocity
        and attitude (within 0.3 s) are known; None without a position. On a continuous channel, `t_fix_s` is now."""
        vehicle = self.autopilot.predict_vehicle(t_mono_s)
        t_fix_s = self._clock() if self.channel.is_continuous else self.fixes.t_fix_s
        return vehicle and replace(vehicle, t_fix_s=t_fix_s)

    def wait_s(self, max_wait_s: float) -> float:
        """Return the seconds, at most `max_wait_s`, that the link may sleep until the next message is due."""
        due_in_s = self._state_due_s - self._clock() if self.channel.is_continuous else max_wait_s
        return min(max_wait_s, max(0.0, due_in_s))

    def next_packet(self) -> tuple[bytes, FixTransmission | None] | None:
        """Choose and pack the next message. Returns its packet and the fix in it, if any; None if nothing is due."""
        while (outgoing := self._next_message(self._clock())) is not None:
            message, transmission = outgoing
            self.settings.signing.stamp(self._packer)
            try:
                packet: bytes = message.pack(self._packer)
            except (struct.error, OverflowError) as error:  # an out-of-range value must not break the link
                log.error("%s not sent: %s", message, error)
                if transmission:
                    transmission.settle(False, Reason(ReasonCode.NOT_ENCODABLE, {"problem": str(error)}))
                continue
            self._packer.seq = (self._packer.seq + 1) % 256
            if transmission:
                self.fixes.record_sent(transmission, self._clock())
            else:
                self.sent[message.get_type()] += 1
            return packet, transmission
        return None

    def count_sent_fixes(self, fixes: list[FixTransmission]) -> None:
        """Count the fixes that have left the port. Call this before `handle` processes an answer to one of them."""
        self.sent["COMMAND_INT"] += len(fixes)

    def handle(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        """Process bytes received from `sender` at `now_s`. Returns True if they contain the autopilot's heartbeat."""
        has_heartbeat = False
        for message in self.reader.feed(data, sender):
            if self.autopilot.handle(message, now_s, sender):
                has_heartbeat = True
                self._packer.srcSystem = self.autopilot.system_id
                if self.autopilot.identity.has_moved:
                    self._reset(ReasonCode.AUTOPILOT_REPLACED)
                    self.announce(Severity.WARNING, "autopilot address has changed", "autopilot")
            if self.autopilot.has_restarted:
                self._reset(ReasonCode.AUTOPILOT_RESTARTED)
                self._announce_restart(now_s)
            if self.autopilot.answer:
                self._handle_answer(self.autopilot.answer, now_s)
            if not self.autopilot.identity.is_foreign(sender):
                own_id = self._packer.srcSystem, self._packer.srcComponent
                self.send(*self.requests.handle(message, own_id, now_s))
                self._handle_stamp(message, now_s)
        return has_heartbeat

    def announce_changes(self) -> None:
        """Announce changes in the autopilot's heartbeats and answers since the last call."""
        now_s = self._clock()
        is_alive = self.autopilot.is_alive(now_s)
        if is_alive and self._was_alive is False:
            self.announce(Severity.INFO, "autopilot is back", "autopilot")
        elif self._was_alive and not is_alive:
            log.warning("no heartbeat from the autopilot")
            self.announce(Severity.WARNING, "autopilot is silent", "autopilot")
        elif self._was_alive is None and not is_alive and now_s > self._silence_due_s:
            self._silence_due_s = math.inf
            log.warning("no heartbeat from an autopilot yet: `edgevpr doctor` shows why")
        if is_alive or self._was_alive is not None:
            self._was_alive = is_alive
        is_gps_silent = self.autopilot.vehicle is not None and self.autopilot.vehicle.gps_is_silent
        if is_gps_silent != self._is_gps_silent:
            self._is_gps_silent = is_gps_silent
            text = "GPS reports stopped: requested again" if is_gps_silent else "GPS reports arrive again"
            self.announce(Severity.WARNING if is_gps_silent else Severity.INFO, text, "GPS reports")
        self._check_own_receiver()
        self.fixes.report_silence(self.autopilot.assess_readiness(now_s).silence_reason, now_s)
        while self._reports:
            self.announce(*self._reports.pop(0))

    def _check_own_receiver(self) -> None:
        """Announce if the autopilot does not report the receiver that we simulate: it needs a reboot."""
        own_report_s = self.autopilot.own_report_s
        if own_report_s is None or own_report_s != self._own_report_s:  # another channel, a new report, or a restart
            self._own_report_s = -math.inf if own_report_s is None else own_report_s
            self._reported_inputs = self.sent["GPS_INPUT"]
        is_overdue = self.sent["GPS_INPUT"] - self._reported_inputs >= MAX_UNREPORTED_INPUTS
        if is_overdue and self._own_report_s == -math.inf and not self._is_ignored:  # otherwise its reports are lost
            self._is_ignored = True
            advice = "" if self.autopilot.is_armed else ": reboot it"
            self.announce(Severity.WARNING, f"autopilot ignores GPS_INPUT{advice}", "GPS_INPUT")
        elif self._is_ignored and self._own_report_s > -math.inf:
            self._is_ignored = False
            self.announce(Severity.INFO, "autopilot uses GPS_INPUT", "GPS_INPUT")

    def handle_port_loss(self, lost_fixes: int) -> None:
        """Reset the state after the port was lost. `lost_fixes`: number of fixes discarded with it."""
        self.fixes.record_lost(lost_fixes)
        self.autopilot.heartbeat_s = -math.inf  # the reopened port may lead to another autopilot
        self.reader.parsers.clear()  # discards incomplete messages

    def drop_stale(self) -> None:
        """Drop the fixes that have waited too long."""
        self.fixes.drop_stale(self._clock())

    def end(self) -> None:
        """Drop all fixes: queued ones, and those that await an answer."""
        self.fixes.cancel_awaited(Reason(ReasonCode.ENDED_BEFORE_ANSWER))
        self.fixes.drop_stale(math.inf)

    def _next_message(self, now_s: float) -> tuple[Message, FixTransmission | None] | None:
        late_s = now_s - self._heartbeat_due_s
        if late_s >= 0:
            self._heartbeat_due_s = now_s + HEARTBEAT_INTERVAL_S - late_s % HEARTBEAT_INTERVAL_S
            is_hung = now_s - self._health_set_s > HEALTH_TIMEOUT_S
            return messages.make_heartbeat(Health.CRITICAL if is_hung else self._health), None
        system_id = self.autopilot.system_id
        if system_id is not None and self.autopilot.is_alive(now_s):
            if request := self.autopilot.clock.make_request(now_s):
                return request, None
            self._request_reports(system_id, now_s)
            if self.channel.is_continuous and (state := self._make_state_message(system_id, now_s)):
                return state, None
            pause = Reason(ReasonCode.PAUSED) if self.requests.is_paused else None
            if objection := pause or self.autopilot.selector.choice.silence_reason or self.fixes.find_objection(now_s):
                self.fixes.withhold(objection)
            elif (stamp_s := self.autopilot.stamp_s(now_s)) is None:
                self.fixes.drop_stale(now_s, ReasonCode.CLOCK_UNKNOWN)
            elif transmission := self.fixes.next(now_s) or self._next_interim_fix(now_s):
                lag_s = self.autopilot.foreign_stamps.take_lag_s()
                fix = compensate_lag(transmission.fix, now_s, lag_s, self.autopilot.vehicle)
                return messages.make_position_fix(fix, now_s, system_id, stamp_s), transmission
        else:
            self.fixes.drop_stale(now_s)
        if text := self.texts.next(now_s):
            return text, None
        return (self._messages.popleft(), None) if self._messages else None

    def _next_interim_fix(self, now_s: float) -> FixTransmission | None:
        """Return a fix between two matches, if one is due and useful. ArduPilot corrects only its position with it. PX4
        may also correct its velocity, which would feed back its own error."""
        is_due = now_s >= self._interim_fix_due_s and self.autopilot.firmware == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        if not is_due or not (fix := self.settings.listener.make_interim_fix(now_s)):
            return None
        self.interim_fixes.append(self.send_fix(fix))
        return self.fixes.next(now_s)

    def _make_state_message(self, system_id: int, now_s: float) -> Message | None:
        """Make the next message of a continuous channel, if any: a position, or the origin of its local frame."""
        if now_s < self._state_due_s:
            return None
        self._state_due_s = max(self._state_due_s + STATE_INTERVAL_S, now_s)
        choice, autopilot = self.autopilot.selector.choice, self.autopilot
        state = self.settings.listener.estimate_state(t_s := now_s - choice.lag_s)
        if self.requests.is_paused:
            state = None
        if autopilot.reaches_another(now_s):  # not even "no fix", which would spoil the receiver of the other vehicle
            return None
        if choice.channel is Channel.SENSOR:
            return autopilot.px4.make_state_message(state, None, system_id, now_s)
        if choice.channel is Channel.VISION:
            return autopilot.origin and autopilot.px4.make_state_message(state, autopilot.origin, system_id, now_s)
        if (stamp_s := autopilot.stamp_s(t_s)) is None:
            return None
        if choice.channel is Channel.GPS_INPUT:
            return messages.make_gps_input(state, choice.receiver, stamp_s, autopilot.clock.utc_s(t_s))
        origin = self.settings.origin
        if autopilot.origin is None and origin and now_s - self._origin_missing_since_s > ORIGIN_TIMEOUT_S:
            self._origin_missing_since_s = now_s  # send it again later: a filter that has not started ignores it
            return self._make_origin(origin, system_id)
        if state and state.attitude and autopilot.origin:
            return messages.make_odometry(state, state.attitude, autopilot.origin, stamp_s)
        return None

    def _make_origin(self, origin: Position, system_id: int) -> Message:
        """Make the message that sets the origin; if the map lacks its altitude, request the air pressure first."""
        alt_m, pressure_alt_m = origin.alt_m, self.autopilot.pressure_alt_m
        if alt_m is None and pressure_alt_m is not None:
            alt_m = pressure_alt_m - self.autopilot.heights.compute_height_m(self._clock())
        if alt_m is None:
            if self._has_requested_pressure:
                self.announce(Severity.WARNING, "origin altitude unknown: set EKF origin", "origin")
            self._has_requested_pressure = True
            return messages.make_message_request(system_id, mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE)
        self._has_requested_pressure = False  # request it again after a restart of the autopilot
        if not self._has_set_origin:
            altitude = "from air pressure (error up to 150 m)" if origin.alt_m is None else "from the map"
            log.warning("the autopilot has no origin: setting it to the first place of the map, altitude %s", altitude)
            self._has_set_origin = True
        if origin.alt_m is None:
            self.announce(Severity.WARNING, f"origin altitude unknown: assuming {alt_m:.0f} m", "origin")
        return messages.make_origin(system_id, origin.lat_deg, origin.lon_deg, alt_m)

    def _request_reports(self, system_id: int, now_s: float) -> None:
        """Request the parameters that are due, and reports that have stopped or arrive at less than half the rate."""
        if self._next_request_s is None:
            return
        self.send(*self.autopilot.selector.make_requests(now_s, system_id))
        if self.channel is not self._reported_channel:
            self._reported_channel, self._origin_missing_since_s, self._next_request_s = self.channel, now_s, now_s
            self.settings.listener.handle_channel(self.channel)
        if now_s < self._next_request_s:
            return
        self._next_request_s = now_s + REQUEST_INTERVAL_S
        if self.channel in (Channel.VISION, Channel.ODOMETRY) and self.autopilot.origin is None:
            self.send(messages.make_message_request(system_id, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN))
        vehicle, is_continuous = self.autopilot.vehicle, self.channel.is_continuous
        is_silent = vehicle is None or now_s - vehicle.t_received_s > REQUEST_INTERVAL_S
        is_slowed = self.autopilot.attitudes.rate_hz(now_s) < messages.attitude_hz(is_continuous) / 2
        is_slowed |= is_continuous and now_s - self.autopilot.imu_s > REQUEST_INTERVAL_S
        if self.autopilot.firmware in messages.FILTER_REPORTS:
            is_silent |= now_s - self.autopilot.flags_s > REQUEST_INTERVAL_S
        if is_silent or is_slowed or self._has_requested_continuous != is_continuous:
            self._has_requested_continuous = is_continuous
            self.send(*messages.make_report_requests(system_id, self.autopilot.firmware, is_continuous))
        elif self.autopilot.receivers.is_report_missing(now_s, REQUEST_INTERVAL_S):
            self.send(*messages.make_gps_requests(system_id))

    def _reset(self, why: ReasonCode) -> None:
        """Start over with an autopilot that has lost its state. `why`: reason reported for the awaited fixes."""
        self.fixes.cancel_awaited(Reason(why))
        self._has_requested_continuous = self._reported_channel = None
        self._origin_missing_since_s, self._has_set_origin = math.inf, False
        if self._next_request_s is not None:
            self._next_request_s = self._clock()

    def _announce_restart(self, now_s: float) -> None:
        self._restarts += 1
        if now_s - self._restart_reported_s > HEARTBEAT_TIMEOUT_S:
            log.warning("the autopilot has restarted: requesting its parameters, rates and origin again")
            count = f" {self._restarts} times" if self._restarts > 1 else ""
            self.announce(Severity.WARNING, f"autopilot has restarted{count}", "autopilot")
        self._restart_reported_s = now_s

    def _handle_stamp(self, message: Message, now_s: float) -> None:
        """Announce a wrong timestamp of another program, which also makes ArduPilot misinterpret ours."""
        own_id = self._packer.srcSystem, self._packer.srcComponent
        sender, autopilot = (message.get_srcSystem(), message.get_srcComponent()), self.autopilot
        if sender in (own_id, (own_id[0], AUTOPILOT)) or autopilot.firmware != mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            return
        if wrong_stamp := autopilot.foreign_stamps.find(message, autopilot.clock.boot_time_s(now_s)):
            self.announce(Severity.WARNING, f"bad timestamps: {wrong_stamp}", "stamps")

    def _handle_answer(self, answer: str, now_s: float) -> None:
        transmission = self.fixes.handle(answer, self.autopilot.assess_readiness(now_s).explain(answer), now_s)
        if transmission and answer == "ACCEPTED":
            self.autopilot.accuracy.record_accuracy(transmission.fix.accuracy_m, now_s)
        if answer == "FAILED" and self.autopilot.is_origin_request_due(now_s):
            origin = mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
            self.send(messages.make_message_request(self.autopilot.system_id or 0, origin))
