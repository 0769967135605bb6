"""The only import of pymavlink: its dialect and rotations, and the parser from bytes to messages.

`ardupilotmega` has all messages that ArduPilot and PX4 exchange with a companion computer; the dialect `all` would need
another 1 MB of RAM. `mavutil` is not imported: it would need another 20 MB, and its connections hang, spin or raise."""

import math
import struct
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from typing import Any, TypeAlias

from pymavlink import quaternion, rotmat
from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["Message", "PacketReader", "mavlink", "quaternion", "read_parameter_value", "rotmat"]

Message: TypeAlias = Any  # a mavlink.MAVLink_message; each kind has its own fields

_MAX_SENDERS = 8  # senders whose incomplete messages are kept: packets from forged addresses must not fill the memory


class PacketReader:
    """Parses received bytes separately for each sender, so that an incomplete message from one does not consume the
    bytes of another. `admits` decides which messages are yielded."""

    def __init__(self, admits: Callable[[Message], bool] = lambda message: True) -> None:
        self._admits = admits
        self.received: Counter[str] = Counter()  # messages by name
        self.bad_bytes = 0
        self.parsers: dict[Hashable, mavlink.MAVLink] = {}  # by sender, the most recent last

    def feed(self, data: bytes, sender: Hashable = None) -> Iterator[Message]:
        """Yield the admitted messages that `data` completes. `sender`: its source, if there can be several."""
        parser = self._find_parser(sender)
        while data:
            # Each portion ends at the end of a message, so the parser's buffer is emptied each time and never grows.
            portion = parser.bytes_needed()
            message = parser.parse_char(data[:portion])
            data = data[portion:]
            if message is None:
                continue
            if message.get_type() == "BAD_DATA":
                self.bad_bytes += len(message.data)
                continue
            if isinstance(message, mavlink.MAVLink_unknown):
                self.received["UNKNOWN"] += 1  # one name for all, because there are 16 million message numbers
            elif self._admits(message):
                self.received[message.get_type()] += 1
                yield message

    def _find_parser(self, sender: Hashable) -> mavlink.MAVLink:
        if (parser := self.parsers.pop(sender, None)) is None:
            parser = mavlink.MAVLink(None)
            parser.robust_parsing = True  # report bad data as BAD_DATA messages, not as exceptions
            if len(self.parsers) == _MAX_SENDERS:
                self.parsers.pop(next(iter(self.parsers)))
        self.parsers[sender] = parser
        return parser


def read_parameter_value(message: Message, bytewise: bool) -> float | int | None:
    """Return the number in a PARAM_VALUE, or None if it is not finite. Its float32 field contains the number itself or,
    if `bytewise` (PX4), the four bytes of an integer."""
    is_integer = message.param_type < mavlink.MAV_PARAM_TYPE_REAL32
    if is_integer and bytewise:
        return int.from_bytes(struct.pack("<f", message.param_value), "little", signed=True)
    value: float = message.param_value
    if not math.isfinite(value):
        return None
    return int(value) if is_integer else value
