"""Advice for ArduPilot: is the channel that the flight will choose one that carries this vehicle, and what is to be
changed? Every rule has its source here: ArduPilot 4.7-dev, flown in simulation with GPS taken away."""

from collections.abc import Iterator, Mapping

from edgevpr.mavlink.channel import (
    ARDUPILOT,
    MAVLINK_GPS,
    SECOND,
    Channel,
    Choice,
    Kind,
    ardupilot_choice,
    receiver_name,
)
from edgevpr.mavlink.reading import AutopilotReading
from edgevpr.runtime.service.finding import Finding, Plan, sentence

Parameters = Mapping[str, float | int]

_SERIALS, _SOURCE_SETS = range(10), (1, 2, 3)
PARAMETERS = (
    *ARDUPILOT.parameters, "GPS_AUTO_SWITCH", "FLOW_TYPE", "ARSPD_TYPE", "ARSPD_USE", "Q_ENABLE", "AHRS_EKF_TYPE",
    "EK3_ENABLE",
    *(f"EK3_SRC{n}_{what}" for n in _SOURCE_SETS for what in ("POSXY", "VELXY", "POSZ", "YAW")),
    *(f"SERIAL{n}_{what}" for n in _SERIALS for what in ("PROTOCOL", "BAUD")),
)  # fmt: skip

_USE_BEST, _PRIMARY_WHILE_FIXED = 1, 4  # GPS_AUTO_SWITCH: both take the other receiver when the first has no fix
_FROM_GPS, _FROM_FLOW, _FROM_VISION = 3, 5, 6  # EK3_SRCn_...
_NO_RECEIVER, _ANY_RECEIVER = 0, 1  # GPSn_TYPE
_MAVLINK_1, _MAVLINK_2 = 1, 2  # SERIALn_PROTOCOL
KNOWS_FIXES = (4, 5)  # release notes of 4.5.0: MAV_CMD_EXTERNAL_POSITION_ESTIMATE
_SHORT_BAUDS = {111_100: 111}  # SERIALn_BAUD is in thousands, rounded down; above 2000 it is the rate itself


def findings(reading: AutopilotReading, plan: Plan) -> Iterator[Finding]:
    """Judge what was read of an ArduPilot."""
    yield _filter_used(reading.parameters)
    chosen = ardupilot_choice(reading.asked)
    if chosen.channel.is_continuous and not plan.sends_fixes:
        yield _dry(chosen, reading)
    elif chosen.channel is Channel.GPS_INPUT:
        yield _gps(chosen, reading.parameters)
    elif chosen.channel is Channel.ODOMETRY:
        yield _odometry(chosen, reading)
    else:
        found = _single_fixes(chosen, reading)
        yield found if found.ok or plan.sends_fixes else _not_yet(found)
        yield from _airspeed(reading)
    yield _ports(reading)


def port_changes(baud: int) -> tuple[str, ...]:
    """List what the port at the other end of a serial line needs (n: the number of the port)."""
    return f"SERIALn_PROTOCOL={_MAVLINK_2}", f"SERIALn_BAUD={_baud_code(baud)}"


def _filter_used(parameters: Parameters) -> Finding:
    wrong = [
        f"{name}={value}"
        for name, value in (("EK3_ENABLE", 1), ("AHRS_EKF_TYPE", 3))
        if parameters.get(name, value) != value
    ]
    if wrong:
        return Finding("EKF3", False, "Only the third EKF takes fixes: use it, and reboot.", tuple(wrong))
    return Finding("EKF3", True, "the filter that takes fixes is in use")


def _single_fixes(chosen: Choice, reading: AutopilotReading) -> Finding:
    """Judge command 43003: something else must carry the vehicle from one fix to the next."""
    parameters = reading.parameters
    hovers = parameters.get("Q_ENABLE") == 1  # a plane's, whatever type its heartbeat tells
    if reading.asked.kind is Kind.PLANE and not hovers:
        return Finding("channel", True, sentence(chosen.reason))
    has_flow = parameters.get("FLOW_TYPE", 0) != 0
    if has_flow and _sets_with(parameters, "VELXY", _FROM_FLOW):
        return Finding(
            "channel", True, f"Command 43003: FLOW_TYPE={parameters['FLOW_TYPE']:g} carries it from fix to fix."
        )
    # ArduPlane's ekf_check.cpp: the one looks on while the sticks fly it, the other while it flies by itself.
    end = "falls back to QHOVER or QLAND" if hovers else "stops" if reading.asked.kind is Kind.ROVER else "lands"
    unused = " FLOW_TYPE is set, but no EK3_SRCn_VELXY is 5, so the flow is not used." if has_flow else ""
    if taken := parameters.get(receiver_name(parameters, SECOND), 0):
        unused += f" It takes the place of the second receiver (type {taken:g})."
    return Finding(
        "channel",
        False,
        f"This {reading.vehicle} has nothing that carries it from one fix to the next"
        f"{' while it hovers (Q_ENABLE=1)' if hovers else ''}: without GPS it {end} by its EKF failsafe after some 9 "
        f"s.{unused} Let it take edgevpr for a second GPS receiver, and reboot.",
        _second_receiver(parameters),
    )


def _gps(chosen: Choice, parameters: Parameters) -> Finding:
    wrong = []
    switches = parameters.get("GPS_AUTO_SWITCH", _USE_BEST) in (_USE_BEST, _PRIMARY_WHILE_FIXED)
    if chosen.receiver == SECOND and not switches:
        wrong.append(f"GPS_AUTO_SWITCH={_USE_BEST}")
    if not _sets_with(parameters, "POSXY", _FROM_GPS):
        wrong.append(f"EK3_SRC1_POSXY={_FROM_GPS}")
    if wrong:
        return Finding("channel", False, f"{chosen.reason}, but it would not be used.", tuple(wrong))
    return Finding("channel", True, sentence(chosen.reason))


def _dry(chosen: Choice, reading: AutopilotReading) -> Finding:
    """Judge a continuous channel in a dry run, which sends no position: AP_Arming wants one of all that is set up."""
    if chosen.channel is Channel.GPS_INPUT:
        name = receiver_name(reading.parameters, chosen.receiver)
        change = f"{name}={_NO_RECEIVER if chosen.receiver == SECOND else _ANY_RECEIVER}"
    else:
        change = "VISO_TYPE=0"
    return Finding(
        "channel",
        False,
        f"{chosen.reason}. A dry run (`send_fixes: false`) sends no position that way, so this {reading.vehicle} would "
        "not arm: change this until the first flight with fixes on, and reboot.",
        (change,),
    )


def _not_yet(found: Finding) -> Finding:
    """Put off what only a flight with fixes needs: with a second receiver that has no fix a dry run would not arm."""
    return Finding(
        "channel",
        True,
        f"A dry run (`send_fixes: false`) needs no change. The first flight with fixes on needs "
        f"{' and '.join(found.changes)}: {found.message}",
    )


def _odometry(chosen: Choice, reading: AutopilotReading) -> Finding:
    sets = _sets_with(reading.parameters, "POSXY", _FROM_VISION)
    if not sets:
        wanted = {"POSXY": _FROM_VISION, "VELXY": 0, "POSZ": 1, "YAW": 1}
        return Finding(
            "channel",
            False,
            f"{chosen.reason}, but no source set of the filter takes its position: prepare the second one.",
            tuple(f"EK3_SRC2_{what}={value}" for what, value in wanted.items()),
        )
    if with_velocity := sorted(set(sets) & set(_sets_with(reading.parameters, "VELXY", _FROM_VISION))):
        # VISO_VEL_M_NSE: the velocity is taken to be good to 0.1 m/s, whatever accuracy we tell.
        return Finding(
            "channel",
            False,
            f"{chosen.reason}, but its velocity, which comes from the same matches as the position, must not be fused: "
            "the filter would trust it more than its gyros.",
            tuple(f"EK3_SRC{n}_VELXY=0" for n in with_velocity),
        )
    if reading.origin is None:
        return Finding(
            "channel",
            False,
            f"{chosen.reason}, but the filter has no origin: it cannot be placed on the Earth.",
            ("wait for a GPS fix, or set the EKF origin from the ground station",),
        )
    switch = "" if 1 in sets else f"; when GPS is lost, the operator switches to source set {sets[0]}"
    return Finding("channel", True, sentence(f"{chosen.reason}{switch}"))


def _airspeed(reading: AutopilotReading) -> Iterator[Finding]:
    if reading.asked.kind is not Kind.PLANE:
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


def _ports(reading: AutopilotReading) -> Finding:
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


def _second_receiver(parameters: Parameters) -> tuple[str, ...]:
    switch = parameters.get("GPS_AUTO_SWITCH") in (_USE_BEST, _PRIMARY_WHILE_FIXED)
    wanted = (f"{receiver_name(parameters, SECOND)}={MAVLINK_GPS}",)
    return wanted if switch else (*wanted, f"GPS_AUTO_SWITCH={_USE_BEST}")


def _sets_with(parameters: Parameters, what: str, source: int) -> list[int]:
    return [n for n in _SOURCE_SETS if parameters.get(f"EK3_SRC{n}_{what}") == source]


def _baud_code(baud: int) -> int:
    return _SHORT_BAUDS.get(baud, baud // 1000)
