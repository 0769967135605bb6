"""Rules of `edgevpr doctor` for each firmware: whether the channel that the flight will choose can carry positions to
this vehicle, and which parameters to change if not.

Every rule of ArduPilot is based on the sources of 4.7-dev, every rule of PX4 on those of 1.17-alpha; their channels
were flown in simulation with GPS taken away, with PX4 1.17.0 and 1.18-beta1.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from edgevpr.mavlink.asking import AutopilotReading
from edgevpr.mavlink.channel import (
    ARDUPILOT_PARAMETERS,
    CONTROL,
    FUSES_POSITION,
    MAVLINK_GPS,
    PX4_PARAMETERS,
    SECOND,
    VISION_CONTROL,
    Channel,
    Choice,
    Kind,
    ardupilot_choice,
    px4_choice,
    receiver_name,
)
from edgevpr.mavlink.messages import SENSOR_ID
from edgevpr.runtime.service.finding import Finding, fine, judged, wrong

Parameters = Mapping[str, float | int]

_USE_BEST, _PRIMARY_WHILE_FIXED = 1, 4  # values of GPS_AUTO_SWITCH that use the other receiver if the first has no fix
_FROM_GPS, _FROM_FLOW, _FROM_VISION = 3, 5, 6  # values of EK3_SRCn_...
_SWITCH = f"GPS_AUTO_SWITCH={_USE_BEST}"
_SOURCE_SETS = (1, 2, 3)
_VISION_SET = tuple(f"EK3_SRC2_{what}={value}" for what, value in (("POSXY", 6), ("VELXY", 0), ("POSZ", 1), ("YAW", 1)))
_MOST_DELAY_MS = 50  # edgevpr sends its position for the moment of sending


@dataclass(frozen=True, slots=True, kw_only=True)
class FirmwareRules:
    """Rules of one firmware. `knows_fixes`: first version (major, minor) that takes position fixes. `parameters`: names
    of the parameters to be read. `findings` checks the answers of an autopilot for a flight that sends fixes or not.
    `port_changes` takes a baud rate and returns the parameters that the autopilot's serial port needs for it, each as a
    text such as "SERIALn_PROTOCOL=2" (n: the number of the port)."""

    name: str
    knows_fixes: tuple[int, int]
    parameters: tuple[str, ...]
    findings: Callable[[AutopilotReading, bool], Iterator[Finding]]
    port_changes: Callable[[int], tuple[str, ...]]


def _ardupilot_findings(reading: AutopilotReading, sends_fixes: bool) -> Iterator[Finding]:
    parameters, choice = reading.parameters, ardupilot_choice(reading.kind, reading.parameters)
    wanted = (("EK3_ENABLE", 1), ("AHRS_EKF_TYPE", 3))
    changes = [f"{name}={value}" for name, value in wanted if parameters.get(name, value) != value]
    good, bad = "the filter that takes fixes is in use", "Only the third EKF takes fixes: use it, and reboot."
    yield judged("EKF3", not changes, good, bad, *changes)
    if choice.channel.is_continuous and not sends_fixes:
        yield _dry(choice, reading)
    elif choice.channel is Channel.GPS_INPUT:
        yield _by_gps(choice, parameters)
    elif choice.channel is Channel.ODOMETRY:
        yield _by_odometry(choice, reading)
    else:
        channel = _single_fixes(choice, reading)
        if not channel.ok and not sends_fixes:
            needs = f"The first flight with fixes on needs {' and '.join(channel.changes)}: {channel.message}"
            channel = fine("channel", f"A dry run (`send_fixes: false`) needs no change. {needs}")
        yield channel
    yield _port(reading, "SERIALn_PROTOCOL=2")


def _single_fixes(choice: Choice, reading: AutopilotReading) -> Finding:
    """Check the use of command 43003, which sends single fixes: something else, such as airspeed or optical flow, must
    carry the vehicle's position from one fix to the next."""
    parameters, kind = reading.parameters, reading.kind
    hovers = parameters.get("Q_ENABLE") == 1  # only planes have it, whatever type the heartbeat reports
    if kind is Kind.PLANE and not hovers:
        return fine("channel", _sentence(choice.reason))
    flow = parameters.get("FLOW_TYPE", 0)
    if flow and _sets_with(parameters, "VELXY", _FROM_FLOW):
        return fine("channel", f"Command 43003: FLOW_TYPE={flow:g} carries it from fix to fix.")
    # ArduPlane's ekf_check.cpp: QHOVER while the pilot flies it with the sticks, QLAND while it flies by itself.
    end = "falls back to QHOVER or QLAND" if hovers else "stops" if kind is Kind.ROVER else "lands"
    while_it = " while it hovers (Q_ENABLE=1)" if hovers else ""
    unused = " FLOW_TYPE is set, but no EK3_SRCn_VELXY is 5, so the flow is not used." if flow else ""
    second = receiver_name(parameters, SECOND)
    if taken := parameters.get(second, 0):
        unused += f" It takes the place of the second receiver (type {taken:g})."
    return wrong(
        "channel",
        f"This {reading.vehicle} has nothing that carries it from one fix to the next{while_it}: without GPS it {end} "
        f"by its EKF failsafe after some 9 s.{unused} Let it take edgevpr for a second GPS receiver, and reboot.",
        f"{second}={MAVLINK_GPS}",
        *(() if _switches(parameters.get("GPS_AUTO_SWITCH")) else (_SWITCH,)),
    )


def _by_gps(choice: Choice, parameters: Parameters) -> Finding:
    changes = []
    if choice.receiver == SECOND and not _switches(parameters.get("GPS_AUTO_SWITCH", _USE_BEST)):
        changes.append(_SWITCH)
    if not _sets_with(parameters, "POSXY", _FROM_GPS):
        changes.append(f"EK3_SRC1_POSXY={_FROM_GPS}")
    unused = f"{choice.reason}, but it would not be used."
    return judged("channel", not changes, _sentence(choice.reason), unused, *changes)


def _by_odometry(choice: Choice, reading: AutopilotReading) -> Finding:
    sets = _sets_with(reading.parameters, "POSXY", _FROM_VISION)
    if not sets:
        no_set = f"{choice.reason}, but no source set of the filter takes its position: prepare the second one."
        return wrong("channel", no_set, *_VISION_SET)
    # VISO_VEL_M_NSE: the filter assumes that the velocity is good to 0.1 m/s, whatever accuracy edgevpr sends.
    if fused := [n for n in sets if n in _sets_with(reading.parameters, "VELXY", _FROM_VISION)]:
        return wrong(
            "channel",
            f"{choice.reason}, but its velocity, which comes from the same matches as the position, must not be fused: "
            "the filter would trust it more than its gyros.",
            *(f"EK3_SRC{n}_VELXY=0" for n in fused),
        )
    if reading.origin is None:
        no_origin = f"{choice.reason}, but the filter has no origin: it cannot be placed on the Earth."
        return wrong("channel", no_origin, "wait for a GPS fix, or set the EKF origin from the ground station")
    switch = "" if 1 in sets else f"; when GPS is lost, the operator switches to source set {sets[0]}"
    return fine("channel", _sentence(f"{choice.reason}{switch}"))


def _dry(choice: Choice, reading: AutopilotReading) -> Finding:
    """Return the finding about a continuous channel in a dry run, which sends no positions: ArduPilot does not arm
    without positions on every channel that is set up."""
    change = "VISO_TYPE=0"
    if choice.channel is Channel.GPS_INPUT:
        change = f"{receiver_name(reading.parameters, choice.receiver)}={0 if choice.receiver == SECOND else 1}"
    return wrong(
        "channel",
        f"{choice.reason}. A dry run (`send_fixes: false`) sends no position that way, so this {reading.vehicle} would "
        "not arm: change this until the first flight with fixes on, and reboot.",
        change,
    )


def _px4_findings(reading: AutopilotReading, _sends_fixes: bool) -> Iterator[Finding]:
    yield _px4_channel(px4_choice(reading.kind, reading.parameters), reading)
    yield _port(reading, "MAV_PROTO_VER=2")


def _px4_channel(choice: Choice, reading: AutopilotReading) -> Finding:
    parameters = reading.parameters
    is_vision = choice.channel is Channel.VISION
    if CONTROL not in parameters and not is_vision:
        return _px4_single_fixes(choice, reading)
    by_296 = (
        (choice.channel is not Channel.COMMAND, f"{CONTROL}={FUSES_POSITION}"),
        (parameters.get("EKF2_AGP0_ID", SENSOR_ID) == SENSOR_ID, f"EKF2_AGP0_ID={SENSOR_ID}"),
        (parameters.get("EKF2_AGP0_DELAY", 0) <= _MOST_DELAY_MS, "EKF2_AGP0_DELAY=0"),
    )
    by_odometry = (
        (parameters.get("EKF2_EV_NOISE_MD", 0) == 0, "EKF2_EV_NOISE_MD=0"),
        (parameters.get("EKF2_EV_DELAY", 0) <= _MOST_DELAY_MS, "EKF2_EV_DELAY=0"),
    )
    changes = [change for is_so, change in (by_odometry if is_vision else by_296) if not is_so]
    message = "ODOMETRY" if is_vision else "message 296"
    unset = f"PX4 can take positions as measurements ({message}), but is not set for it as edgevpr sends them"
    return judged("channel", not changes, _sentence(choice.reason), f"{unset}: change this, and reboot.", *changes)


def _px4_single_fixes(choice: Choice, reading: AutopilotReading) -> Finding:
    """Return the finding about command 43003. That a copter may use optical flow is no news: PX4 may by default."""
    if reading.kind is Kind.PLANE:
        return fine("channel", _sentence(choice.reason))
    others = ", unless another system aboard sends ODOMETRY" if reading.parameters.get(VISION_CONTROL) else ""
    return wrong(
        "channel",
        f"This {reading.vehicle} has nothing that carries it from one fix to the next: without GPS its position is "
        "lost after some seconds, and its failsafe decides. Let it take positions as measurements: change this, and "
        "reboot.",
        f"{VISION_CONTROL}={FUSES_POSITION}{others}",
    )


def _port(reading: AutopilotReading, change: str) -> Finding:
    old = "It speaks MAVLink 1, which knows neither signatures nor new messages."
    return judged("port", not reading.says_version_1, "MAVLink 2", old, change)


def _sentence(words: str) -> str:
    """Return a reason of a few words as a sentence, with a capital letter and a full stop."""
    return f"{words[0].upper()}{words[1:]}."


def _switches(how: float | None) -> bool:
    return how in (_USE_BEST, _PRIMARY_WHILE_FIXED)


def _sets_with(parameters: Parameters, what: str, source: int) -> list[int]:
    return [n for n in _SOURCE_SETS if parameters.get(f"EK3_SRC{n}_{what}") == source]


RULES = {
    "ardupilot": FirmwareRules(
        name="ArduPilot",
        knows_fixes=(4, 5),  # release notes of 4.5.0: MAV_CMD_EXTERNAL_POSITION_ESTIMATE
        parameters=(
            *ARDUPILOT_PARAMETERS, "GPS_AUTO_SWITCH", "FLOW_TYPE", "Q_ENABLE", "AHRS_EKF_TYPE", "EK3_ENABLE",
            *(f"EK3_SRC{n}_{what}" for n in _SOURCE_SETS for what in ("POSXY", "VELXY")),
        ),
        findings=_ardupilot_findings,
        port_changes=lambda baud: ("SERIALn_PROTOCOL=2", f"SERIALn_BAUD={baud // 1000}"),
    ),
    "px4": FirmwareRules(
        name="PX4",
        knows_fixes=(1, 15),
        parameters=(
            *PX4_PARAMETERS, "EKF2_AGP0_ID", "EKF2_AGP0_DELAY", "EKF2_EV_DELAY", "EKF2_EV_NOISE_MD",
        ),
        findings=_px4_findings,
        # TELEM 2, the usual port for a companion.
        port_changes=lambda baud: ("MAV_1_CONFIG=102", "MAV_1_MODE=2", f"SER_TEL2_BAUD={baud}"),
    ),
}  # fmt: skip
