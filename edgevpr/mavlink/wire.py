"""The one import of pymavlink's dialect, and the parser from bytes to messages.

`ardupilotmega` holds all that ArduPilot and PX4 say to a companion computer; the dialect `all` would take another 1 MB
of RAM. `mavutil` is not imported: it would take another 20 MB, and its connections hang, spin or raise where a link of
this package must not.
"""

from collections import Counter
from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Message = mavlink.MAVLink_message


class Receiver:
    """The parser of one byte stream. It yields the messages; bytes that are no message are dropped and counted."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()  # messages by name
        self.bad_bytes = 0
        self.forget_partial_message()

    def forget_partial_message(self) -> None:
        """Start again with an empty buffer, as after a link was lost in the middle of a message."""
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True  # bad data comes as BAD_DATA messages instead of an exception

    def feed(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that `data` completes."""
        while data:
            # The portions end where a message ends, so the parser's buffer is emptied each time and never grows.
            portion = self._parser.bytes_needed()
            message = self._parser.parse_char(data[:portion])
            data = data[portion:]
            if message is None:
                continue
            if message.get_type() == "BAD_DATA":
                self.bad_bytes += len(message.data)
            elif isinstance(message, mavlink.MAVLink_unknown):
                self.received["UNKNOWN"] += 1  # one name for all: there are 16 million message numbers
            else:
                self.received[message.get_type()] += 1
                yield message
