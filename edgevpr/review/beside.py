"""Two flights side by side, query by query: as it was flown, and as it would have been."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from edgevpr.core.geodesy import distance_m
from edgevpr.review.compare import Line


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
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
class Pair:
    """One query of both flights; None where one has none of that name."""

    query: str
    then: Seen | None
    now: Seen | None

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


def beside(then: Sequence[Line], now: Sequence[Line]) -> list[Pair]:
    """Put the queries of two logs side by side, by their names, in the order of the flight."""
    one, other = (
        {line["query"]: _seen(line) for line in lines if line.get("kind") == "query"} for lines in (then, now)
    )
    return [Pair(name, one.get(name), other.get(name)) for name in one | other]


def table(pairs: Sequence[Pair]) -> list[tuple[str, Any, Any]]:
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


def _seen(line: Line) -> Seen:
    located, vehicle = line.get("located"), line.get("vehicle") or {}
    at = (located["lat_deg"], located["lon_deg"]) if located else None
    truth = vehicle if vehicle.get("has_gps") else None
    fix = line.get("fix") or {}
    return Seen(
        accepted=line["accepted"],
        reason=line["reason"],
        place=line.get("place"),
        confidence=line.get("confidence"),
        at=at,
        off_gps_m=float(distance_m(*at, truth["lat_deg"], truth["lon_deg"])) if at and truth else None,
        has_fix=fix.get("lat_deg") is not None and fix.get("sent") is not False,
    )
