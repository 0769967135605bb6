"""Channels: the ways in which an autopilot can be told a position, and the rule that chooses one for a firmware and a
kind of vehicle. Used by the link in flight, and by `edgevpr doctor` for its advice.

The rules were read in the source code of PX4 1.17-alpha and of ArduPilot 4.7-dev, and tried on the
simulators of both.
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
MAVLINK_GPS = 14  # value of GPSn_TYPE: the receiver's positions come as GPS_INPUT
SECOND = 1  # index of the receiver that we advise the user to give to us
_RECEIVERS = (("GPS1_TYPE", "GPS_TYPE"), ("GPS2_TYPE", "GPS_TYPE2"))
_DELAYS = (("GPS1_DELAY_MS", "GPS_DELAY_MS"), ("GPS2_DELAY_MS", "GPS_DELAY_MS2"))
_VISION, _MAVLINK_VISION = "VISO_TYPE", 1
# AP_GPS assumes this age for the positions of a receiver whose delay is not configured (GPS_Backend::get_lag).
_GPS_LAG_S = 0.2

# PX4
FUSES_POSITION = 1  # bit of EKF2_AGPn_CTRL
CONTROL = "EKF2_AGP0_CTRL"  # since 1.18, as is message 296: 1.17.0 has neither
VISION_CONTROL = "EKF2_EV_CTRL"  # with more bits it may be that of another system; before 1.16 the default is 15

log = logging.getLogger(__name__)


class Channel(Enum):
    """A way to tell an autopilot a position. COMMAND carries single fixes, which may be rare and late; the others are
    continuous: they carry the estimate, ten times a second without a gap."""

    COMMAND = auto()  # 43003, EXTERNAL_POSITION_ESTIMATE
    SENSOR = auto()  # message 296, GLOBAL_POSITION_SENSOR (PX4)
    GPS_INPUT = auto()  # message 232, as a GPS receiver (ArduPilot)
    ODOMETRY = auto()  # message 331 (ArduPilot)
    VISION = auto()  # message 331, as a position only (PX4)

    @property
    def is_continuous(self) -> bool:
        return self is not Channel.COMMAND

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
    for number in range(len(_RECEIVERS)):
        name = receiver_name(parameters, number)
        if parameters.get(name) == MAVLINK_GPS:
            delay_ms = parameters.get(_known_name(parameters, _DELAYS[number]))
            reason = f"GPS_INPUT as receiver {number + 1}, as its {name} is {MAVLINK_GPS}"
            return Choice(Channel.GPS_INPUT, reason, number, delay_ms / 1e3 if delay_ms else _GPS_LAG_S)
    if parameters.get(_VISION) == _MAVLINK_VISION:
        return Choice(Channel.ODOMETRY, f"ODOMETRY, as its {_VISION} is {_MAVLINK_VISION}")
    if kind is Kind.PLANE:
        return Choice(Channel.COMMAND, "command 43003, which a plane that reckons takes at any time")
    return Choice(
        Channel.COMMAND,
        f"command 43003, which a {kind.value} without GPS takes only as long as optical flow carries it: set "
        f"{receiver_name(parameters, SECOND)}={MAVLINK_GPS} to give it a continuous position",
    )


def receiver_name(parameters: Mapping[str, float], number: int) -> str:
    """Return the name of the parameter for the type of GPS receiver `number` (0: the first), before and since 4.6."""
    return _known_name(parameters, _RECEIVERS[number])


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


def _known_name(parameters: Mapping[str, float], names: tuple[str, ...]) -> str:
    return next((name for name in names if name in parameters), names[0])


ARDUPILOT_PARAMETERS = (*(name for names in _RECEIVERS + _DELAYS for name in names), _VISION)
PX4_PARAMETERS = (CONTROL, VISION_CONTROL)
_OF_ANY = Choice(Channel.COMMAND, "command 43003, the only one that is asked of an unknown firmware")
# Name, the parameters on which the channel depends, and the function that chooses it.
_Firmware = tuple[str, tuple[str, ...], Callable[[Kind, Mapping[str, float]], Choice]]
_UNKNOWN: _Firmware = ("unknown firmware", (), lambda kind, parameters: _OF_ANY)
_FIRMWARES: dict[int, _Firmware] = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ("ArduPilot", ARDUPILOT_PARAMETERS, ardupilot_choice),
    mavlink.MAV_AUTOPILOT_PX4: ("PX4", PX4_PARAMETERS, px4_choice),
}


class Interview:
    """Asks an autopilot for its version and a few parameters, and chooses the channel from the answers.

    Missing answers are requested four times, a second apart, since an autopilot is silent about a parameter that it
    does not have. Until the channel is chosen, `choice` is command 43003. Only the first answer to a question counts,
    so that changing a parameter in flight does not change the channel; after one that comes late, it is chosen again.
    """

    def __init__(self) -> None:
        self.choice = _OF_ANY
        self._autopilot, self._kind = int(mavlink.MAV_AUTOPILOT_GENERIC), Kind.OTHER
        self._version: tuple[int, int] | None = None
        self._parameters: dict[str, float] = {}
        self._asked, self._ask_s = 0, -math.inf
        self._is_over = False

    def hear(self, message: Message) -> None:
        """Process a message from the autopilot; most kinds are ignored."""
        match message.get_type():
            case "HEARTBEAT":
                self._autopilot, self._kind = message.autopilot, kind_of(message.type)
            case "AUTOPILOT_VERSION" if self._version is None:
                self._is_over = False
                self._version = message.flight_sw_version >> 24 & 255, message.flight_sw_version >> 16 & 255
            case "PARAM_VALUE" if message.param_id in self._missing():
                value = parameter_value(message, bytewise=self._autopilot == mavlink.MAV_AUTOPILOT_PX4)
                if value is not None:
                    self._is_over = False
                    self._parameters[message.param_id] = value

    def questions(self, now_s: float, target_system: int) -> Iterator[Message]:
        """Yield the requests due at `now_s`; when no answer is missing, or after four requests, choose the channel."""
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
        _, names, _ = _FIRMWARES.get(self._autopilot, _UNKNOWN)
        return [name for name in names if name not in self._parameters]

    def _choose(self) -> None:
        self._is_over = True
        name, _, choose = _FIRMWARES.get(self._autopilot, _UNKNOWN)
        self.choice = choose(self._kind, self._parameters)
        version = f" {self._version[0]}.{self._version[1]}" if self._version else ""
        log.info("%s%s on a %s: positions go to it by %s", name, version, self._kind.value, self.choice.reason)
