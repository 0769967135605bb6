"""Compares a flight with its replay, for `edgevpr replay`: the lines of both logs, and byte by byte the packets sent on
the link."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from edgevpr.mavlink.wire import mavlink

Line = dict[str, Any]
Changes = dict[str, tuple[Any, Any]]  # by name: (value in the flight, value in the replay)

_SIGNATURE_BYTES = 13

# Fields of a log's first line that describe the program, not the flight.
_PROGRAM_FIELDS = ("version", "machine", "python", "libraries")


@dataclass(slots=True)
class LineComparison:
    """Comparison of the logs of a flight and its replay. `alike`: number of equal lines. `others`: the lines that
    differ. `after`: number of lines of the flight after the end of the replay. `program`: differing fields of the first
    line that describe the program. Each of the `others` has the `kind` of the line, its time `t_mono_s`, its `query`,
    and either `fields`, the differing fields by dotted name (such as "fix.sent"), or `only_in`: "replay" if the flight
    has no such line."""

    alike: int = 0
    others: list[Line] = field(default_factory=list)
    after: int = 0
    program: Changes = field(default_factory=dict)


def compare_lines(flown: Iterable[Line], replayed: Iterable[Line]) -> LineComparison:
    """Compare a flight's log with that of its replay, line by line."""
    flown, replayed, result = list(flown), list(replayed), LineComparison(after=max(0, len(flown) - len(replayed)))
    for flown_line, replayed_line in zip(flown, replayed, strict=False):
        fields = dict(_compare_values(flown_line, replayed_line))
        if flown_line.get("kind") == "start":
            result.program = {name: fields.pop(name) for name in [*fields] if name.partition(".")[0] in _PROGRAM_FIELDS}
        if fields:
            result.others.append({**_identify_line(flown_line), "fields": fields})
        else:
            result.alike += 1
    result.others += [{**_identify_line(line), "only_in": "replay"} for line in replayed[len(flown) :]]
    return result


def _identify_line(line: Line) -> Line:
    return {"kind": line.get("kind"), "t_mono_s": line.get("t_mono_s") or 0.0, "query": line.get("query")}


def _compare_values(flown: Any, replayed: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    if isinstance(flown, dict) and isinstance(replayed, dict):
        for key in flown | replayed:
            yield from _compare_values(flown.get(key), replayed.get(key), f"{name}.{key}" if name else key)
    elif flown != replayed or type(flown) is not type(replayed):
        yield name, (flown, replayed)


@dataclass(slots=True)
class PacketComparison:
    """Comparison of the packets sent by a flight and by its replay. `alike`: number of equal packets. `others`: a
    sentence on each difference."""

    alike: int = 0
    others: list[str] = field(default_factory=list)

    def compare(self, t_s: float, flown: bytes | None, replayed: bytes | None) -> None:
        """Compare two packets (None: none was sent) at the time `t_s` on the flight's clock."""
        if flown and replayed and _strip_sequence(flown) == _strip_sequence(replayed):
            self.alike += 1
        elif flown or replayed:
            self.others.append(f"{t_s:.3f} s: flight {_describe_packet(flown)}, replay {_describe_packet(replayed)}")


def _describe_packet(packet: bytes | None) -> str:
    return str(mavlink.MAVLink(None).parse_buffer(packet)[0]) if packet else "no packet"


def _strip_sequence(packet: bytes) -> bytes:
    """Return a packet without its sequence number, which depends on the packets before it, its checksum, which depends
    on that number, and its signature, whose key is not in the recording."""
    if packet[0] != mavlink.PROTOCOL_MARKER_V2:
        return packet[:2] + packet[3:-2]
    signature_bytes = _SIGNATURE_BYTES if packet[2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
    return packet[:2] + packet[3:4] + packet[5 : -2 - signature_bytes]
