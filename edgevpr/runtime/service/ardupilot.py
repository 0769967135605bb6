"""Advice for ArduPilot: by its parameters, how fixes will reach it, and what to change. Every rule has its source here:
ArduPilot 4.7-dev, flown in simulation with GPS taken away."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from edgevpr.mavlink.reading import Reading
from edgevpr.runtime.service.finding import Finding

Parameters = Mapping[str, float | int]

_SERIALS, _SOURCE_SETS = range(10), (1, 2, 3)
PARAMETERS = (
    "GPS1_TYPE", "GPS2_TYPE", "GPS_TYPE", "GPS_TYPE2", "GPS_AUTO_SWITCH", "VISO_TYPE", "FLOW_TYPE", "ARSPD_TYPE",
    "ARSPD_USE", "AHRS_EKF_TYPE", "EK3_ENABLE",
    *(f"EK3_SRC{n}_{what}" for n in _SOURCE_SETS for what in ("POSXY", "VELXY", "POSZ", "YAW")),
    *(f"SERIAL{n}_{what}" for n in _SERIALS for what in ("PROTOCOL", "BAUD")),
)  # fmt: skip

_GPS_NAMES = (("GPS1_TYPE", "GPS_TYPE"), ("GPS2_TYPE", "GPS_TYPE2"))  # since 4.6, and before
_OVER_MAVLINK = 14
_USE_BEST, _PRIMARY_WHILE_FIXED = 1, 4  # GPS_AUTO_SWITCH: both take the other receiver when the first has no fix
_FROM_GPS, _FROM_FLOW, _FROM_VISION = 3, 5, 6  # EK3_SRCn_...
_MAVLINK_1, _MAVLINK_2 = 1, 2  # SERIALn_PROTOCOL
_KNOWS_FIXES = (4, 5)  # release notes of 4.5.0: MAV_CMD_EXTERNAL_POSITION_ESTIMATE
_SHORT_BAUDS = {111_100: 111}  # SERIALn_BAUD is in thousands, rounded down; above 2000 it is the rate itself


@dataclass(frozen=True, slots=True)
class Channel:
    """The way that fixes take: "gps", "odometry" or "single fixes", and the parameter that decides it."""

    name: str
    reason: str


def channel(vehicle: str, parameters: Parameters) -> Channel | None:
    """Choose the way of the fixes by the parameters; None where there is no safe one for this vehicle."""
    if receiver := _mavlink_receiver(parameters):
        return Channel("gps", f"{_gps_name(parameters, receiver)}=14")
    if parameters.get("VISO_TYPE") == 1:
        return Channel("odometry", "VISO_TYPE=1")
    if vehicle == "plane":
        return Channel("single fixes", "a plane goes on by dead reckoning")
    if parameters.get("FLOW_TYPE", 0) != 0 and _sets_with(parameters, "VELXY", _FROM_FLOW):
        return Channel("single fixes", f"FLOW_TYPE={parameters['FLOW_TYPE']:g} holds the velocity")
    return None


def findings(reading: Reading) -> Iterator[Finding]:
    """Judge what was read of an ArduPilot."""
    yield _firmware(reading)
    yield _filter_used(reading.parameters)
    chosen = channel(reading.vehicle, reading.parameters)
    if chosen is None:
        yield _no_channel(reading)
    elif chosen.name == "gps":
        yield _gps(chosen, reading.parameters)
    elif chosen.name == "odometry":
        yield _odometry(chosen, reading)
    else:
        yield Finding("channel", True, f"Single fixes by command 43003: {chosen.reason}.")
        yield from _airspeed(reading)
    yield _ports(reading)


def port_changes(baud: int) -> tuple[str, ...]:
    """List what the port at the other end of a serial line needs (n: the number of the port)."""
    return f"SERIALn_PROTOCOL={_MAVLINK_2}", f"SERIALn_BAUD={_baud_code(baud)}"


def _firmware(reading: Reading) -> Finding:
    version = reading.version
    if version is None:
        return Finding("firmware", False, "ArduPilot does not tell its version: update it to 4.5 or later.")
    if version[:2] < _KNOWS_FIXES:
        return Finding(
            "firmware",
            False,
            f"ArduPilot {reading.version_text} does not know position fixes (command 43003): update it.",
            ("ArduPilot 4.5 or later",),
        )
    return Finding("firmware", True, f"ArduPilot {reading.version_text}, {reading.vehicle}")


def _filter_used(parameters: Parameters) -> Finding:
    wrong = [
        f"{name}={value}"
        for name, value in (("EK3_ENABLE", 1), ("AHRS_EKF_TYPE", 3))
        if parameters.get(name, value) != value
    ]
    if wrong:
        return Finding("EKF3", False, "Only the third EKF takes fixes: use it, and reboot.", tuple(wrong))
    return Finding("EKF3", True, "the filter that takes fixes is in use")


def _no_channel(reading: Reading) -> Finding:
    parameters = reading.parameters
    end = "stops" if reading.vehicle == "rover" else "lands"
    unused = ""
    if parameters.get("FLOW_TYPE", 0) != 0:
        unused = " FLOW_TYPE is set, but no EK3_SRCn_VELXY is 5, so the flow is not used."
    if taken := parameters.get(_gps_name(parameters, 2), 0):
        unused += f" It takes the place of the second receiver (type {taken:g})."
    return Finding(
        "channel",
        False,
        f"This {reading.vehicle} has nothing that carries it from one fix to the next: without GPS it {end} by its EKF "
        f"failsafe after some 9 s.{unused} Let it take edgevpr for a second GPS receiver, and reboot.",
        _second_receiver(parameters),
    )


def _gps(chosen: Channel, parameters: Parameters) -> Finding:
    wrong = []
    if _mavlink_receiver(parameters) == 2 and parameters.get("GPS_AUTO_SWITCH", _USE_BEST) not in (
        _USE_BEST,
        _PRIMARY_WHILE_FIXED,
    ):
        wrong.append(f"GPS_AUTO_SWITCH={_USE_BEST}")
    if not _sets_with(parameters, "POSXY", _FROM_GPS):
        wrong.append(f"EK3_SRC1_POSXY={_FROM_GPS}")
    if wrong:
        return Finding(
            "channel", False, f"A GPS receiver over MAVLink ({chosen.reason}), but it would not be used.", tuple(wrong)
        )
    return Finding("channel", True, f"A GPS receiver over MAVLink (GPS_INPUT): {chosen.reason}.")


def _odometry(chosen: Channel, reading: Reading) -> Finding:
    sets = _sets_with(reading.parameters, "POSXY", _FROM_VISION)
    if not sets:
        wanted = {"POSXY": _FROM_VISION, "VELXY": _FROM_VISION, "POSZ": 1, "YAW": 1}
        return Finding(
            "channel",
            False,
            f"ODOMETRY ({chosen.reason}), but no source set of the filter takes its position: prepare the second one.",
            tuple(f"EK3_SRC2_{what}={value}" for what, value in wanted.items()),
        )
    if reading.origin is None:
        return Finding(
            "channel",
            False,
            f"ODOMETRY ({chosen.reason}), but the filter has no origin: it cannot be placed on the Earth.",
            ("wait for a GPS fix, or set the EKF origin from the ground station",),
        )
    switch = "" if 1 in sets else f"; when GPS is lost, the operator switches to source set {sets[0]}"
    return Finding("channel", True, f"ODOMETRY: {chosen.reason}{switch}.")


def _airspeed(reading: Reading) -> Iterator[Finding]:
    if reading.vehicle != "plane":
        return
    parameters = reading.parameters
    if parameters.get("ARSPD_TYPE", 0) and parameters.get("ARSPD_USE") == 1:
        yield Finding("airspeed", True, "a sensor is in use, so the wind is known")
    else:
        yield Finding(
            "airspeed",
            True,
            "no sensor is in use (ARSPD_TYPE, ARSPD_USE=1), so it drifts faster between two fixes",
        )


def _ports(reading: Reading) -> Finding:
    parameters = reading.parameters
    ports = {n: parameters.get(f"SERIAL{n}_PROTOCOL") for n in _SERIALS}
    if reading.says_version_1:
        wrong = tuple(f"SERIAL{n}_PROTOCOL={_MAVLINK_2}" for n, protocol in ports.items() if protocol == _MAVLINK_1)
        return Finding(
            "port", False, "It speaks MAVLink 1, which knows neither signatures nor new messages.", wrong or
            (f"SERIALn_PROTOCOL={_MAVLINK_2}",),
        )  # fmt: skip
    speaking = [
        f"SERIAL{n} (baud {parameters.get(f'SERIAL{n}_BAUD', 0):g})"
        for n, protocol in ports.items()
        if protocol in (1, 2)
    ]
    return Finding("port", True, f"MAVLink 2; set for MAVLink: {', '.join(speaking) or 'unknown'}")


def _mavlink_receiver(parameters: Parameters) -> int | None:
    """Return the number of the GPS receiver that is fed over MAVLink: 1, 2, or None."""
    return next((n for n in (1, 2) if parameters.get(_gps_name(parameters, n)) == _OVER_MAVLINK), None)


def _gps_name(parameters: Parameters, receiver: int) -> str:
    """Return the name that this firmware has for the type of a receiver."""
    new, old = _GPS_NAMES[receiver - 1]
    return old if old in parameters and new not in parameters else new


def _second_receiver(parameters: Parameters) -> tuple[str, ...]:
    switch = parameters.get("GPS_AUTO_SWITCH") in (_USE_BEST, _PRIMARY_WHILE_FIXED)
    wanted = (f"{_gps_name(parameters, 2)}={_OVER_MAVLINK}",)
    return wanted if switch else (*wanted, f"GPS_AUTO_SWITCH={_USE_BEST}")


def _sets_with(parameters: Parameters, what: str, source: int) -> list[int]:
    return [n for n in _SOURCE_SETS if parameters.get(f"EK3_SRC{n}_{what}") == source]


def _baud_code(baud: int) -> int:
    return _SHORT_BAUDS.get(baud, baud // 1000)
