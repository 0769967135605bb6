"""Advice for PX4: is the channel that the flight will choose one that carries this vehicle, and what is to be changed?
Every rule has its source here: the sources of PX4 1.17-alpha."""

from collections.abc import Iterator, Mapping

from edgevpr.mavlink.channel import CONTROL, FUSES_POSITION, PX4, Channel, Kind, px4_can_fuse, px4_choice
from edgevpr.mavlink.positions import SENSOR_ID
from edgevpr.mavlink.reading import AutopilotReading
from edgevpr.runtime.service.finding import Finding, Plan, sentence

Parameters = Mapping[str, float | int]

_INSTANCES, _TELEMETRY = (0, 1, 2), (1, 2, 3)
PARAMETERS = (
    *PX4.parameters, "EKF2_AGP0_ID", "EKF2_AGP0_DELAY", "EKF2_EV_CTRL", "EKF2_OF_CTRL", "MAV_PROTO_VER",
    *(f"MAV_{n}_{what}" for n in _INSTANCES for what in ("CONFIG", "MODE", "RATE")),
    *(f"SER_TEL{n}_BAUD" for n in _TELEMETRY),
)  # fmt: skip

_VISION_POSITION = 1  # bit of EKF2_EV_CTRL
KNOWS_FIXES = (1, 15)
_MOST_DELAY_MS = 50  # our position is one of the moment at which it is sent
_SILENT_S = 5.0  # aux_global_position.cpp: positions of message 296 are used no more
_TELEM2, _ONBOARD = 102, 2  # MAV_1_CONFIG, MAV_1_MODE


def findings(reading: AutopilotReading, plan: Plan) -> Iterator[Finding]:
    """Judge what was read of a PX4."""
    yield _channel(reading)
    yield from _rate(reading, plan)
    yield from _vision(reading.parameters)
    yield _ports(reading)


def port_changes(baud: int) -> tuple[str, ...]:
    """List what TELEM 2, the usual port for a companion, needs at the other end of a serial line."""
    return f"MAV_1_CONFIG={_TELEM2}", f"MAV_1_MODE={_ONBOARD}", f"SER_TEL2_BAUD={baud}"


def is_too_rare(every_s: float) -> bool:
    """Tell whether PX4 drops message 296 between two queries that are so many seconds apart."""
    return every_s >= _SILENT_S


def rarity(every_s: float) -> str:
    """Say how the rate of the queries stands to the silence that PX4 bears."""
    return f"a query every {every_s:g} s, and PX4 drops positions after {_SILENT_S:g} s of silence"


def _rate(reading: AutopilotReading, plan: Plan) -> Iterator[Finding]:
    if px4_choice(reading.asked).channel is not Channel.SENSOR:
        return
    if not is_too_rare(plan.every_s):
        yield Finding("rate", True, rarity(plan.every_s))
        return
    yield Finding(
        "rate",
        False,
        f"There is {rarity(plan.every_s)}: it would never keep one. Ask more often, where `edgevpr profile --rate-hz` "
        "says that the board can, or take a faster board.",
        (f"source: {{rate_hz: {2 / _SILENT_S:g}}}, or more: not every query is a match",),
    )


def _channel(reading: AutopilotReading) -> Finding:
    parameters = reading.parameters
    chosen = px4_choice(reading.asked)
    if not px4_can_fuse(reading.asked):
        if reading.asked.kind is Kind.PLANE or parameters.get("EKF2_OF_CTRL") == 1:
            return Finding("channel", True, sentence(chosen.reason))
        return Finding(
            "channel",
            False,
            f"This {reading.vehicle} has nothing that carries it from one fix to the next: without GPS its position is "
            "lost after some seconds, and its failsafe decides. Let it take positions as measurements, or give it "
            "optical flow.",
            ("PX4 1.17 or later, with EKF2_AGP0_CTRL", "or EKF2_OF_CTRL=1"),
        )
    wrong = []
    if chosen.channel is Channel.COMMAND:
        wrong.append(f"{CONTROL}={FUSES_POSITION}")
    if parameters.get("EKF2_AGP0_ID", SENSOR_ID) != SENSOR_ID:
        wrong.append(f"EKF2_AGP0_ID={SENSOR_ID}")
    if parameters.get("EKF2_AGP0_DELAY", 0) > _MOST_DELAY_MS:
        wrong.append("EKF2_AGP0_DELAY=0")
    if wrong:
        return Finding(
            "channel",
            False,
            "PX4 can take positions as measurements (message 296), but is not set for it as edgevpr sends them: change "
            "this, and reboot.",
            tuple(wrong),
        )
    return Finding("channel", True, sentence(chosen.reason))


def _vision(parameters: Parameters) -> Iterator[Finding]:
    if int(parameters.get("EKF2_EV_CTRL", 0)) & _VISION_POSITION:
        yield Finding(
            "vision",
            True,
            f"EKF2_EV_CTRL={parameters['EKF2_EV_CTRL']}: another program may send a pose; edgevpr sends none to PX4",
        )


def _ports(reading: AutopilotReading) -> Finding:
    if reading.says_version_1:
        return Finding(
            "port", False, "It speaks MAVLink 1, which knows neither signatures nor new messages.", ("MAV_PROTO_VER=2",)
        )
    parameters = reading.parameters
    used = [
        f"MAV_{n}_CONFIG={config} (mode {parameters.get(f'MAV_{n}_MODE', '?')})"
        for n in _INSTANCES
        if (config := parameters.get(f"MAV_{n}_CONFIG"))
    ]
    return Finding("port", True, f"MAVLink 2; set for MAVLink: {', '.join(used) or 'unknown'}")
