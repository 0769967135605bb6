"""The autopilot at the other end of the link: its identity among the senders, and its state from its messages."""

import logging
import math
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

from edgevpr.core.geodesy import distance_m, offset_position
from edgevpr.core.types import Receiver, Vehicle
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.channelselector import ChannelSelector
from edgevpr.mavlink.clock import HEARTBEAT_TIMEOUT_S, AutopilotClock, ForeignStamps, ReportDelay
from edgevpr.mavlink.ground import Announce
from edgevpr.mavlink.heights import Altitudes, Heights
from edgevpr.mavlink.messages import AUTOPILOT, POSITION_FIX, Fix, MotionState
from edgevpr.mavlink.px4 import Px4Fusion
from edgevpr.mavlink.receivers import GPS_REPORTS, GPS_TIMEOUT_S, Receivers
from edgevpr.mavlink.vehicle import HISTORY_S, MAX_FILTER_REPORT_AGE_S, Attitude, Attitudes, PositionAccuracy, Readiness
from edgevpr.mavlink.wire import Message, mavlink

MAX_GPS_DISAGREEMENT_M = 50.0  # at 25 m/s, with one or two seconds between the two reports
MAX_SPEED_M_S = 150.0  # ground speed; small aircraft are never faster, so a faster report is wrong
_MIN_HPA = 300.0  # air pressure at any flight altitude
_MAX_HPA = 1100.0
_MILLI_G_M_S2 = 9.80665e-3

# Reports of the vehicle's position and motion; the first three carry the boot time.
_TIMED_REPORTS = ("ATTITUDE", "GLOBAL_POSITION_INT", "SCALED_IMU")
_MOTION_REPORTS = (*_TIMED_REPORTS, *GPS_REPORTS)
_ORIGIN_TIMEOUT_S = 2.0  # an autopilot that has not answered the request in this time has no origin
_ORIGIN_REQUEST_INTERVAL_S = 10.0
REPLACEMENT_SILENCE_S = 30.0  # a flight controller restarts within 20 s
_OTHER_TIMEOUT_S = 10.0  # without a heartbeat of another vehicle, the link counts as ours alone

_get_time_s = attrgetter("t_received_s")

log = logging.getLogger(__name__)


class Endpoint(NamedTuple):
    """The sender of an autopilot's messages; its address is None if the link has only one sender."""

    system_id: int
    address: Sender | None

    def __str__(self) -> str:
        location = f" at {self.address[0]}:{self.address[1]}" if self.address else ""
        return f"system {self.system_id}{location}"


class Identity:
    """Decides which sender is our autopilot, `current`: the first one or, if `system_id` is set, the first with that
    id. A sender with another system id never replaces it. One with the same id at another address replaces it once it
    has been silent for 30 s; then it `has_moved`. `foreign_messages` counts those of other senders."""

    def __init__(self, system_id: int | None = None) -> None:
        self.current: Endpoint | None = None
        self.foreign_messages = 0
        self._configured = system_id
        self._received_s = -math.inf
        self._has_warned = False
        self._other_s = -math.inf  # when another vehicle's autopilot was last received from the same address
        self.has_moved = False

    def admits(self, endpoint: Endpoint, is_heartbeat: bool, now_s: float) -> bool:
        """Return True if this endpoint is our autopilot. It may become ours if its message `is_heartbeat`."""
        self.has_moved = False
        if is_heartbeat and endpoint != self.current and self._may_replace(endpoint, now_s):
            if self.current is None:
                log.info("connected to autopilot (%s)", endpoint)
            else:
                silent_s = now_s - self._received_s
                log.warning("the autopilot is now %s: %s has been silent for %.0f s", endpoint, self.current, silent_s)
                self.has_moved = True
            self.current, self._has_warned = endpoint, False
        if endpoint != self.current:
            if is_heartbeat and self.current and endpoint.address == self.current.address:
                self._other_s = now_s
            # Do not count while any sender may still become our autopilot.
            self.foreign_messages += self.current is not None or self._configured is not None
            return False
        self._received_s = now_s
        return True

    def shares_link(self, now_s: float) -> bool:
        """Return True if another vehicle's autopilot is at the same address, and receives all that we send."""
        return now_s - self._other_s <= _OTHER_TIMEOUT_S

    def is_foreign(self, address: Sender | None) -> bool:
        """Return True if bytes from this address cannot come from our autopilot, which has another address."""
        return self.current is not None and address != self.current.address

    def _may_replace(self, endpoint: Endpoint, now_s: float) -> bool:
        """Return True if the heartbeat of another endpoint makes that endpoint our autopilot."""
        current = self.current
        if current is None and self._configured in (None, endpoint.system_id):
            return True
        if not self._has_warned:  # two vehicles on one link are dangerous
            self._has_warned = True
            ours = current or f"system {self._configured}"
            advice = "use a separate link for each vehicle, or set mavlink.system_id and restart edgevpr"
            what = "single fixes are sent to %s only, continuous positions, which all autopilots would use, not at all"
            log.warning(f"another autopilot, %s, is on this link: {what}; %s", endpoint, ours, advice)
        is_same = current is not None and endpoint.system_id == current.system_id
        return is_same and now_s - self._received_s >= REPLACEMENT_SILENCE_S


class Listener:
    """Base class for objects that process the autopilot's reports and estimate the positions to send; it does
    nothing. The link's thread calls the methods, which must never block or raise."""

    def handle_autopilot(self, t_s: float) -> None:
        """Handle a new autopilot at `t_s`: the first, a restarted or a different one."""

    def handle_channel(self, channel: Channel) -> None:
        """Handle the channel for positions when it is first chosen, and when it changes."""

    def handle_no_position(self, t_s: float) -> None:
        """Handle a report at `t_s` that the autopilot has no position."""

    def handle_vehicle(self, vehicle: Vehicle) -> None:
        """Handle a report of the vehicle's position and velocity."""

    def handle_specific_force(self, t_s: float, force_m_s2: tuple[float, float, float], attitude: Attitude) -> None:
        """Handle the specific force at `t_s` (m/s^2 forward, right and down), and the attitude at that time."""

    def reset_navigation(self) -> None:
        """Restart navigation, because the vehicle's motion since the last reports is unknown."""

    def trusts_gps(self) -> bool:
        """Return False while matches prove the GPS receiver wrong."""
        return True

    def estimate_state(self, t_s: float) -> MotionState | None:
        """Return the vehicle's position and motion at `t_s` for a continuous channel; None if it is too uncertain."""
        return None

    def make_interim_fix(self, now_s: float) -> Fix | None:
        """Return a fix to send between two matches, for a channel of single fixes; None if it would not help."""
        return None


class Autopilot:
    """The state of our autopilot and its vehicle, from the messages of the sender that `identity` selects.
    `component_id`: our component id. `system_id`: system id of the autopilot (None: accept the first one)."""

    def __init__(self, component_id: int, system_id: int | None, listener: Listener, announce: Announce) -> None:
        self.identity = Identity(system_id)
        self.acks: Counter[str] = Counter()  # answers to our fixes, by name of the result
        self.firmware: int = mavlink.MAV_AUTOPILOT_GENERIC  # a MAV_AUTOPILOT; generic until its first heartbeat
        self._listener, self._component_id, self._announce = listener, component_id, announce
        self.heartbeat_s = -math.inf  # time of its last heartbeat through the currently open port
        self.answer: str | None = None  # name of a MAV_RESULT, if the last message answered a fix
        self.has_restarted = False  # according to the last message
        self._reset()

    def _reset(self) -> None:
        self.selector = ChannelSelector(self._announce)
        self.answered_s: dict[int, float] = {}  # time of its last answer to each of our commands, by number
        self.is_armed: bool | None = None  # None: no heartbeat yet
        self.origin: tuple[float, float, float] | None = None  # of its local frame: degrees, metres above sea level
        self._origin_s = self._origin_request_s = self._gps_s = self.flags_s = -math.inf  # times of the last messages
        self._was_origin_missing, self._flags = False, 0
        self.pressure_alt_m: float | None = None  # barometric altitude in the standard atmosphere
        self.vehicle: Vehicle | None = None  # the last report, of any age, without attitude
        self._vehicles: tuple[Vehicle, ...] = ()  # of the last six seconds
        self.attitudes, self.heights, self.accuracy = Attitudes(), Heights(self._announce), PositionAccuracy()
        self.clock, self.imu_s = AutopilotClock(self._announce), -math.inf  # when accelerations were last received
        self.px4 = Px4Fusion()
        self.receivers, self.foreign_stamps = Receivers(), ForeignStamps()
        self.report_delay = ReportDelay(self._announce)

    @property
    def system_id(self) -> int | None:
        """System id of the autopilot; None until its first heartbeat."""
        return self.identity.current.system_id if self.identity.current else None

    def stamp_s(self, t_mono_s: float) -> float | None:
        """Return `t_mono_s` as a timestamp for the autopilot; None if its clock is unknown. PX4 converts it itself."""
        return t_mono_s if self.firmware == mavlink.MAV_AUTOPILOT_PX4 else self.clock.stamp_s(t_mono_s)

    def reaches_another(self, now_s: float) -> bool:
        """Return True if another vehicle's autopilot would use the positions that we send as well."""
        return self.selector.choice.channel.is_untargeted and self.identity.shares_link(now_s)

    @property
    def own_report_s(self) -> float | None:
        """Time of the last report of the receiver that we simulate (-inf: none yet; None: we simulate none)."""
        return None if self._own_report is None else self.receivers.get_received_s(self._own_report)

    def is_alive(self, now_s: float) -> bool:
        """Return True if a heartbeat of the autopilot arrived through the current port in the last five seconds."""
        return now_s - self.heartbeat_s <= HEARTBEAT_TIMEOUT_S

    def is_origin_request_due(self, now_s: float) -> bool:
        """Return True, and record the time, if the origin should be requested now: a restart may have lost it."""
        if now_s - self._gps_s <= GPS_TIMEOUT_S or now_s - self._origin_request_s < _ORIGIN_REQUEST_INTERVAL_S:
            return False
        self._was_origin_missing, self._origin_request_s = self._is_origin_missing(now_s), now_s
        return True

    def assess_readiness(self, now_s: float) -> Readiness:
        """Return the autopilot's readiness to accept a fix, as far as it is known."""
        return Readiness(
            is_px4=self.firmware == mavlink.MAV_AUTOPILOT_PX4,
            is_armed=self.is_armed,
            has_gps=now_s - self._gps_s <= GPS_TIMEOUT_S,
            lacks_origin=self._is_origin_missing(now_s),
            flags=self._flags if now_s - self.flags_s <= MAX_FILTER_REPORT_AGE_S else 0,
            answers_commands=bool(self.answered_s.keys() - {POSITION_FIX}),
        )

    def _is_origin_missing(self, now_s: float) -> bool:
        """Return True if the origin was requested and not received in time; during a request, the previous result."""
        is_late = self._was_origin_missing or now_s - self._origin_request_s > _ORIGIN_TIMEOUT_S
        return self._origin_s < self._origin_request_s and is_late

    def predict_vehicle(self, t_mono_s: float) -> Vehicle | None:
        """Return the last report before `t_mono_s`, extrapolated: see `Conversation.predict_vehicle`."""
        history = self._vehicles  # read once, because another thread replaces it
        if not history:
            return None
        vehicle = history[max(0, bisect_right(history, t_mono_s, key=_get_time_s) - 1)]
        if not vehicle.is_fresh(t_mono_s):
            return vehicle
        attitude = self.attitudes.interpolate(t_mono_s)
        if vehicle.velocity_m_s:
            east_m, north_m = ((t_mono_s - vehicle.t_received_s) * speed_m_s for speed_m_s in vehicle.velocity_m_s)
            lat_deg, lon_deg = offset_position(vehicle.lat_deg, vehicle.lon_deg, east_m, north_m)
            vehicle = replace(vehicle, lat_deg=lat_deg, lon_deg=lon_deg)
        if attitude is None:
            return vehicle
        _, roll_deg, pitch_deg, yaw_deg, tilt_rate_deg_s = attitude
        heading_deg = None if vehicle.heading_deg is None else yaw_deg % 360
        return replace(
            vehicle, roll_deg=roll_deg, pitch_deg=pitch_deg, tilt_rate_deg_s=tilt_rate_deg_s, heading_deg=heading_deg
        )

    def handle(self, message: Message, now_s: float, address: Sender | None = None) -> bool:
        """Process a message received at `now_s` from `address`. Returns True if it is a heartbeat of our autopilot."""
        self.answer, self.has_restarted = None, False
        if message.get_srcComponent() != AUTOPILOT or message.get_srcSystem() == 0:
            self.identity.foreign_messages += self.identity.is_foreign(address)
            return False
        kind = message.get_type()
        is_heartbeat = bool(kind == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID)
        previous = self.identity.current
        if not self.identity.admits(Endpoint(message.get_srcSystem(), address), is_heartbeat, now_s):
            return False
        is_other = self.identity.current != previous
        self.has_restarted = not is_other and self.clock.handle(message, now_s)
        if is_other or self.has_restarted:
            self._reset()
            self.clock.handle(message, now_s)
            self._listener.handle_autopilot(now_s)
        self.selector.handle(message)
        if kind == "COMMAND_ACK" and message.target_component not in (0, self._component_id):  # 0: broadcast
            return False
        if kind == "COMMAND_ACK":
            self.answered_s[message.command] = now_s
        if is_heartbeat:
            self.heartbeat_s, self.firmware = now_s, message.autopilot
            self.is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        else:
            self._handle_report(message, now_s)
        return is_heartbeat

    def _handle_report(self, message: Message, now_s: float) -> None:
        kind = message.get_type()
        if kind in _TIMED_REPORTS:
            if self.clock.has_stood_still(message.time_boot_ms, now_s):
                self._listener.reset_navigation()
            self.report_delay.update(self.clock.delay_s(message.time_boot_ms, now_s), now_s)
        if kind in _MOTION_REPORTS and self.report_delay.is_late:
            return  # an outdated report: the link is saturated, or our process was paused
        match kind:
            case "COMMAND_ACK" if message.command == POSITION_FIX and message.result != mavlink.MAV_RESULT_IN_PROGRESS:
                entry = mavlink.enums["MAV_RESULT"].get(message.result)
                self.answer = answer = entry.name.removeprefix("MAV_RESULT_") if entry else str(message.result)
                self.acks[answer] += 1
            case "DISTANCE_SENSOR" | "TERRAIN_REPORT":
                self.heights.handle(message, now_s, self.attitudes.interpolate(now_s))
            case "GPS_RAW_INT" | "GPS2_RAW":
                self.receivers.handle(message, self.clock.mono_time_s(message.time_usec / 1e6, now_s), now_s)
                if message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
                    self._gps_s = now_s
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS" as name:
                self._flags, self.flags_s = message.flags, now_s
                self.accuracy.handle(message, now_s)
                if not self.accuracy.has_position:
                    self._listener.handle_no_position(now_s)
                if name == "ESTIMATOR_STATUS":
                    self.px4.handle(
                        message,
                        now_s,
                        self._choose_receiver(now_s),
                        is_trusted=self._listener.trusts_gps(),
                        version=self.selector.version,
                        is_armed=bool(self.is_armed),
                    )
            case "GLOBAL_POSITION_INT":
                self._handle_position(message, now_s)
            case "ATTITUDE":
                self.attitudes.handle(message, now_s)
            case "SCALED_IMU" if attitude := self.attitudes.interpolate(now_s):
                self.imu_s = now_s
                force_m_s2 = tuple(axis * _MILLI_G_M_S2 for axis in (message.xacc, message.yacc, message.zacc))
                self._listener.handle_specific_force(now_s, force_m_s2, attitude)
            case "SCALED_PRESSURE" if _MIN_HPA < message.press_abs < _MAX_HPA:
                self.pressure_alt_m = 44330.8 * (1 - (message.press_abs / 1013.25) ** 0.190263)
            case "GPS_GLOBAL_ORIGIN":
                self.origin = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
                self._origin_s = now_s

    def _handle_position(self, message: Message, now_s: float) -> None:
        """Process a GLOBAL_POSITION_INT. If its position is invalid, or 0, 0, `vehicle` becomes None."""
        lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
        gps = self._choose_receiver(now_s, (lat_deg, lon_deg))
        is_near = bool(gps and distance_m(gps.lat_deg, gps.lon_deg, lat_deg, lon_deg) <= MAX_GPS_DISAGREEMENT_M)
        # On a continuous channel the estimate may be derived from our positions, so it is no evidence of GPS.
        has_gps = bool(gps) and (is_near or self.selector.choice.channel.is_continuous) and self.px4.uses_gps
        if gps and has_gps:
            self.accuracy.record_accuracy(gps.sd_m, now_s)
        has_no_position = (message.lat == 0 and message.lon == 0) or abs(message.lat) > 90e7 or abs(message.lon) > 180e7
        east_m_s, north_m_s = message.vy / 100, message.vx / 100
        above_sea_m = None if has_no_position else message.alt / 1e3
        altitudes = Altitudes(now_s, above_sea_m, message.relative_alt / 1e3, -message.vz / 100)
        self.heights.handle_altitudes(altitudes, self.is_armed is not False, math.hypot(east_m_s, north_m_s))
        if has_no_position:
            self.vehicle, self._vehicles = None, ()
            self._listener.handle_no_position(now_s)
            return
        self.vehicle = Vehicle(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=message.alt / 1e3,
            heading_deg=message.hdg / 100 if message.hdg <= 36_000 else None,  # 65535: unknown
            sink_m_s=message.vz / 100,
            velocity_m_s=(east_m_s, north_m_s) if math.hypot(east_m_s, north_m_s) <= MAX_SPEED_M_S else None,
            t_received_s=now_s,
            has_gps=has_gps,
            gps=gps,
            reaches_another=self.reaches_another(now_s),
            gps_is_silent=self.receivers.is_silent(now_s, self._own_report),
            height_m=self.heights.compute_height_m(now_s),
            height_doubt_m=self.heights.doubt_m,
            height_step_m=self.heights.stepped_m,
            heading_step_deg=self.attitudes.heading_step_deg,
            has_position=self.accuracy.has_position,
            position_sd_m=self.accuracy.compute_sd_m(now_s),
            innovation_ratio=self.accuracy.innovation_ratio(now_s),
        )
        first = bisect_left(self._vehicles, now_s - HISTORY_S, key=_get_time_s)
        self._vehicles = (*self._vehicles[first:], self.vehicle)
        self._listener.handle_vehicle(self.vehicle)

    def _choose_receiver(self, now_s: float, estimate_deg: tuple[float, float] | None = None) -> Receiver | None:
        """Return the last report of the best GPS receiver except the one that we simulate; None if none has a fix.
        `estimate_deg` is as in `Receivers.choose_best`."""
        if estimate_deg is None and self.vehicle:
            estimate_deg = self.vehicle.lat_deg, self.vehicle.lon_deg
        return self.receivers.choose_best(now_s, self._own_report, estimate_deg)

    @property
    def _own_report(self) -> str | None:
        """Name of the message that reports the receiver that we simulate; None if we simulate none."""
        choice = self.selector.choice
        return GPS_REPORTS[choice.receiver] if choice.channel is Channel.GPS_INPUT else None
