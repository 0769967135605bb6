"""The packets that are said in a replay, held against what was said in the flight, to the byte."""

from dataclasses import dataclass

from edgevpr.mavlink.wire import mavlink

_SIGNATURE_BYTES = 13


@dataclass(frozen=True, slots=True)
class Said:
    """A packet that differs: the time, the link's name, the packet of the flight and that of the replay (None: there
    was none)."""

    t_s: float
    link: str
    then: bytes | None
    now: bytes | None


class Packets:
    """Comparison of the packets that were said with those that are said now: how many are `alike`, how many are
    `renumbered` (the same but for the sequence number, after one that is not), and the others."""

    def __init__(self) -> None:
        self.alike = self.renumbered = 0
        self.others: list[Said] = []

    def compare(self, t_s: float, link: str, then: bytes | None, now: bytes | None) -> None:
        """Compare two packets. A signature needs the key, which no recording holds: it is not compared."""
        if then is None and now is None:
            return
        if then and now and _unsigned(then) == _unsigned(now):
            self.alike += 1
        elif then and now and _unnumbered(then) == _unnumbered(now):
            self.renumbered += 1
        else:
            self.others.append(Said(t_s, link, then, now))


def described(packet: bytes | None) -> str:
    """Return a packet in words."""
    if packet is None:
        return "nothing"
    (message,) = mavlink.MAVLink(None).parse_buffer(packet)
    return f"{message} (sequence number {message.get_seq()})"


def _unsigned(packet: bytes) -> bytes:
    is_signed = packet[0] == mavlink.PROTOCOL_MARKER_V2 and packet[2] & mavlink.MAVLINK_IFLAG_SIGNED
    return packet[:-_SIGNATURE_BYTES] if is_signed else packet


def _unnumbered(packet: bytes) -> bytes:
    """Return a packet without its sequence number, and without the checksum over it."""
    at = 4 if packet[0] == mavlink.PROTOCOL_MARKER_V2 else 2
    unsigned = _unsigned(packet)
    return unsigned[:at] + unsigned[at + 1 : -2]
