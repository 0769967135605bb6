"""Channels: the ways in which an autopilot can be told a position, and the rule that chooses one for a firmware and a
kind of vehicle. Used by the link in flight, and by `edgevpr doctor` for its advice.

The rules were read in the source code of PX4 1.17-alpha and of ArduPilot 4.7-dev, and tried on the
simulators of both.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto

# ArduPilot
MAVLINK_GPS = 14  # value of GPSn_TYPE: the receiver's positions come as GPS_INPUT
SECOND = 1  # index of the receiver that we advise the user to give to us
RECEIVERS = ("GPS1_TYPE", "GPS2_TYPE")
DELAYS = ("GPS1_DELAY_MS", "GPS2_DELAY_MS")
VISION = "VISO_TYPE"
_MAVLINK_VISION = 1
# The names of before 4.6, by those since (AP_GPS.cpp, convert_parameters).
OLD_NAMES = {
    "GPS1_TYPE": "GPS_TYPE",
    "GPS2_TYPE": "GPS_TYPE2",
    "GPS1_DELAY_MS": "GPS_DELAY_MS",
    "GPS2_DELAY_MS": "GPS_DELAY_MS2",
    **{f"GPS{n}_POS_{axis}": f"GPS_POS{n}_{axis}" for n in (1, 2) for axis in "XYZ"},
}
# AP_GPS assumes this age for the positions of a receiver whose delay is not configured (GPS_Backend::get_lag).
_GPS_LAG_S = 0.2

# PX4
FUSES_POSITION = 1  # bit of EKF2_AGPn_CTRL
CONTROL = "EKF2_AGP0_CTRL"  # since 1.18, as is message 296: 1.17.0 has neither
VISION_CONTROL = "EKF2_EV_CTRL"  # with more bits it may be that of another system; before 1.16 the default is 15


class Channel(Enum):
    """A way to tell an autopilot a position. COMMAND carries single fixes, which may be rare and late; the others are
    continuous: they carry the estimate, ten times a second without a gap."""

    NONE = auto()  # nothing is sent: a parameter is dangerous, or not answered yet
    COMMAND = auto()  # 43003, EXTERNAL_POSITION_ESTIMATE
    SENSOR = auto()  # message 296, GLOBAL_POSITION_SENSOR (PX4)
    GPS_INPUT = auto()  # message 232, as a GPS receiver (ArduPilot)
    ODOMETRY = auto()  # message 331 (ArduPilot)
    VISION = auto()  # message 331, as a position only (PX4)

    @property
    def is_continuous(self) -> bool:
        return self not in (Channel.NONE, Channel.COMMAND)

    @property
    def is_beside_gps(self) -> bool:
        """True if positions are sent while the autopilot has GPS too."""
        return self in (Channel.GPS_INPUT, Channel.ODOMETRY)


class Kind(Enum):
    """A kind of vehicle; it decides what the autopilot can do without GPS."""

    PLANE = "plane"
    COPTER = "copter"
    ROVER = "rover"
    OTHER = "vehicle"


_MAV_TYPES = {
    Kind.PLANE: (1, 19, 20, 21, 22, 23, 24, 25),
    Kind.COPTER: (2, 3, 4, 13, 14, 15, 29, 35, 43),
    Kind.ROVER: (10, 11, 46),
}


@dataclass(frozen=True, slots=True)
class Choice:
    """The channel chosen for an autopilot, and the `reason` for it. For GPS_INPUT, `receiver` is the index of the GPS
    receiver that we replace (0: the first), and `lag_s` the age that the autopilot assumes our positions to have."""

    channel: Channel
    reason: str
    receiver: int = 0
    lag_s: float = 0.0

    @property
    def why_nothing(self) -> str | None:
        """The reason why nothing is sent; None if something is."""
        return self.reason if self.channel is Channel.NONE else None


def kind_of(mav_type: int) -> Kind:
    """Return the kind of vehicle for the `type` field of its HEARTBEAT (a MAV_TYPE). A VTOL aircraft counts as a plane:
    in forward flight it dead-reckons as one, and its type does not tell whether it hovers."""
    return next((kind for kind, types in _MAV_TYPES.items() if mav_type in types), Kind.OTHER)


def ardupilot_choice(kind: Kind, parameters: Mapping[str, float]) -> Choice:
    """Choose the channel for an ArduPilot: GPS_INPUT or ODOMETRY if its parameters are set for it, else command 43003.
    `parameters` has values by name, without those that the autopilot does not have.

    A plane dead-reckons without GPS for as long as it flies, and accepts a fix at any time (`NavEKF3_core::setLatLng`).
    Without GPS and optical flow a copter lands after some seconds and a rover stops, whatever single fixes say.
    """
    for number in range(len(RECEIVERS)):
        name = own_name(parameters, RECEIVERS[number])
        if parameters.get(name) == MAVLINK_GPS:
            delay_ms = read_value(parameters, DELAYS[number], 0)
            reason = f"GPS_INPUT as receiver {number + 1}, as its {name} is {MAVLINK_GPS}"
            return Choice(Channel.GPS_INPUT, reason, number, delay_ms / 1e3 if delay_ms > 0 else _GPS_LAG_S)
    if parameters.get(VISION) == _MAVLINK_VISION:
        return Choice(Channel.ODOMETRY, f"ODOMETRY, as its {VISION} is {_MAVLINK_VISION}")
    if kind is Kind.PLANE:
        return Choice(Channel.COMMAND, "command 43003, which a plane that reckons takes at any time")
    return Choice(
        Channel.COMMAND,
        f"command 43003, which a {kind.value} without GPS takes only as long as optical flow carries it: set "
        f"{own_name(parameters, RECEIVERS[SECOND])}={MAVLINK_GPS} to give it a continuous position",
    )


def own_name(parameters: Mapping[str, float], name: str) -> str:
    """Return the name that this autopilot has for a parameter: its old one if only that was read, else `name`."""
    old = OLD_NAMES.get(name, name)
    return old if old in parameters and name not in parameters else name


def read_value(parameters: Mapping[str, float], name: str, default: float) -> float:
    """Return the value of a parameter under its new or old name; `default` if the autopilot has neither."""
    return parameters.get(own_name(parameters, name), default)


def px4_choice(_kind: Kind, parameters: Mapping[str, float]) -> Choice:
    """Choose the channel for a PX4: message 296 or ODOMETRY if CONTROL or VISION_CONTROL let it fuse positions, else
    command 43003."""
    fuses_ours = int(parameters.get(CONTROL, 0)) & FUSES_POSITION
    if parameters.get(VISION_CONTROL) == FUSES_POSITION and not fuses_ours:
        return Choice(Channel.VISION, f"ODOMETRY, as its {VISION_CONTROL} is {FUSES_POSITION}")
    if CONTROL not in parameters:
        return Choice(Channel.COMMAND, f"command 43003, as it has no {CONTROL} for message 296 (1.18 has)")
    if fuses_ours:
        return Choice(Channel.SENSOR, f"message 296, as its {CONTROL} fuses positions")
    return Choice(Channel.COMMAND, f"command 43003, as its {CONTROL} fuses no positions of message 296")
