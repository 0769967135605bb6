"""A flight beside its replay: the lines of both logs, what was said on the links, to the byte, and the queries."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from edgevpr.core.geodesy import distance_m
from edgevpr.mavlink.wire import mavlink

Line = dict[str, Any]

_SIGNATURE_BYTES = 13

# Of the first line: they tell of the program that flew, and not of the flight.
PROGRAM = "version", "machine", "python", "libraries"


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A line that differs: its kind, its time, the query that it tells of (None: it tells of none), and what differs:
    of each field, by its dotted name, the value then and now. `in_flight` and
    `in_replay` tell whether there is such a line at all."""

    kind: str
    t_mono_s: float
    query: str | None
    fields: dict[str, tuple[Any, Any]]
    in_flight: bool = True
    in_replay: bool = True


@dataclass(frozen=True, slots=True)
class Lines:
    """Comparison of two logs: how many lines are `alike`, which ones differ, how many of the flight come after the end
    of the replay, and what differs in the `program`s that flew, by its name: then and now."""

    alike: int
    others: list[Difference]
    after: int
    program: dict[str, tuple[Any, Any]]


def compare(then: Iterable[Line], now: Iterable[Line]) -> Lines:
    """Compare the lines of a flight's log with those of its replay. A line that a full disk has cost the flight is no
    difference: its log says so, in a line of kind "gap"."""
    before, after = dict(_keyed(then)), dict(_keyed(now))
    has_gaps = any(line["kind"] == "gap" for line in before.values())
    last_s = max((line["t_mono_s"] for line in after.values()), default=0.0)
    alike, others, later = 0, [], 0
    program: dict[str, tuple[Any, Any]] = {}
    for key, line in before.items():
        if line["kind"] == "gap":
            continue
        if key not in after:
            if line["t_mono_s"] > last_s:
                later += 1
            else:
                others.append(_difference(key, {}, in_replay=False))
        else:
            fields = dict(_differing(line, after[key]))
            if line["kind"] == "start":
                program |= {name: each for name, each in fields.items() if name.partition(".")[0] in PROGRAM}
            if fields := {name: each for name, each in fields.items() if name not in program}:
                others.append(_difference(key, fields))
            else:
                alike += 1
    if not has_gaps:
        others += [_difference(key, {}, in_flight=False) for key in after if key not in before]
    return Lines(alike, others, later, program)


def _difference(key: tuple[Any, ...], fields: dict[str, tuple[Any, Any]], **where: bool) -> Difference:
    kind, t_mono_s, query, _ = key
    return Difference(kind=kind, t_mono_s=t_mono_s, query=query, fields=fields, **where)


def _keyed(lines: Iterable[Line]) -> Iterator[tuple[tuple[Any, ...], Line]]:
    """Yield each line with what names it: its kind, time and query, and which it is of several with the same."""
    seen: Counter[tuple[Any, ...]] = Counter()
    for line in lines:
        name = line.get("kind"), line.get("t_mono_s") or 0.0, line.get("query")
        yield (*name, seen[name]), line
        seen[name] += 1


def _differing(then: Any, now: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    if isinstance(then, dict) and isinstance(now, dict):
        for key in then | now:
            yield from _differing(then.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif then != now or type(then) is not type(now):
        yield name, (then, now)


@dataclass(frozen=True, slots=True)
class PacketDifference:
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
        self.others: list[PacketDifference] = []

    def compare(self, t_s: float, link: str, then: bytes | None, now: bytes | None) -> None:
        """Compare two packets. A signature needs the key, which no recording holds: it is not compared."""
        if then is None and now is None:
            return
        if then and now and _unsigned(then) == _unsigned(now):
            self.alike += 1
        elif then and now and _unnumbered(then) == _unnumbered(now):
            self.renumbered += 1
        else:
            self.others.append(PacketDifference(t_s, link, then, now))


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


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryResult:
    """The outcome of a query: whether it was `accepted`, and why (not), its `place` and `confidence`, the
    position `at` of the match (degrees), `off_gps_m`, how far that is from an autopilot that has GPS, and whether a
    fix was sent (`has_fix`). None is unknown, of whatever it is."""

    accepted: bool
    reason: str
    place: int | None
    confidence: float | None
    at: tuple[float, float] | None
    off_gps_m: float | None
    has_fix: bool


@dataclass(frozen=True, slots=True)
class QueryPair:
    """One query of both flights; None where one has none of that name."""

    query: str
    then: QueryResult | None
    now: QueryResult | None

    @property
    def apart_m(self) -> float | None:
        """Metres from one position to the other; None where one of them is missing."""
        if not (self.then and self.now and self.then.at and self.now.at):
            return None
        return float(distance_m(*self.then.at, *self.now.at))

    @property
    def is_alike(self) -> bool:
        """True where both accept the same place, or neither accepts any."""
        if self.then is None or self.now is None:
            return False
        return (self.then.accepted, self.then.accepted and self.then.place) == (
            self.now.accepted,
            self.now.accepted and self.now.place,
        )


def beside(then: Sequence[Line], now: Sequence[Line]) -> list[QueryPair]:
    """Put the queries of two logs side by side, by their names, in the order of the flight."""
    one, other = (
        {line["query"]: _result(line) for line in lines if line.get("kind") == "query"} for lines in (then, now)
    )
    return [QueryPair(name, one.get(name), other.get(name)) for name in one | other]


def table(pairs: Sequence[QueryPair]) -> list[tuple[str, Any, Any]]:
    """Return the rows of a summary: what, of the flight, of the other one."""
    both = [[getattr(pair, side) for pair in pairs if getattr(pair, side)] for side in ("then", "now")]
    off_m = [[each.off_gps_m for each in seen if each.off_gps_m is not None] for seen in both]
    return [
        ("queries", *map(len, both)),
        ("accepted", *(sum(each.accepted for each in seen) for seen in both)),
        ("fixes sent", *(sum(each.has_fix for each in seen) for seen in both)),
        ("off GPS, median m", *(round(median(each), 1) if each else None for each in off_m)),
        ("off GPS, largest m", *(round(max(each), 1) if each else None for each in off_m)),
    ]


def _result(line: Line) -> QueryResult:
    located, vehicle = line.get("located"), line.get("vehicle") or {}
    at = (located["lat_deg"], located["lon_deg"]) if located else None
    truth = vehicle if vehicle.get("has_gps") else None
    fix = line.get("fix") or {}
    return QueryResult(
        accepted=line["accepted"],
        reason=line["reason"],
        place=line.get("place"),
        confidence=line.get("confidence"),
        at=at,
        off_gps_m=float(distance_m(*at, truth["lat_deg"], truth["lon_deg"])) if at and truth else None,
        has_fix=fix.get("lat_deg") is not None and fix.get("sent") is not False,
    )
