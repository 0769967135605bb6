"""Rules of `edgevpr doctor` for each firmware: whether this vehicle can use positions from the channel that the flight
will choose, and if not, which parameters to change.

The rules are based on the sources of ArduPilot 4.7-dev and PX4 1.17-alpha. The channels were flown without GPS in
simulation, those of PX4 with 1.17.0 and 1.18-beta1."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from edgevpr.mavlink.ardupilot_parameters import ADVISED_RECEIVER, ARDUPILOT_TABLE, MAVLINK_GPS, RECEIVERS
from edgevpr.mavlink.channel import Channel, ChannelChoice, VehicleKind, resolve_name
from edgevpr.mavlink.parameters import ParameterTable
from edgevpr.mavlink.px4_parameters import AGP_CONTROL, POSITION_BIT, PX4_TABLE, VISION_CONTROL
from edgevpr.mavlink.requestlink import AutopilotReading
from edgevpr.runtime.service.finding import Finding, report_fault, report_ok
from edgevpr.runtime.service.findingcodes import FindingCode

_AUTO_SWITCH_VALUES = (1, 4)  # values of GPS_AUTO_SWITCH that select the other receiver if the first has no fix
_VELOCITY_SOURCES = tuple(f"EK3_SRC{number}_VELXY" for number in (1, 2, 3))
_SOURCE_OPTICAL_FLOW = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class FirmwareRules:
    """Rules of one firmware. `min_version`: first version (major, minor) that accepts position fixes. `parameters`:
    names of the parameters to read. `check` yields findings on an autopilot's reading; its flag is True for a flight
    that sends fixes. `port_changes` returns the parameters that the autopilot's serial port needs for a baud rate, each
    as a text such as "SERIALn_PROTOCOL=2" (n: number of the port)."""

    name: str
    min_version: tuple[int, int]
    parameters: tuple[str, ...]
    check: Callable[[AutopilotReading, bool], Iterator[Finding]]
    port_changes: Callable[[int], tuple[str, ...]]


def _check_ardupilot(reading: AutopilotReading, sends_fixes: bool) -> Iterator[Finding]:
    choice = ARDUPILOT_TABLE.choose(reading.kind, reading.parameters)
    if not choice.channel.is_continuous:
        yield _check_single_fixes(choice, reading, sends_fixes)
    elif sends_fixes:
        yield _report_channel(choice)
    else:
        yield _report_dry_run(choice, reading)
    yield from _check_parameters(ARDUPILOT_TABLE, choice, reading)
    yield _check_port(reading, "SERIALn_PROTOCOL=2")


def _report_channel(choice: ChannelChoice) -> Finding:
    return Finding(what="channel", ok=True, reason=choice.reason)


def _check_parameters(table: ParameterTable, choice: ChannelChoice, reading: AutopilotReading) -> Iterator[Finding]:
    """Check the parameters that affect our messages: yield one finding for each rule of the table that is violated."""
    faults = table.find_faults(choice, reading.parameters)
    for fault in faults:
        yield Finding(what=fault.rule.label, ok=False, reason=fault.reason, changes=fault.changes, exit_code=1)
    if not faults:
        yield report_ok("parameters", FindingCode.PARAMETERS_RIGHT)


def _check_single_fixes(choice: ChannelChoice, reading: AutopilotReading, sends_fixes: bool) -> Finding:
    """Check the use of command 43003. It sends single fixes, so the autopilot must track its position between them with
    another sensor, such as airspeed or optical flow."""
    parameters = reading.parameters
    hovers = parameters.get("Q_ENABLE") == 1  # only planes have this parameter, whatever type the heartbeat reports
    if reading.kind is VehicleKind.PLANE and not hovers:
        return _report_channel(choice)
    flow = parameters.get("FLOW_TYPE", 0)
    if flow and any(parameters.get(name) == _SOURCE_OPTICAL_FLOW for name in _VELOCITY_SOURCES):
        return report_ok("channel", FindingCode.COMMAND_WITH_FLOW, flow=flow)
    receiver_name = resolve_name(parameters, RECEIVERS[ADVISED_RECEIVER])
    changes = [f"{receiver_name}={MAVLINK_GPS}"]
    if parameters.get("GPS_AUTO_SWITCH") not in _AUTO_SWITCH_VALUES:
        changes.append("GPS_AUTO_SWITCH=1")
    if not sends_fixes:
        return report_ok("channel", FindingCode.CHANGES_AFTER_DRY_RUN, changes=" and ".join(changes))
    replaced = parameters.get(receiver_name) or None
    return report_fault("channel", FindingCode.NOT_CARRIED, *changes, vehicle=reading.vehicle, receiver_type=replaced)


def _report_dry_run(choice: ChannelChoice, reading: AutopilotReading) -> Finding:
    """Return the fault of a continuous channel in a dry run: no positions are sent, and ArduPilot does not arm unless
    it receives positions on every channel that is configured."""
    change = "VISO_TYPE=0"
    if choice.channel is Channel.GPS_INPUT:
        name = resolve_name(reading.parameters, RECEIVERS[choice.receiver])
        change = f"{name}={0 if choice.receiver == ADVISED_RECEIVER else 1}"
    channel, vehicle = choice.channel.name, reading.vehicle
    return report_fault("channel", FindingCode.DRY_RUN_NOT_ARMED, change, channel=channel, vehicle=vehicle)


def _check_px4(reading: AutopilotReading, _sends_fixes: bool) -> Iterator[Finding]:
    choice = PX4_TABLE.choose(reading.kind, reading.parameters)
    if choice.channel is not Channel.COMMAND:
        yield _report_channel(choice)
    elif AGP_CONTROL in reading.parameters:
        yield replace(_report_channel(choice), ok=False, changes=(f"{AGP_CONTROL}={POSITION_BIT}",), exit_code=1)
        choice = replace(choice, channel=Channel.SENSOR)  # check the parameters that this channel will need
    elif reading.kind is VehicleKind.PLANE:
        yield _report_channel(choice)
    else:
        figures = {"parameter": VISION_CONTROL, "value": reading.parameters.get(VISION_CONTROL) or None}
        change = f"{VISION_CONTROL}={POSITION_BIT}"
        yield report_fault("channel", FindingCode.NOT_CARRIED, change, vehicle=reading.vehicle, **figures)
    yield from _check_parameters(PX4_TABLE, choice, reading)
    yield _check_port(reading, "MAV_PROTO_VER=2")


def _check_port(reading: AutopilotReading, change: str) -> Finding:
    if reading.sends_mavlink1:
        return report_fault("port", FindingCode.MAVLINK_1, change)
    return report_ok("port", FindingCode.MAVLINK_2)


RULES = {
    "ardupilot": FirmwareRules(
        name="ArduPilot",
        min_version=(4, 5),  # release notes of 4.5.0: MAV_CMD_EXTERNAL_POSITION_ESTIMATE
        parameters=(*ARDUPILOT_TABLE.names, "FLOW_TYPE", "Q_ENABLE"),
        check=_check_ardupilot,
        port_changes=lambda baud: ("SERIALn_PROTOCOL=2", f"SERIALn_BAUD={baud // 1000}"),
    ),
    "px4": FirmwareRules(
        name="PX4",
        min_version=(1, 15),
        parameters=PX4_TABLE.names,
        check=_check_px4,
        # TELEM 2 is the usual port for a companion computer.
        port_changes=lambda baud: ("MAV_1_CONFIG=102", "MAV_1_MODE=2", f"SER_TEL2_BAUD={baud}"),
    ),
}
