"""Channels by which an autopilot can be told a position, and which one a firmware takes on which vehicle."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto

from edgevpr.mavlink.wire import mavlink


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
    """Return the kind of a vehicle by the type in its HEARTBEAT (MAV_TYPE)."""
    return _KINDS.get(mav_type, Kind.OTHER)


_COPTERS = ("QUADROTOR", "COAXIAL", "HELICOPTER", "HEXAROTOR", "OCTOROTOR", "TRICOPTER", "DODECAROTOR", "DECAROTOR")
_KINDS = {
    mavlink.MAV_TYPE_FIXED_WING: Kind.PLANE,
    mavlink.MAV_TYPE_GROUND_ROVER: Kind.ROVER,
    mavlink.MAV_TYPE_SURFACE_BOAT: Kind.ROVER,
} | {getattr(mavlink, f"MAV_TYPE_{name}"): Kind.COPTER for name in _COPTERS}
