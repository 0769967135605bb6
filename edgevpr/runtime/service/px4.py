"""Advice for PX4: by its parameters, how fixes will reach it, and what to change. Every rule has its source here: the
sources of PX4 1.17-alpha."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from edgevpr.mavlink.reading import Reading
from edgevpr.runtime.service.finding import Finding

Parameters = Mapping[str, float | int]

_INSTANCES, _TELEMETRY = (0, 1, 2), (1, 2, 3)
PARAMETERS = (
    "EKF2_AGP0_ID", "EKF2_AGP0_CTRL", "EKF2_AGP0_DELAY", "EKF2_EV_CTRL", "EKF2_GPS_CTRL", "EKF2_OF_CTRL",
    "MAV_PROTO_VER",
    *(f"MAV_{n}_{what}" for n in _INSTANCES for what in ("CONFIG", "MODE", "RATE")),
    *(f"SER_TEL{n}_BAUD" for n in _TELEMETRY),
)  # fmt: skip

_HORIZONTAL = 1  # bit 0 of EKF2_AGP0_CTRL and EKF2_EV_CTRL
_FUSES_296 = (1, 17)
_KNOWS_FIXES = (1, 15)
SENSOR_ID = 1  # of EKF2_AGP0_ID: 0 switches the slot off
_USUAL_DELAY_MS = 300  # from the picture to the fix
_TELEM2, _ONBOARD = 102, 2  # MAV_1_CONFIG, MAV_1_MODE


@dataclass(frozen=True, slots=True)
class Channel:
    """The way that fixes take: "global position" (message 296) or "single fixes" (43003), and what decides it."""

    name: str
    reason: str


def channel(version: tuple[int, int, int] | None, parameters: Parameters) -> Channel:
    """Choose the way of the fixes by version and parameters."""
    if _can_fuse(version, parameters) and int(parameters["EKF2_AGP0_CTRL"]) & _HORIZONTAL:
        return Channel("global position", f"EKF2_AGP0_CTRL={parameters['EKF2_AGP0_CTRL']}")
    return Channel("single fixes", "EKF2_AGP0_CTRL does not take positions")


def _can_fuse(version: tuple[int, int, int] | None, parameters: Parameters) -> bool:
    return version is not None and version[:2] >= _FUSES_296 and "EKF2_AGP0_CTRL" in parameters


def findings(reading: Reading) -> Iterator[Finding]:
    """Judge what was read of a PX4."""
    yield _firmware(reading)
    yield _channel(reading)
    yield from _vision(reading.parameters)
    yield _ports(reading)


def port_changes(baud: int) -> tuple[str, ...]:
    """List what TELEM 2, the usual port for a companion, needs at the other end of a serial line."""
    return f"MAV_1_CONFIG={_TELEM2}", f"MAV_1_MODE={_ONBOARD}", f"SER_TEL2_BAUD={baud}"


def _firmware(reading: Reading) -> Finding:
    version = reading.version
    if version is None:
        return Finding("firmware", False, "PX4 does not tell its version: update it to 1.15 or later.")
    if version[:2] < _KNOWS_FIXES:
        return Finding(
            "firmware",
            False,
            f"PX4 {reading.version_text} does not know position fixes (command 43003): update it.",
            ("PX4 1.15 or later",),
        )
    return Finding("firmware", True, f"PX4 {reading.version_text}, {reading.vehicle}")


def _channel(reading: Reading) -> Finding:
    parameters = reading.parameters
    chosen = channel(reading.version, parameters)
    if not _can_fuse(reading.version, parameters):
        return Finding(
            "channel",
            True,
            "Single fixes by command 43003, while it reckons without GPS: this firmware does not fuse message 296.",
        )
    wrong = []
    if chosen.name == "single fixes":
        wrong.append(f"EKF2_AGP0_CTRL={_HORIZONTAL}")
    if parameters.get("EKF2_AGP0_ID", SENSOR_ID) != SENSOR_ID:
        wrong.append(f"EKF2_AGP0_ID={SENSOR_ID}")
    if parameters.get("EKF2_AGP0_DELAY") == 0:
        wrong.append(f"EKF2_AGP0_DELAY={_USUAL_DELAY_MS}")
    if wrong:
        return Finding(
            "channel",
            False,
            "PX4 can take positions as measurements (message 296), but is not set for it: change this, and reboot. "
            "The delay is the time from picture to fix, in ms: that of a query by `edgevpr profile`, 300 at most.",
            tuple(wrong),
        )
    return Finding("channel", True, f"Positions as measurements (message 296): {chosen.reason}.")


def _vision(parameters: Parameters) -> Iterator[Finding]:
    if int(parameters.get("EKF2_EV_CTRL", 0)) & _HORIZONTAL:
        yield Finding(
            "vision",
            True,
            f"EKF2_EV_CTRL={parameters['EKF2_EV_CTRL']}: another program may send a pose; edgevpr sends none to PX4",
        )


def _ports(reading: Reading) -> Finding:
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
