"""The autopilot at the other end of the link: its system id, its presence, where and how it flies, its answers."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any

from edgevpr.geodesy import distance_m
from edgevpr.mavlink.address import Sender
from edgevpr.mavlink.attitude import Attitudes, Heights
from edgevpr.mavlink.certainty import FILTER_REPORTS, Certainty, gps_sd_m
from edgevpr.mavlink.identity import Identity, Speaker
from edgevpr.mavlink.messages import AUTOPILOT, POSITION_FIX
from edgevpr.mavlink.readiness import GPS_REPORTS, Readiness
from edgevpr.mavlink.wire import Message, mavlink
from edgevpr.types import Vehicle

GPS_GONE_AFTER_S = 2.5  # GPS reports come at least once a second, and one may be lost
GPS_AGREES_WITHIN_M = 50.0  # at 25 m/s, with one or two seconds between the two reports
FASTEST_M_S = 150.0  # over ground: a report of more is none of a small aircraft
SILENT_AFTER_S = 5.0  # heartbeats come once a second, and this many may be lost

_HEIGHT_REPORTS = ("DISTANCE_SENSOR", "TERRAIN_REPORT")


class Autopilot:
    """The state of the autopilot, from all messages that arrive. `Identity` says which of them are its own."""

    def __init__(self, own_component: int, system_id: int | None = None) -> None:
        self.identity = Identity(system_id)
        self.acks: Counter[str] = Counter()  # answers to our fixes, by name of the result
        self.firmware = mavlink.MAV_AUTOPILOT_GENERIC  # until it is heard
        self.vehicle: Vehicle | None = None  # the last report, of any age, without attitude
        self.attitudes, self._heights, self.certainty = Attitudes(), Heights(), Certainty()
        self.readiness = Readiness()
        self._answer: str | None = None  # the newest answer, until `take_answer`
        self._own_component = own_component
        self._heard_s = -math.inf
        # Each receiver with a fix: lat_deg, lon_deg, standard deviation, time.
        self._gps: dict[str, tuple[float, float, float, float]] = {}

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
        """Return the last report, with roll, pitch and heading at the time of a frame as far as they are known."""
        vehicle, attitude = self.vehicle, self.attitudes.at(t_mono_s)
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
        return False

    def _hear_position(self, message: Message, now_s: float) -> None:
        by_gps_m = self._gps_sd_m(message, now_s)
        if by_gps_m is not None:
            self.certainty.note_known(by_gps_m, now_s)
        self.vehicle = _vehicle(
            message,
            t_heard_s=now_s,
            has_gps=by_gps_m is not None,
            height_m=self._heights.now(message.relative_alt / 1e3, now_s),
            position_sd_m=self.certainty.now(now_s),
        )

    def _hear_gps(self, message: Message, now_s: float) -> None:
        if message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
            self._gps[message.get_type()] = (message.lat / 1e7, message.lon / 1e7, gps_sd_m(message), now_s)
        else:
            self._gps.pop(message.get_type(), None)

    def _gps_sd_m(self, position: Message, now_s: float) -> float | None:
        """Return the standard deviation of the best receiver that is near a position; None where none is."""
        here = position.lat / 1e7, position.lon / 1e7
        near = (
            sd_m
            for lat_deg, lon_deg, sd_m, t_s in self._gps.values()
            if now_s - t_s <= GPS_GONE_AFTER_S and float(distance_m(*here, lat_deg, lon_deg)) <= GPS_AGREES_WITHIN_M
        )
        return min(near, default=None)

    def _is_for_us(self, message: Message) -> bool:
        """Tell whether a message is no answer to the command of another."""
        return message.get_type() != "COMMAND_ACK" or message.target_component in (0, self._own_component)  # 0: to all

    def _hear_ack(self, message: Message) -> None:
        is_final = message.result != mavlink.MAV_RESULT_IN_PROGRESS
        if message.command == POSITION_FIX and is_final and self._is_for_us(message):
            known = mavlink.enums["MAV_RESULT"].get(message.result)
            self._answer = known.name.removeprefix("MAV_RESULT_") if known else str(message.result)
            self.acks[self._answer] += 1


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
        velocity_m_s=(east_m_s, north_m_s) if math.hypot(east_m_s, north_m_s) <= FASTEST_M_S else None,
        **known,
    )
