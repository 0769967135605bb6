"""Rules of `edgevpr doctor` for each firmware: whether the channel that the flight will choose can carry positions to
this vehicle, and which parameters to change if not.

Every rule of ArduPilot is based on the sources of 4.7-dev, every rule of PX4 on those of 1.17-alpha; their channels
were flown in simulation with GPS taken away, with PX4 1.17.0 and 1.18-beta1.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from edgevpr.mavlink.ardupilot_parameters import ARDUPILOT_TABLE, MAVLINK_GPS, RECEIVERS, SECOND
from edgevpr.mavlink.asking import AutopilotReading
from edgevpr.mavlink.channel import Channel, Choice, Kind, Parameters, own_name
from edgevpr.mavlink.parameters import ParameterTable
from edgevpr.mavlink.px4_parameters import CONTROL, FUSES_POSITION, PX4_TABLE, VISION_CONTROL
from edgevpr.runtime.service.finding import Finding, fine, judge, wrong

_SWITCHES = (1, 4)  # values of GPS_AUTO_SWITCH that use the other receiver if the first has no fix
_FROM_FLOW, _FROM_VISION = 5, 6  # values of EK3_SRCn_...
_SOURCE_SETS = (1, 2, 3)


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
    choice = ARDUPILOT_TABLE.choose(reading.kind, reading.parameters)
    if choice.channel.is_continuous and not sends_fixes:
        yield _dry(choice, reading)
    elif choice.channel is Channel.GPS_INPUT:
        yield fine("channel", _sentence(choice.reason))
    elif choice.channel is Channel.ODOMETRY:
        yield _by_odometry(choice, reading)
    else:
        channel = _single_fixes(choice, reading)
        if not channel.ok and not sends_fixes:
            needs = f"The first flight with fixes on needs {' and '.join(channel.changes)}: {channel.message}"
            channel = fine("channel", f"A dry run (`send_fixes: false`) needs no change. {needs}")
        yield channel
    yield from _parameters(ARDUPILOT_TABLE, choice, reading)
    yield _port(reading, "SERIALn_PROTOCOL=2")


def _parameters(table: ParameterTable, choice: Choice, reading: AutopilotReading) -> Iterator[Finding]:
    """Check the parameters that change what our messages do: one finding for each row of the table that is broken."""
    faults = table.find_faults(choice, reading.parameters)
    for fault in faults:
        stops = " Until then edgevpr sends nothing." if fault.rule.is_dangerous else ""
        yield wrong(fault.rule.label, f"{fault.rule.why}{stops}", *fault.changes)
    if not faults:
        yield fine("parameters", "all that affect positions of edgevpr are right")


def _single_fixes(choice: Choice, reading: AutopilotReading) -> Finding:
    """Check the use of command 43003, which sends single fixes: something else, such as airspeed or optical flow, must
    carry the vehicle's position from one fix to the next."""
    parameters = reading.parameters
    hovers = parameters.get("Q_ENABLE") == 1  # only planes have it, whatever type the heartbeat reports
    if reading.kind is Kind.PLANE and not hovers:
        return fine("channel", _sentence(choice.reason))
    flow = parameters.get("FLOW_TYPE", 0)
    if flow and _sets_with(parameters, "VELXY", _FROM_FLOW):
        return fine("channel", f"Command 43003; optical flow (FLOW_TYPE={flow:g}) carries it from fix to fix.")
    second = own_name(parameters, RECEIVERS[SECOND])
    replaced = f", in place of its receiver of type {taken:g}" if (taken := parameters.get(second, 0)) else ""
    return wrong(
        "channel",
        f"Nothing carries this {reading.vehicle} from one fix to the next, so without GPS its EKF failsafe acts after "
        f"some 9 s. Let it use edgevpr as the second GPS receiver{replaced}, and reboot.",
        f"{second}={MAVLINK_GPS}",
        *(() if parameters.get("GPS_AUTO_SWITCH") in _SWITCHES else ("GPS_AUTO_SWITCH=1",)),
    )


def _by_odometry(choice: Choice, reading: AutopilotReading) -> Finding:
    sets = _sets_with(reading.parameters, "POSXY", _FROM_VISION)
    switch = "" if not sets or 1 in sets else f"; when GPS is lost, the operator switches to source set {sets[0]}"
    return fine("channel", _sentence(f"{choice.reason}{switch}"))


def _dry(choice: Choice, reading: AutopilotReading) -> Finding:
    """Return the finding about a continuous channel in a dry run, which sends no positions: ArduPilot does not arm
    without positions on every channel that is set up."""
    change = "VISO_TYPE=0"
    if choice.channel is Channel.GPS_INPUT:
        change = f"{own_name(reading.parameters, RECEIVERS[choice.receiver])}={0 if choice.receiver == SECOND else 1}"
    return wrong(
        "channel",
        f"{choice.reason}. A dry run (`send_fixes: false`) sends no position that way, so this {reading.vehicle} would "
        "not arm: change this until the first flight with fixes on, and reboot.",
        change,
    )


def _px4_findings(reading: AutopilotReading, _sends_fixes: bool) -> Iterator[Finding]:
    choice = PX4_TABLE.choose(reading.kind, reading.parameters)
    if choice.channel is not Channel.COMMAND:
        yield fine("channel", _sentence(choice.reason))
    elif CONTROL in reading.parameters:
        choice = replace(choice, channel=Channel.SENSOR)  # for the other parameters that it will need
        yield wrong(
            "channel",
            "PX4 can use positions as measurements (message 296), but is not set up for it: change this, and reboot.",
            f"{CONTROL}={FUSES_POSITION}",
        )
    else:
        yield _px4_single_fixes(choice, reading)
    yield from _parameters(PX4_TABLE, choice, reading)
    yield _port(reading, "MAV_PROTO_VER=2")


def _px4_single_fixes(choice: Choice, reading: AutopilotReading) -> Finding:
    if reading.kind is Kind.PLANE:
        return fine("channel", _sentence(choice.reason))
    others = ", unless another system aboard sends ODOMETRY" if reading.parameters.get(VISION_CONTROL) else ""
    return wrong(
        "channel",
        f"Nothing carries this {reading.vehicle} from one fix to the next, so without GPS its failsafe acts after some "
        "seconds. Let it use positions as measurements, and reboot.",
        f"{VISION_CONTROL}={FUSES_POSITION}{others}",
    )


def _port(reading: AutopilotReading, change: str) -> Finding:
    message = "It sends MAVLink 1, which has neither signatures nor new messages."
    return judge("port", not reading.says_version_1, "MAVLink 2", message, change)


def _sentence(words: str) -> str:
    """Return a reason of a few words as a sentence, with a capital letter and a full stop."""
    return f"{words[0].upper()}{words[1:]}."


def _sets_with(parameters: Parameters, what: str, source: int) -> list[int]:
    return [n for n in _SOURCE_SETS if parameters.get(f"EK3_SRC{n}_{what}") == source]


RULES = {
    "ardupilot": FirmwareRules(
        name="ArduPilot",
        knows_fixes=(4, 5),  # release notes of 4.5.0: MAV_CMD_EXTERNAL_POSITION_ESTIMATE
        parameters=(*ARDUPILOT_TABLE.names, "FLOW_TYPE", "Q_ENABLE"),
        findings=_ardupilot_findings,
        port_changes=lambda baud: ("SERIALn_PROTOCOL=2", f"SERIALn_BAUD={baud // 1000}"),
    ),
    "px4": FirmwareRules(
        name="PX4",
        knows_fixes=(1, 15),
        parameters=PX4_TABLE.names,
        findings=_px4_findings,
        # TELEM 2, the usual port for a companion.
        port_changes=lambda baud: ("MAV_1_CONFIG=102", "MAV_1_MODE=2", f"SER_TEL2_BAUD={baud}"),
    ),
}
