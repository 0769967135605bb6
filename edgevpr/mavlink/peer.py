"""The autopilot at the other end of the link: its system id, its presence, where and how it flies, its answers."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.core.types import Receiver, Vehicle
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.attitude import Attitudes, Heights
from edgevpr.mavlink.autopilots.channel import Channel
from edgevpr.mavlink.autopilots.interview import Interview
from edgevpr.mavlink.certainty import FILTER_REPORTS, Certainty, gps_sd_m
from edgevpr.mavlink.identity import Identity, Speaker
from edgevpr.mavlink.listener import Listener, NoListener
from edgevpr.mavlink.messages import AUTOPILOT, POSITION_FIX
from edgevpr.mavlink.readiness import GPS_REPORTS, Readiness
from edgevpr.mavlink.wire import Message, mavlink

GPS_GONE_AFTER_S = 2.5  # GPS reports come at least once a second, and one may be lost
GPS_AGREES_WITHIN_M = 50.0  # at 25 m/s, with one or two seconds between the two reports
FASTEST_M_S = 150.0  # over ground: a report of more is none of a small aircraft
SILENT_AFTER_S = 5.0  # heartbeats come once a second, and this many may be lost

_HEIGHT_REPORTS = ("DISTANCE_SENSOR", "TERRAIN_REPORT")
_MILLI_G = 9.80665e-3  # m/s2
_NOBODY = NoListener()


class Autopilot:
    """The state of the autopilot, from all messages that arrive. `Identity` says which of them are its own."""

    def __init__(self, own_component: int, system_id: int | None = None, listener: Listener = _NOBODY) -> None:
        self.identity = Identity(system_id)
        self.interview = Interview()
        self.origin: tuple[float, float, float] | None = None  # of its local frame: degrees, metres above sea level
        self._listener = listener
        self._ahead_s: float | None = None  # of its clock, seconds since 1970, over ours
        self.acks: Counter[str] = Counter()  # answers to our fixes, by name of the result
        self.firmware = mavlink.MAV_AUTOPILOT_GENERIC  # until it is heard
        self.vehicle: Vehicle | None = None  # the last report, of any age, without attitude
        self.attitudes, self._heights, self.certainty = Attitudes(), Heights(), Certainty()
        self.readiness = Readiness()
        self._answer: str | None = None  # the newest answer, until `take_answer`
        self._own_component = own_component
        self._heard_s = -math.inf
        self._gps: dict[str, tuple[int, Receiver]] = {}  # those with a fix, and their own time of it

    @property
    def system_id(self) -> int | None:
        """System id of the autopilot, None until it is heard."""
        return self.identity.kept and self.identity.kept.system_id

    def listens(self, now_s: float) -> bool:
        """Tell whether a heartbeat of the autopilot was heard in the last five seconds, over the port as it is open."""
        return now_s - self._heard_s <= SILENT_AFTER_S

    def forget_presence(self) -> None:
        """Regard the autopilot as absent until its next heartbeat, as after a reconnection to who knows whom."""
        self._heard_s = -math.inf

    def vehicle_at(self, t_mono_s: float) -> Vehicle | None:
        """Return the last report, with position, roll, pitch and heading at the time of a frame as far as they are
        known."""
        vehicle, attitude = self.vehicle, self.attitudes.at(t_mono_s)
        if vehicle and vehicle.velocity_m_s and vehicle.is_fresh_at(t_mono_s):
            by_m = ((t_mono_s - vehicle.t_heard_s) * each for each in vehicle.velocity_m_s)
            lat_deg, lon_deg = moved(vehicle.lat_deg, vehicle.lon_deg, *by_m)
            vehicle = replace(vehicle, lat_deg=lat_deg, lon_deg=lon_deg)
        if vehicle is None or attitude is None:
            return vehicle
        heading_deg = None if vehicle.heading_deg is None else attitude.yaw_deg % 360
        return replace(vehicle, roll_deg=attitude.roll_deg, pitch_deg=attitude.pitch_deg, heading_deg=heading_deg)

    def take_answer(self) -> str | None:
        """Return the newest answer to a fix (name of a MAV_RESULT) once, then None until the next answer."""
        answer, self._answer = self._answer, None
        return answer

    def hear(self, message: Message, now_s: float, address: Sender | None = None) -> bool:
        """Take in a message heard at `now_s` from `address` (None: there is only one sender); return True for the
        autopilot's heartbeat."""
        if message.get_srcComponent() != AUTOPILOT or message.get_srcSystem() == 0:
            if self.identity.is_elsewhere(address):
                self.identity.refuse()
            return False
        beats = message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        before = self.identity.kept
        if not self.identity.admits(Speaker(message.get_srcSystem(), address), beats, now_s):
            return False
        if self.identity.kept != before:
            self.vehicle = None
            self._gps.clear()
            self.readiness = Readiness()
            self.attitudes, self._heights, self.certainty = Attitudes(), Heights(), Certainty()
            self.interview, self.origin, self._ahead_s = Interview(), None, None
            self._listener.hear_autopilot(now_s)
        self.interview.hear(message)
        if self._is_for_us(message):
            self.readiness.hear(message, now_s)
        if beats:
            self._heard_s, self.firmware = now_s, message.autopilot
            return True
        if message.get_type() == "COMMAND_ACK":
            self._hear_ack(message)
        elif message.get_type() == "GLOBAL_POSITION_INT":
            self._hear_position(message, now_s)
        elif message.get_type() == "ATTITUDE":
            self.attitudes.hear(message, now_s)
        elif message.get_type() in _HEIGHT_REPORTS:
            self._heights.hear(message, now_s, self.attitudes.at(now_s))
        elif message.get_type() in GPS_REPORTS:
            self._hear_gps(message, now_s)
        elif message.get_type() in FILTER_REPORTS:
            self.certainty.hear(message, now_s)
        elif message.get_type() == "SCALED_IMU":
            self._hear_force(message, now_s)
        elif message.get_type() == "SYSTEM_TIME" and message.time_unix_usec:
            self._ahead_s = message.time_unix_usec / 1e6 - now_s
        elif message.get_type() == "GPS_GLOBAL_ORIGIN":
            self.origin = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
        return False

    def unix_s(self, t_mono_s: float) -> float | None:
        """Return a time of ours by the clock of the autopilot, seconds since 1970; None where it has told none."""
        return None if self._ahead_s is None else t_mono_s + self._ahead_s

    def _hear_force(self, message: Message, now_s: float) -> None:
        attitude = self.attitudes.at(now_s)
        if attitude:
            force = (message.xacc, message.yacc, message.zacc)
            self._listener.hear_force(now_s, tuple(each * _MILLI_G for each in force), attitude)

    def _hear_position(self, message: Message, now_s: float) -> None:
        gps = self._best_gps(now_s)
        has_gps = gps is not None and _is_near(gps, message)
        if has_gps:
            self.certainty.note_known(gps.sd_m, now_s)
        self.vehicle = _vehicle(
            message,
            t_heard_s=now_s,
            has_gps=has_gps,
            gps=gps,
            height_m=self._heights.now(message.relative_alt / 1e3, now_s),
            position_sd_m=self.certainty.now(now_s),
        )
        if self.vehicle:
            self._listener.hear_vehicle(self.vehicle)

    def _hear_gps(self, message: Message, now_s: float) -> None:
        choice = self.interview.choice
        if choice.channel is Channel.GPS_INPUT and message.get_type() == GPS_REPORTS[choice.receiver]:
            return  # the receiver that we play: it says what we have said
        name = message.get_type()
        if message.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX:
            self._gps.pop(name, None)
            return
        time_usec, before = self._gps.get(name, (0, None))
        # A receiver that is lost is reported on for seconds, with its last position and the time of that.
        t_s = before.t_s if before and message.time_usec and message.time_usec == time_usec else now_s
        found = Receiver(message.lat / 1e7, message.lon / 1e7, gps_sd_m(message), t_s)
        self._gps[name] = message.time_usec, found

    def _best_gps(self, now_s: float) -> Receiver | None:
        """Return the most exact receiver; None where there is none."""
        new = (each for _, each in self._gps.values() if now_s - each.t_s <= GPS_GONE_AFTER_S)
        return min(new, key=lambda each: each.sd_m, default=None)

    def _is_for_us(self, message: Message) -> bool:
        """Tell whether a message is no answer to the command of another."""
        return message.get_type() != "COMMAND_ACK" or message.target_component in (0, self._own_component)  # 0: to all

    def _hear_ack(self, message: Message) -> None:
        is_final = message.result != mavlink.MAV_RESULT_IN_PROGRESS
        if message.command == POSITION_FIX and is_final and self._is_for_us(message):
            known = mavlink.enums["MAV_RESULT"].get(message.result)
            self._answer = known.name.removeprefix("MAV_RESULT_") if known else str(message.result)
            self.acks[self._answer] += 1


def _is_near(gps: Receiver, position: Message) -> bool:
    off_m = distance_m(gps.lat_deg, gps.lon_deg, position.lat / 1e7, position.lon / 1e7)
    return float(off_m) <= GPS_AGREES_WITHIN_M


def _vehicle(message: Message, **known: Any) -> Vehicle | None:
    """Read a GLOBAL_POSITION_INT; `known` is what it does not say. Return None for 0, 0, which an autopilot without a
    position sends, and for a position off the Earth."""
    if (message.lat == 0 and message.lon == 0) or abs(message.lat) > 90e7 or abs(message.lon) > 180e7:
        return None
    east_m_s, north_m_s = message.vy / 100, message.vx / 100
    return Vehicle(
        lat_deg=message.lat / 1e7,
        lon_deg=message.lon / 1e7,
        alt_m=message.alt / 1e3,
        heading_deg=message.hdg / 100 if message.hdg <= 36_000 else None,  # 65535: unknown
        sink_m_s=message.vz / 100,
        velocity_m_s=(east_m_s, north_m_s) if math.hypot(east_m_s, north_m_s) <= FASTEST_M_S else None,
        **known,
    )
