"""The questions to an autopilot that has just been heard, and the channel that follows from its answers."""

import logging
import math
from collections.abc import Iterator

from edgevpr.mavlink import messages
from edgevpr.mavlink.autopilots import ardupilot, px4
from edgevpr.mavlink.autopilots.channel import Asked, Channel, Choice, Kind, kind_of
from edgevpr.mavlink.parameter import value_of
from edgevpr.mavlink.wire import Message, mavlink

_ASK_EVERY_S, _TIMES = 1.0, 4
_UNKNOWN = Choice(Channel.COMMAND, "command 43003, the only one that is asked of an unknown firmware")
_FIRMWARES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ardupilot, mavlink.MAV_AUTOPILOT_PX4: px4}

log = logging.getLogger(__name__)


class Interview:
    """Asks an autopilot for its version and a few parameters, a few times where answers are missing (an autopilot does
    not answer for a parameter that it does not have). `choice` is the channel: until all has been asked, that of an
    autopilot that has answered nothing. A first answer that comes late still counts, a second one does not: a parameter
    that is changed in flight changes no channel."""

    def __init__(self) -> None:
        self.choice = _UNKNOWN
        self.kind = Kind.OTHER
        self._firmware = mavlink.MAV_AUTOPILOT_GENERIC
        self._version: tuple[int, int] | None = None
        self._parameters: dict[str, float] = {}
        self._asked, self._ask_s = 0, -math.inf
        self._is_over = False

    def hear(self, message: Message) -> None:
        """Take in a message of the autopilot."""
        match message.get_type():
            case "HEARTBEAT":
                self._firmware, self.kind = message.autopilot, kind_of(message.type)
            case "AUTOPILOT_VERSION" if self._version is None:
                self._is_over = False
                self._version = message.flight_sw_version >> 24 & 255, message.flight_sw_version >> 16 & 255
            case "PARAM_VALUE" if message.param_id in self._wanted() and message.param_id not in self._parameters:
                value = value_of(message, bytewise=self._firmware == mavlink.MAV_AUTOPILOT_PX4)
                if value is not None:
                    self._is_over = False
                    self._parameters[message.param_id] = value

    def questions(self, now_s: float, target_system: int) -> Iterator[Message]:
        """Yield the questions that are due. After the last of them, and a while for the answers, the channel is
        chosen."""
        if self._is_over or now_s - self._ask_s < _ASK_EVERY_S:
            return
        missing = [name for name in self._wanted() if name not in self._parameters]
        if self._asked == _TIMES or (self._version and not missing):
            self._choose()
            return
        self._asked, self._ask_s = self._asked + 1, now_s
        if self._version is None:
            yield messages.message_request(target_system, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        for name in missing:
            yield messages.parameter_request(target_system, name)

    def _wanted(self) -> tuple[str, ...]:
        firmware = _FIRMWARES.get(self._firmware)
        return firmware.PARAMETERS if firmware else ()

    def _choose(self) -> None:
        self._is_over = True
        firmware = _FIRMWARES.get(self._firmware)
        if firmware:
            asked = Asked(kind=self.kind, version=self._version, parameters=self._parameters)
            self.choice = firmware.choice(asked)
        said = f" {self._version[0]}.{self._version[1]}" if self._version else ""
        named = {ardupilot: "ArduPilot", px4: "PX4"}.get(firmware, "unknown firmware")
        log.info("%s%s on a %s: positions go to it by %s", named, said, self.kind.value, self.choice.reason)
