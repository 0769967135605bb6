"""Channels by which an autopilot can be told a position, and which one a firmware takes on which vehicle."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto


class Channel(Enum):
    """A way to tell an autopilot a position. The first two are for single fixes, rare and late; the last two ask for an
    estimate ten times a second, without a gap."""

    COMMAND = auto()  # 43003, EXTERNAL_POSITION_ESTIMATE
    SENSOR = auto()  # message 296, GLOBAL_POSITION_SENSOR
    GPS_INPUT = auto()  # message 232, as a GPS receiver
    ODOMETRY = auto()  # message 331

    @property
    def is_continuous(self) -> bool:
        return self in (Channel.GPS_INPUT, Channel.ODOMETRY)


class Kind(Enum):
    """A kind of vehicle, as far as it matters to how it flies without GPS."""

    PLANE = "plane"
    COPTER = "copter"
    ROVER = "rover"
    OTHER = "vehicle"


@dataclass(frozen=True, slots=True)
class Choice:
    """The channel of an autopilot, and the `reason` for it in a few words. `receiver` is the number of the GPS receiver
    that GPS_INPUT plays (0: the first), and `lag_s` how old the autopilot takes its positions to be."""

    channel: Channel
    reason: str
    receiver: int = 0
    lag_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """Answers of an autopilot: the kind of its vehicle, its `version` (major, minor; None: unknown) and those of the
    parameters asked for that it has."""

    kind: Kind
    version: tuple[int, int] | None
    parameters: Mapping[str, float]


def kind_of(mav_type: int) -> Kind:
    """Return the kind of a vehicle by the type in its HEARTBEAT (MAV_TYPE).

    What takes off upright and flies on wings is a plane: on its wings it reckons by airspeed and without sideslip, as a
    plane does. While it hovers it has no more than a copter has; its type does not tell which it does.
    """
    return _KINDS.get(mav_type, Kind.OTHER)


_NUMBERS = {  # MAV_TYPE
    Kind.PLANE: (1, 19, 20, 21, 22, 23, 24, 25),
    Kind.COPTER: (2, 3, 4, 13, 14, 15, 29, 35, 43),
    Kind.ROVER: (10, 11, 46),
}
_KINDS = {number: kind for kind, numbers in _NUMBERS.items() for number in numbers}
