"""All that an autopilot tells about itself before the flight, as plain values. Used by `edgevpr doctor`."""

import statistics
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from edgevpr.mavlink.asking import Inquiry
from edgevpr.mavlink.channel import Answers, Kind, kind_of
from edgevpr.mavlink.wire import Message, mavlink

LISTEN_S = 4.0
ROUND_TRIPS = 10

_FIRMWARES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", mavlink.MAV_AUTOPILOT_PX4: "px4"}
_RELEASES = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}  # FIRMWARE_VERSION_TYPE
_BYTEWISE = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotReading:
    """The answers of an autopilot; None and empty stand for what it did not answer.

    `firmware` is "ardupilot", "px4" or "other"; `vehicle` is the value of a `Kind`. `streams_hz` is the rate of the
    messages that came unasked, `heard` the names of all that came. `gps_fix` is the fix type of the first and second
    receiver. `filter_flags` are those of EKF_STATUS_REPORT or ESTIMATOR_STATUS. `origin` is (latitude, longitude) in
    degrees. `signs`: its messages are signed; `is_signed_to`: ours are. `answers`: it has answered any question;
    `says_version_1`: it sends MAVLink 1. `clock_ahead_s` is its UTC less that of this machine.
    """

    system_id: int
    firmware: str
    vehicle: str
    is_armed: bool
    version: tuple[int, int, int] | None
    version_text: str | None
    parameters: dict[str, float | int]
    streams_hz: dict[str, float]
    heard: tuple[str, ...]
    gps_fix: tuple[int | None, int | None]
    filter_flags: int | None
    origin: tuple[float, float] | None
    signs: bool
    is_signed_to: bool
    answers: bool
    says_version_1: bool
    other_systems: tuple[int, ...]
    bad_bytes: int
    round_trip_s: float | None
    clock_ahead_s: float | None

    @property
    def asked(self) -> Answers:
        """The answers on which the flight bases its choice of the channel."""
        return Answers(kind=Kind(self.vehicle), version=self.version and self.version[:2], parameters=self.parameters)


def read_autopilot(asking: Inquiry, wanted: Mapping[str, Iterable[str]]) -> AutopilotReading | None:
    """Read all that can be read; return None if no heartbeat comes. `wanted`: names of parameters, by firmware.

    It takes ten seconds, or half a minute if the autopilot does not answer. Raises LinkError when the link is lost.
    """
    beat = asking.heartbeat()
    if beat is None:
        return None
    firmware = _FIRMWARES.get(beat.autopilot, "other")
    before = asking.heard.copy()
    asking.listen(LISTEN_S)
    streams_hz = {name: count / LISTEN_S for name, count in sorted((asking.heard - before).items())}
    said = asking.message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    trips_s = asking.round_trips_s(ROUND_TRIPS if said else 1)
    answers = bool(said or trips_s or asking.heard["COMMAND_ACK"])
    ask = asking.message if answers else _no_message
    is_px4 = firmware == "px4"
    report = ask(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS if is_px4 else mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    first, second = ask(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT), ask(mavlink.MAVLINK_MSG_ID_GPS2_RAW)
    for message_id in (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, mavlink.MAVLINK_MSG_ID_ATTITUDE):
        ask(message_id)
    origin, clock = ask(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN), ask(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME)
    clock_ahead_s = clock.time_unix_usec / 1e6 - time.time() if clock and clock.time_unix_usec else None
    bytewise = bool(said.capabilities & _BYTEWISE) if said else is_px4
    names = wanted.get(firmware, ()) if answers else ()
    return AutopilotReading(
        system_id=beat.get_srcSystem(),
        firmware=firmware,
        vehicle=kind_of(beat.type).value,
        is_armed=bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
        version=_version(said.flight_sw_version) if said else None,
        version_text=_version_text(said.flight_sw_version) if said else None,
        parameters=asking.parameters(names, bytewise),
        streams_hz=streams_hz,
        heard=tuple(sorted(asking.heard)),
        gps_fix=(first and first.fix_type, second and second.fix_type),
        filter_flags=report and report.flags,
        origin=(origin.latitude / 1e7, origin.longitude / 1e7) if origin else None,
        signs=asking.signed > 0,
        is_signed_to=asking.signs,
        answers=answers,
        says_version_1=asking.says_version_1,
        other_systems=tuple(sorted(asking.others)),
        bad_bytes=asking.bad_bytes,
        round_trip_s=statistics.median(trips_s) if trips_s else None,
        clock_ahead_s=clock_ahead_s,
    )


def _no_message(message_id: int) -> Message | None:
    """Stand in for `Inquiry.message` if the autopilot answers nothing: each question would take three seconds."""
    return None


def _version(packed: int) -> tuple[int, int, int]:
    return packed >> 24, packed >> 16 & 255, packed >> 8 & 255


def _version_text(packed: int) -> str:
    major, minor, patch = _version(packed)
    return f"{major}.{minor}.{patch}{_RELEASES.get(packed & 255, '')}"
