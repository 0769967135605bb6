"""Compares a flight with its replay, for `edgevpr replay`: the lines of both logs, and byte by byte the packets sent on
the link. In the names of this module, "then" is the flight and "now" its replay."""

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


def compare_lines(then: Iterable[Line], now: Iterable[Line]) -> LineComparison:
    """Compare a flight's log with that of its replay, line by line."""
    then, now, result = list(then), list(now), LineComparison(after=max(0, len(then) - len(now)))
    for before, after in zip(then, now, strict=False):
        fields = dict(_compare_values(before, after))
        if before.get("kind") == "start":
            result.program = {name: fields.pop(name) for name in [*fields] if name.partition(".")[0] in _PROGRAM_FIELDS}
        if fields:
            result.others.append({**_identify_line(before), "fields": fields})
        else:
            result.alike += 1
    result.others += [{**_identify_line(line), "only_in": "replay"} for line in now[len(then) :]]
    return result


def _identify_line(line: Line) -> Line:
    return {"kind": line.get("kind"), "t_mono_s": line.get("t_mono_s") or 0.0, "query": line.get("query")}


def _compare_values(then: Any, now: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    if isinstance(then, dict) and isinstance(now, dict):
        for key in then | now:
            yield from _compare_values(then.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif then != now or type(then) is not type(now):
        yield name, (then, now)


@dataclass(slots=True)
class PacketComparison:
    """Comparison of the packets sent by a flight and by its replay. `alike`: number of equal packets. `others`: a
    sentence on each difference."""

    alike: int = 0
    others: list[str] = field(default_factory=list)

    def compare(self, t_s: float, then: bytes | None, now: bytes | None) -> None:
        """Compare two packets (None: none was sent) at the time `t_s` on the flight's clock."""
        if then and now and _strip_sequence(then) == _strip_sequence(now):
            self.alike += 1
        elif then or now:
            self.others.append(f"{t_s:.3f} s: sent {_describe_packet(then)}, now {_describe_packet(now)}")


def _describe_packet(packet: bytes | None) -> str:
    return str(mavlink.MAVLink(None).parse_buffer(packet)[0]) if packet else "nothing"


def _strip_sequence(packet: bytes) -> bytes:
    """Return a packet without its sequence number, which depends on the packets before it, its checksum, which depends
    on that number, and its signature, whose key is not in the recording."""
    if packet[0] != mavlink.PROTOCOL_MARKER_V2:
        return packet[:2] + packet[3:-2]
    signature_bytes = _SIGNATURE_BYTES if packet[2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
    return packet[:2] + packet[3:4] + packet[5 : -2 - signature_bytes]
