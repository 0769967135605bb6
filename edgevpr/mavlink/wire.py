"""The one import of pymavlink's dialect, and bytes from the wire made into messages.

The dialect alone, without `mavutil`: that would cost another 20 MB of RAM and bring connections that hang, spin or
raise where ours must not.
"""

from collections import Counter
from collections.abc import Iterator

from pymavlink.dialects.v20 import all as mavlink

Message = mavlink.MAVLink_message


class Receiver:
    """Takes the bytes of one stream and gives its messages; what is no message is dropped and counted."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()  # messages by name
        self.bad_bytes = 0
        self.forget_partial_message()

    def forget_partial_message(self) -> None:
        """Start anew, as after a link was lost in the middle of a message."""
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True  # bad data is handed out as such instead of raised

    def feed(self, data: bytes) -> Iterator[Message]:
        """Give the messages that `data` completes."""
        while data:
            # In portions that end where a message ends, the parser's buffer is emptied with each and never grows.
            portion = self._parser.bytes_needed()
            message = self._parser.parse_char(data[:portion])
            data = data[portion:]
            if message is None:
                continue
            if message.get_type() == "BAD_DATA":
                self.bad_bytes += len(message.data)
            elif isinstance(message, mavlink.MAVLink_unknown):
                self.received["UNKNOWN"] += 1  # under one name: there are 16 million numbers
            else:
                self.received[message.get_type()] += 1
                yield message
