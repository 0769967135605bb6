"""Compares a flight with its replay, for `edgevpr replay`: the lines of both logs, the packets sent on the links, byte
by byte, and the queries. In names here, "then" is the flight and "now" its replay."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from edgevpr.core.geodesy import distance_m
from edgevpr.mavlink.wire import mavlink
from edgevpr.review.logged import SENT, LoggedQuery, read_lines

Line = dict[str, Any]
Changes = dict[str, tuple[Any, Any]]  # by name: (value in the flight, value in the replay)

_SIGNATURE_BYTES = 13
_COMPARED = ("accepted", "reason", "place", "confidence", "at", "off_m")  # of a query, in a what-if

# Fields of a log's first line that describe the program that flew, not the flight.
_PROGRAM = ("version", "machine", "python", "libraries")


@dataclass(slots=True)
class Lines:
    """Comparison of the logs of flight and replay: the number of lines that are `alike`, the `others`, which differ,
    and the number of lines of the flight that come `after` the end of the replay. `program` has those fields of the
    first line that describe the program and differ. Each of the `others` has the `kind` of the line, its time
    `t_mono_s`, its `query`, and either `fields`, those that differ, by dotted name (like "fix.sent"), or `only_in`:
    "flight" or "replay" if the other log has no such line."""

    alike: int = 0
    others: list[Line] = field(default_factory=list)
    after: int = 0
    program: Changes = field(default_factory=dict)


def compare(then: Iterable[Line], now: Iterable[Line]) -> Lines:
    """Compare the lines of a flight's log with those of its replay."""
    before, after, found = _keyed(then), _keyed(now), Lines()
    last_s = max((t_s for _, t_s, *_ in after), default=0.0)
    for key in before | after:
        kind, t_s, query, _ = key
        line = {"kind": kind, "t_mono_s": t_s, "query": query}
        if key not in before:
            found.others.append({**line, "only_in": "replay"})
        elif key not in after and t_s > last_s:
            found.after += 1
        elif key not in after:
            found.others.append({**line, "only_in": "flight"})
        else:
            fields = dict(_differing(before[key], after[key]))
            if kind == "start":
                found.program = {name: fields.pop(name) for name in [*fields] if name.partition(".")[0] in _PROGRAM}
            if fields:
                found.others.append({**line, "fields": fields})
            else:
                found.alike += 1
    return found


def _keyed(lines: Iterable[Line]) -> dict[tuple[Any, ...], Line]:
    """Return the lines by (kind, time, query, number): lines with equal kind, time and query are numbered from 0."""
    seen: Counter[tuple[Any, ...]] = Counter()
    keyed = {}
    for line in lines:
        name = line.get("kind"), line.get("t_mono_s") or 0.0, line.get("query")
        keyed[(*name, seen[name])] = line
        seen[name] += 1
    return keyed


def _differing(then: Any, now: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    if isinstance(then, dict) and isinstance(now, dict):
        for key in then | now:
            yield from _differing(then.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif then != now or type(then) is not type(now):
        yield name, (then, now)


@dataclass(slots=True)
class Packets:
    """Comparison of the packets that the flight sent with those that its replay sends: how many are `alike`, and the
    `others`, each in a sentence."""

    alike: int = 0
    others: list[str] = field(default_factory=list)

    def compare(self, t_s: float, link: str, then: bytes | None, now: bytes | None) -> None:
        """Compare two packets of `link` (None: none was sent) at the time `t_s` of the flight's clock."""
        if then and now and _content(then) == _content(now):
            self.alike += 1
        elif then or now:
            self.others.append(f"{t_s:.3f} s, {link}: sent {_described(then)}, now {_described(now)}")


def _described(packet: bytes | None) -> str:
    return str(mavlink.MAVLink(None).parse_buffer(packet)[0]) if packet else "nothing"


def _content(packet: bytes) -> bytes:
    """Return a packet without its sequence number, which counts the packets before it, its checksum, which depends on
    that number, and its signature, for which no recording holds the key."""
    if packet[0] != mavlink.PROTOCOL_MARKER_V2:
        return packet[:2] + packet[3:-2]
    signature_bytes = _SIGNATURE_BYTES if packet[2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
    return packet[:2] + packet[3:4] + packet[5 : -2 - signature_bytes]


def compare_queries(then: Iterable[Line], now: Iterable[Line]) -> dict[str, Any]:
    """Put the queries of a flight (the lines `then`) and of its replay with another configuration (`now`) side by side.
    Returns a dict:
    - `queries`: those that end otherwise (another place accepted, or none), each with `query`, `then` and `now`
    - `summary`: by name, [a figure of the flight, that of the replay]; `alike`: number of queries that end alike
    - `apart_at_most_m`: largest distance between the two positions of a query (None: no query has two).
    """
    flown, again = ({query.name: query for query in read_lines(lines, Path()).queries} for lines in (then, now))
    others, apart_m = [], []
    for name in flown | again:
        one, other = flown.get(name), again.get(name)
        if not (one and other and _accepted(one) == _accepted(other)):
            others.append({"query": name, "then": _fields(one), "now": _fields(other)})
        if one and other and one.at and other.at:
            apart_m.append(float(distance_m(*one.at, *other.at)))
    both = [_summary(list(queries.values())) for queries in (flown, again)]
    return {
        "queries": others,
        "summary": {name: [figures[name] for figures in both] for name in both[0]},
        "alike": len(flown | again) - len(others),
        "apart_at_most_m": max(apart_m, default=None),
    }


def _fields(query: LoggedQuery | None) -> Line | None:
    return None if query is None else {name: getattr(query, name) for name in _COMPARED}


def _accepted(query: LoggedQuery) -> int | None:
    return query.place if query.accepted else None


def _summary(queries: list[LoggedQuery]) -> Line:
    off_m = [query.off_m for query in queries if query.off_m is not None]
    return {
        "queries": len(queries),
        "accepted": sum(query.accepted for query in queries),
        "fixes_sent": sum(bool(query.fix and query.fix.at and query.fix.outcome in SENT) for query in queries),
        "median_off_gps_m": round(median(off_m), 1) if off_m else None,
        "largest_off_gps_m": round(max(off_m), 1) if off_m else None,
    }
