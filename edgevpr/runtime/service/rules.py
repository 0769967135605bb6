"""Rules of `edgevpr doctor` for each firmware: whether the channel that the flight will choose can carry positions to
this vehicle, and which parameters to change if not.

Every rule of ArduPilot is based on the sources of 4.7-dev, every rule of PX4 on those of 1.17-alpha; their channels
were flown in simulation with GPS taken away, with PX4 1.17.0 and 1.18-beta1.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from edgevpr.mavlink.ardupilot_parameters import ARDUPILOT_TABLE, MAVLINK_GPS, RECEIVERS, SECOND
from edgevpr.mavlink.asking import AutopilotReading
from edgevpr.mavlink.channel import Channel, Choice, Kind, own_name
from edgevpr.mavlink.parameters import ParameterTable
from edgevpr.mavlink.px4_parameters import CONTROL, FUSES_POSITION, PX4_TABLE, VISION_CONTROL
from edgevpr.runtime.service.finding import Finding, fine, wrong
from edgevpr.runtime.service.findingcodes import FindingCode

_SWITCHES = (1, 4)  # values of GPS_AUTO_SWITCH that use the other receiver if the first has no fix
_FLOW_SOURCES = tuple(f"EK3_SRC{number}_VELXY" for number in (1, 2, 3))
_FROM_FLOW = 5


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
    if not choice.channel.is_continuous:
        yield _single_fixes(choice, reading, sends_fixes)
    elif sends_fixes:
        yield _channel(choice)
    else:
        yield _dry(choice, reading)
    yield from _parameters(ARDUPILOT_TABLE, choice, reading)
    yield _port(reading, "SERIALn_PROTOCOL=2")


def _channel(choice: Choice) -> Finding:
    return Finding(what="channel", ok=True, reason=choice.reason)


def _parameters(table: ParameterTable, choice: Choice, reading: AutopilotReading) -> Iterator[Finding]:
    """Check the parameters that change what our messages do: one finding for each row of the table that is broken."""
    faults = table.find_faults(choice, reading.parameters)
    for fault in faults:
        yield Finding(what=fault.rule.label, ok=False, reason=fault.reason, changes=fault.changes, exit_code=1)
    if not faults:
        yield fine("parameters", FindingCode.PARAMETERS_RIGHT)


def _single_fixes(choice: Choice, reading: AutopilotReading, sends_fixes: bool) -> Finding:
    """Check the use of command 43003, which sends single fixes: something else, such as airspeed or optical flow, must
    carry the vehicle's position from one fix to the next."""
    parameters = reading.parameters
    hovers = parameters.get("Q_ENABLE") == 1  # only planes have it, whatever type the heartbeat reports
    if reading.kind is Kind.PLANE and not hovers:
        return _channel(choice)
    flow = parameters.get("FLOW_TYPE", 0)
    if flow and any(parameters.get(name) == _FROM_FLOW for name in _FLOW_SOURCES):
        return fine("channel", FindingCode.COMMAND_WITH_FLOW, flow=flow)
    second = own_name(parameters, RECEIVERS[SECOND])
    changes = [f"{second}={MAVLINK_GPS}"]
    if parameters.get("GPS_AUTO_SWITCH") not in _SWITCHES:
        changes.append("GPS_AUTO_SWITCH=1")
    if not sends_fixes:
        return fine("channel", FindingCode.CHANGES_AFTER_DRY_RUN, changes=" and ".join(changes))
    replaced = parameters.get(second) or None
    figures = {"receiver_type": replaced, "parameter": None, "value": None}
    return wrong("channel", FindingCode.NOT_CARRIED, *changes, vehicle=reading.vehicle, **figures)


def _dry(choice: Choice, reading: AutopilotReading) -> Finding:
    """Return the finding about a continuous channel in a dry run, which sends no positions: ArduPilot does not arm
    without positions on every channel that is set up."""
    change = "VISO_TYPE=0"
    if choice.channel is Channel.GPS_INPUT:
        change = f"{own_name(reading.parameters, RECEIVERS[choice.receiver])}={0 if choice.receiver == SECOND else 1}"
    return wrong("channel", FindingCode.DRY_RUN_NOT_ARMED, change, channel=choice.channel.name, vehicle=reading.vehicle)


def _px4_findings(reading: AutopilotReading, _sends_fixes: bool) -> Iterator[Finding]:
    choice = PX4_TABLE.choose(reading.kind, reading.parameters)
    if choice.channel is not Channel.COMMAND:
        yield _channel(choice)
    elif CONTROL in reading.parameters:
        yield replace(_channel(choice), ok=False, changes=(f"{CONTROL}={FUSES_POSITION}",), exit_code=1)
        choice = replace(choice, channel=Channel.SENSOR)  # for the other parameters that it will need
    elif reading.kind is Kind.PLANE:
        yield _channel(choice)
    else:
        other = reading.parameters.get(VISION_CONTROL) or None
        figures = {"receiver_type": None, "parameter": VISION_CONTROL, "value": other}
        change = f"{VISION_CONTROL}={FUSES_POSITION}"
        yield wrong("channel", FindingCode.NOT_CARRIED, change, vehicle=reading.vehicle, **figures)
    yield from _parameters(PX4_TABLE, choice, reading)
    yield _port(reading, "MAV_PROTO_VER=2")


def _port(reading: AutopilotReading, change: str) -> Finding:
    if reading.says_version_1:
        return wrong("port", FindingCode.MAVLINK_1, change)
    return fine("port", FindingCode.MAVLINK_2)


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
