"""Channels: the messages that carry positions to an autopilot. Its parameters determine the channel."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import TypeAlias

from edgevpr.core.reasons import Reason

Parameters: TypeAlias = Mapping[str, float]

# ArduPilot's parameter names before 4.6, by the current name (AP_GPS.cpp, convert_parameters).
OLD_NAMES = {
    "GPS1_TYPE": "GPS_TYPE",
    "GPS2_TYPE": "GPS_TYPE2",
    "GPS1_DELAY_MS": "GPS_DELAY_MS",
    "GPS2_DELAY_MS": "GPS_DELAY_MS2",
    **{f"GPS{n}_POS_{axis}": f"GPS_POS{n}_{axis}" for n in (1, 2) for axis in "XYZ"},
}


class Channel(Enum):
    """A message that carries positions. COMMAND carries single fixes, which may be rare and late. The others are
    continuous: they carry the estimated position ten times a second without gaps."""

    NONE = auto()  # nothing is sent: a parameter is dangerous, or not yet received
    COMMAND = auto()  # 43003, EXTERNAL_POSITION_ESTIMATE
    SENSOR = auto()  # message 296, GLOBAL_POSITION_SENSOR (PX4)
    GPS_INPUT = auto()  # message 232, as a GPS receiver (ArduPilot)
    ODOMETRY = auto()  # message 331 (ArduPilot)
    VISION = auto()  # message 331, with a position only (PX4)

    @property
    def is_continuous(self) -> bool:
        return self not in (Channel.NONE, Channel.COMMAND)

    @property
    def is_untargeted(self) -> bool:
        """True if its message names no receiver, so that every autopilot on the link uses it."""
        return self in (Channel.GPS_INPUT, Channel.ODOMETRY, Channel.VISION)

    @property
    def works_with_gps(self) -> bool:
        """True if positions are also sent while the autopilot has GPS."""
        return self in (Channel.GPS_INPUT, Channel.ODOMETRY)


class VehicleKind(Enum):
    """A kind of vehicle, which determines what the autopilot can do without GPS."""

    PLANE = "plane"
    COPTER = "copter"
    ROVER = "rover"
    OTHER = "vehicle"


_MAV_TYPES = {
    VehicleKind.PLANE: (1, 19, 20, 21, 22, 23, 24, 25),
    VehicleKind.COPTER: (2, 3, 4, 13, 14, 15, 29, 35, 43),
    VehicleKind.ROVER: (10, 11, 46),
}


@dataclass(frozen=True, slots=True)
class ChannelChoice:
    """The channel chosen for an autopilot, and the `reason`. For GPS_INPUT, `receiver` is the index of the GPS receiver
    that we simulate (0: the first), and `lag_s` the age that the autopilot assumes for our positions."""

    channel: Channel
    reason: Reason
    receiver: int = 0
    lag_s: float = 0.0

    @property
    def silence_reason(self) -> Reason | None:
        """The reason why no positions are sent; None if they are sent."""
        return self.reason if self.channel is Channel.NONE else None


def classify_vehicle(mav_type: int) -> VehicleKind:
    """Return the kind of vehicle for the `type` field of its HEARTBEAT (a MAV_TYPE). A VTOL aircraft counts as a plane:
    in forward flight it dead-reckons like one, and its type does not tell whether it hovers."""
    return next((kind for kind, types in _MAV_TYPES.items() if mav_type in types), VehicleKind.OTHER)


def resolve_name(parameters: Parameters, name: str) -> str:
    """Return this autopilot's name for a parameter: the old name if only that was read, otherwise `name`."""
    old = OLD_NAMES.get(name, name)
    return old if old in parameters and name not in parameters else name


def read_value(parameters: Parameters, name: str, default: float) -> float:
    """Return the value of a parameter under its new or old name; `default` if the autopilot has neither."""
    return parameters.get(resolve_name(parameters, name), default)
