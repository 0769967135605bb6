"""Channels by which an autopilot can be told a position, and which one a firmware takes on which vehicle.

The rules are read off ArduPilot 4.7-dev, and tried on it in simulation, and off PX4 1.17-alpha.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, auto

from edgevpr.mavlink import messages
from edgevpr.mavlink.wire import Message, mavlink, parameter_value

_ASK_EVERY_S, _MOST_TIMES = 1.0, 4

# ArduPilot. The names of the receivers' parameters are those since 4.6, and those before.
MAVLINK_GPS = 14  # of GPSn_TYPE: positions come as GPS_INPUT
SECOND = 1  # the number of the receiver that we are to be
_RECEIVERS = (("GPS1_TYPE", "GPS_TYPE"), ("GPS2_TYPE", "GPS_TYPE2"))
_DELAYS = (("GPS1_DELAY_MS", "GPS_DELAY_MS"), ("GPS2_DELAY_MS", "GPS_DELAY_MS2"))
_VISION, _MAVLINK_VISION = "VISO_TYPE", 1
# AP_GPS takes the positions of a receiver that does not say how late they are to be so old (GPS_Backend::get_lag).
_GPS_LAG_S = 0.2

# PX4
FUSES_POSITION = 1  # bit of EKF2_AGPn_CTRL
CONTROL = "EKF2_AGP0_CTRL"
_SENSOR_SINCE = (1, 17)

log = logging.getLogger(__name__)


class Channel(Enum):
    """A way to tell an autopilot a position. The first two are for single fixes, rare and late; the last two ask for an
    estimate ten times a second, without a gap."""

    COMMAND = auto()  # 43003, EXTERNAL_POSITION_ESTIMATE
    SENSOR = auto()  # message 296, GLOBAL_POSITION_SENSOR
    GPS_INPUT = auto()  # message 232, as a GPS receiver
    ODOMETRY = auto()  # message 331

    @property
    def is_continuous(self) -> bool:
        """True for a channel that asks for an estimate without a gap."""
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
class Answers:
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
    return next((kind for kind, types in _MAV_TYPES.items() if mav_type in types), Kind.OTHER)


def ardupilot_choice(answers: Answers) -> Choice:
    """Choose the channel for an ArduPilot: what its operator has set up for us, else single fixes.

    A plane reckons without GPS for as long as it flies, and takes a fix at any time (`NavEKF3_core::setLatLng`). A
    copter without GPS and optical flow lands some seconds later, a rover stops, and no single fix prevents that.
    """
    parameters = answers.parameters
    for number in range(len(_RECEIVERS)):
        name = receiver_name(parameters, number)
        if parameters.get(name) == MAVLINK_GPS:
            delay_ms = parameters.get(_known_name(parameters, _DELAYS[number]))
            reason = f"GPS_INPUT as receiver {number + 1}, as its {name} is {MAVLINK_GPS}"
            return Choice(Channel.GPS_INPUT, reason, number, delay_ms / 1e3 if delay_ms else _GPS_LAG_S)
    if parameters.get(_VISION) == _MAVLINK_VISION:
        return Choice(Channel.ODOMETRY, f"ODOMETRY, as its {_VISION} is {_MAVLINK_VISION}")
    if answers.kind is Kind.PLANE:
        return Choice(Channel.COMMAND, "command 43003, which a plane that reckons takes at any time")
    return Choice(
        Channel.COMMAND,
        f"command 43003, which a {answers.kind.value} without GPS takes only as long as optical flow carries it: set "
        f"{receiver_name(parameters, SECOND)}={MAVLINK_GPS} to give it a continuous position",
    )


def receiver_name(parameters: Mapping[str, float], number: int) -> str:
    """Return the name that this ArduPilot has for the type of a receiver (0: the first)."""
    return _known_name(parameters, _RECEIVERS[number])


def px4_choice(answers: Answers) -> Choice:
    """Choose the channel for a PX4: message 296 where it has been told to fuse it, else command 43003. It fuses both,
    and falls back to single fixes by itself; it drops a 296 that says no accuracy, and its own delay is a parameter."""
    if answers.version and answers.version < _SENSOR_SINCE:
        major, minor = answers.version
        return Choice(Channel.COMMAND, f"command 43003, as version {major}.{minor} knows no message 296 (1.17 does)")
    if int(answers.parameters.get(CONTROL, 0)) & FUSES_POSITION:
        return Choice(Channel.SENSOR, f"message 296, as its {CONTROL} fuses positions")
    return Choice(Channel.COMMAND, f"command 43003, as its {CONTROL} fuses no positions of message 296")


def px4_can_fuse(answers: Answers) -> bool:
    """Tell whether this PX4 can be told to fuse message 296."""
    return CONTROL in answers.parameters and (answers.version is None or answers.version >= _SENSOR_SINCE)


def _known_name(parameters: Mapping[str, float], names: tuple[str, ...]) -> str:
    return next((name for name in names if name in parameters), names[0])


@dataclass(frozen=True, slots=True)
class _Firmware:
    """A firmware that is known: the parameters that are asked of it, and its rule."""

    name: str
    parameters: tuple[str, ...] = ()
    choose: Callable[[Answers], Choice] | None = None


ARDUPILOT = _Firmware(
    "ArduPilot", (*(name for names in _RECEIVERS + _DELAYS for name in names), _VISION), ardupilot_choice
)
PX4 = _Firmware("PX4", (CONTROL,), px4_choice)
_UNKNOWN = _Firmware("unknown firmware")
_FIRMWARES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUPILOT, mavlink.MAV_AUTOPILOT_PX4: PX4}


class Interview:
    """Asks an autopilot for its version and a few parameters, a few times where answers are missing (an autopilot does
    not answer for a parameter that it does not have). `choice` is the channel: until all has been asked, that of an
    autopilot that has answered nothing. A first answer that comes late still counts, a second one does not: a parameter
    that is changed in flight changes no channel."""

    def __init__(self) -> None:
        self.choice = Choice(Channel.COMMAND, "command 43003, the only one that is asked of an unknown firmware")
        self.kind = Kind.OTHER
        self._firmware = _UNKNOWN
        self._version: tuple[int, int] | None = None
        self._parameters: dict[str, float] = {}
        self._asked, self._ask_s = 0, -math.inf
        self._is_over = False

    def hear(self, message: Message) -> None:
        """Take in a message of the autopilot."""
        match message.get_type():
            case "HEARTBEAT":
                self._firmware = _FIRMWARES.get(message.autopilot, _UNKNOWN)
                self.kind = kind_of(message.type)
            case "AUTOPILOT_VERSION" if self._version is None:
                self._is_over = False
                self._version = message.flight_sw_version >> 24 & 255, message.flight_sw_version >> 16 & 255
            case "PARAM_VALUE" if message.param_id in self._missing():
                value = parameter_value(message, bytewise=self._firmware is PX4)
                if value is not None:
                    self._is_over = False
                    self._parameters[message.param_id] = value

    def questions(self, now_s: float, target_system: int) -> Iterator[Message]:
        """Yield the questions that are due. After the last of them, and a while for the answers, the channel is
        chosen."""
        if self._is_over or now_s - self._ask_s < _ASK_EVERY_S:
            return
        missing = self._missing()
        if self._asked == _MOST_TIMES or (self._version and not missing):
            self._choose()
            return
        self._asked, self._ask_s = self._asked + 1, now_s
        if self._version is None:
            yield messages.message_request(target_system, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        for name in missing:
            yield messages.parameter_request(target_system, name)

    def _missing(self) -> list[str]:
        return [name for name in self._firmware.parameters if name not in self._parameters]

    def _choose(self) -> None:
        self._is_over = True
        if self._firmware.choose:
            answers = Answers(kind=self.kind, version=self._version, parameters=self._parameters)
            self.choice = self._firmware.choose(answers)
        version = f" {self._version[0]}.{self._version[1]}" if self._version else ""
        name, reason = self._firmware.name, self.choice.reason
        log.info("%s%s on a %s: positions go to it by %s", name, version, self.kind.value, reason)


_MAV_TYPES = {
    Kind.PLANE: (1, 19, 20, 21, 22, 23, 24, 25),
    Kind.COPTER: (2, 3, 4, 13, 14, 15, 29, 35, 43),
    Kind.ROVER: (10, 11, 46),
}
