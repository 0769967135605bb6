"""Compares a flight with its replay, for `edgevpr replay`: the lines of both logs, the packets sent on the links, byte
by byte, and the queries. In names here, "then" is the flight and "now" its replay."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from edgevpr.core.geodesy import distance_m
from edgevpr.mavlink.wire import mavlink

Line = dict[str, Any]

_SIGNATURE_BYTES = 13

# Fields of a log's first line that describe the program that flew, not the flight.
PROGRAM = "version", "machine", "python", "libraries"


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A line that differs: its kind, its time and the name of its query (None: it is about no query). `fields` has the
    fields that differ, by dotted name (like "fix.sent"), as (value in the flight, value in the replay). `in_flight` and
    `in_replay` are False if that log has no such line."""

    kind: str
    t_mono_s: float
    query: str | None
    fields: dict[str, tuple[Any, Any]]
    in_flight: bool = True
    in_replay: bool = True


@dataclass(frozen=True, slots=True)
class Lines:
    """Comparison of two logs: how many lines are `alike`, the `others`, which differ, and how many lines of the flight
    come `after` the end of the replay. `program` has the fields of `PROGRAM` that differ, by name, as (then, now)."""

    alike: int
    others: list[Difference]
    after: int
    program: dict[str, tuple[Any, Any]]


def compare(then: Iterable[Line], now: Iterable[Line]) -> Lines:
    """Compare the lines of a flight's log with those of its replay. If a full disk has cost the flight lines (its log
    then has a line of kind "gap"), lines that only the replay has are no differences."""
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
    """Yield for each line two parts: its key, which is its kind, time and query, and its number among the lines in
    which these three are equal;
    the line itself."""
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
    """A pair of packets that differ: the time on the flight's clock, the name of the link, the packet of the flight and
    that of the replay (None: there was none)."""

    t_s: float
    link: str
    then: bytes | None
    now: bytes | None


class Packets:
    """Comparison of the packets that the flight sent with those that its replay sends: how many are `alike`, how many
    `renumbered` (equal but for the sequence number, which an earlier difference has shifted), and the `others`."""

    def __init__(self) -> None:
        self.alike = self.renumbered = 0
        self.others: list[PacketDifference] = []

    def compare(self, t_s: float, link: str, then: bytes | None, now: bytes | None) -> None:
        """Compare two packets (None: none was sent). Signatures are left out: no recording holds the key for them."""
        if then is None and now is None:
            return
        if then and now and _unsigned(then) == _unsigned(now):
            self.alike += 1
        elif then and now and _unnumbered(then) == _unnumbered(now):
            self.renumbered += 1
        else:
            self.others.append(PacketDifference(t_s, link, then, now))


def described(packet: bytes | None) -> str:
    """Return a MAVLink packet as text; "nothing" for None."""
    if packet is None:
        return "nothing"
    (message,) = mavlink.MAVLink(None).parse_buffer(packet)
    return f"{message} (sequence number {message.get_seq()})"


def _unsigned(packet: bytes) -> bytes:
    is_signed = packet[0] == mavlink.PROTOCOL_MARKER_V2 and packet[2] & mavlink.MAVLINK_IFLAG_SIGNED
    return packet[:-_SIGNATURE_BYTES] if is_signed else packet


def _unnumbered(packet: bytes) -> bytes:
    """Return a packet without its sequence number, checksum (which depends on that number) and signature."""
    at = 4 if packet[0] == mavlink.PROTOCOL_MARKER_V2 else 2
    unsigned = _unsigned(packet)
    return unsigned[:at] + unsigned[at + 1 : -2]


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryResult:
    """The outcome of a query: whether it was `accepted`, and the reason, the number of its `place` and its confidence.
    `at` is the position of the match (latitude, longitude in degrees), `off_gps_m` its distance from the position of an
    autopilot that has GPS, and `has_fix` says whether a fix was sent. None: unknown."""

    accepted: bool
    reason: str
    place: int | None
    confidence: float | None
    at: tuple[float, float] | None
    off_gps_m: float | None
    has_fix: bool


@dataclass(frozen=True, slots=True)
class QueryPair:
    """The outcomes of one query in the flight and in the replay; None: there is no query of that name."""

    query: str
    then: QueryResult | None
    now: QueryResult | None

    @property
    def apart_m(self) -> float | None:
        """Metres between the positions of both matches; None if one of them is missing."""
        if not (self.then and self.now and self.then.at and self.now.at):
            return None
        return float(distance_m(*self.then.at, *self.now.at))

    @property
    def is_alike(self) -> bool:
        """True if both accept the same place, or neither accepts a place."""
        if self.then is None or self.now is None:
            return False
        return (self.then.accepted, self.then.accepted and self.then.place) == (
            self.now.accepted,
            self.now.accepted and self.now.place,
        )


def beside(then: Sequence[Line], now: Sequence[Line]) -> list[QueryPair]:
    """Pair the queries of two logs by their names, in the order of the flight."""
    one, other = (
        {line["query"]: _result(line) for line in lines if line.get("kind") == "query"} for lines in (then, now)
    )
    return [QueryPair(name, one.get(name), other.get(name)) for name in one | other]


def table(pairs: Sequence[QueryPair]) -> list[tuple[str, Any, Any]]:
    """Return the rows of a summary, each with three parts: a label; the value of the flight; that of the replay."""
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
