"""Judges a rehearsed mission by where the aircraft truly was, and says what to expect of the real one. `mission` flies
it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Place
from edgevpr.lab.simulate.motion import FlownTrack, truth_at
from edgevpr.review.logged import LoggedFlight, LoggedQuery, Point, number, point, text
from edgevpr.review.overhead import at_of

WRONG_SHARE = 0.25  # of the ground in a picture: a match that is farther off is wrong
# The rules of docs/tutorial/first-flight.md for a dry flight; farther off, `Navigator` gives up.
_FEWEST_SHARE, _LONGEST_GAP_S, _MOST_OFF_M = 0.5, 30.0, 50.0
_LONG_S = 5.0  # a shorter time without a match is not worth a line
_MOST_STRETCHES = 8
_LATE_S = 0.3


@dataclass(frozen=True, slots=True)
class Spread:
    """The median, the 90 % quantile and the largest of errors in metres."""

    median_m: float
    p90_m: float
    most_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A part of the way on which nothing is recognised, in metres from its start; `lat_deg` and `lon_deg` are its
    middle. `on_map`: the map has places there."""

    from_m: float
    to_m: float
    lasts_s: float
    lat_deg: float
    lon_deg: float
    on_map: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Foreseen:
    """A rehearsed mission. `is_to_work`: it may be flown over this map, else `reasons` say why not. A match is `wrong`
    from `wrong_from_m` on. The errors of what was sent, and of the autopilot's own position, are those without GPS,
    which was there until `gps_until_s`; None: there was none to judge."""

    is_to_work: bool
    reasons: tuple[str, ...]
    way_m: float
    gps_until_s: float
    queries: int
    accepted: int
    wrong: int
    wrong_from_m: float
    longest_gap_s: float
    unrecognised: tuple[Stretch, ...]
    match_error: Spread | None
    sent_error: Spread | None
    autopilot_error: Spread | None


@dataclass(frozen=True, slots=True)
class Flown:
    """A rehearsed flight: its log, the lines of it, and the track by whose pictures it was flown. `start_s` is when the
    track began, on the clock of the log."""

    flight: LoggedFlight
    lines: Sequence[dict[str, Any]]
    track: FlownTrack
    start_s: float

    def true_at(self, t_mono_s: float) -> Point:
        """Return where the aircraft was at a time of the log."""
        state = truth_at(self.track, t_mono_s - self.start_s)
        return state.lat_deg, state.lon_deg


def late_s(taken_s: Sequence[float], frames_s: Sequence[float]) -> tuple[float, bool]:
    """Return the start of the track on the clock of a log, by its least late picture, and True if the computer did not
    keep up: a tenth of the pictures came late. `taken_s` are the times of the pictures on the track, `frames_s` in the
    log."""
    starts_s = np.subtract(frames_s, taken_s)
    return float(starts_s.min()), bool(np.quantile(starts_s, 0.9) > starts_s.min() + _LATE_S)


def expect(flown: Flown, ground: Sequence[Place], footprint_m: float, gps_until_s: float) -> Foreseen:
    """Judge a flight over the places of `ground`, whose pictures show `footprint_m` of it."""
    queries, lost_s = flown.flight.queries, flown.start_s + gps_until_s
    errors_m = [query.off_m for query in queries if query.off_m is not None]
    wrong_m = [error_m for error_m in errors_m if error_m > WRONG_SHARE * footprint_m]
    reported = [(number(query.line, "vehicle", "t_heard_s"), query.autopilot_at) for query in queries]
    own = [(t_s, at) for t_s, at in reported if t_s is not None and at and t_s >= lost_s]
    autopilot = _spread(_off_m(flown, own))
    stretches = list(_stretches(flown, ground, footprint_m))
    gap_s = max((each.lasts_s for each in stretches), default=0.0)
    accepted = sum(query.accepted for query in queries)
    found = {
        f"{len(wrong_m)} of the accepted matches wrong, by up to {max(wrong_m, default=0):.0f} m": bool(wrong_m),
        f"only {accepted} of {len(queries)} pictures are recognised": accepted < _FEWEST_SHARE * len(queries),
        f"nothing is recognised for {gap_s:.0f} s": gap_s > _LONGEST_GAP_S,
        "the autopilot reports no position without GPS": autopilot is None,
        f"the autopilot is up to {autopilot.most_m if autopilot else 0:.0f} m off without GPS": autopilot is not None
        and autopilot.most_m > _MOST_OFF_M,
    }
    reasons = tuple(reason for reason, is_so in found.items() if is_so)
    longest = sorted(stretches, key=lambda each: -each.lasts_s)[:_MOST_STRETCHES]
    return Foreseen(
        is_to_work=not reasons,
        reasons=reasons,
        way_m=_ways_m(queries)[-1],
        gps_until_s=gps_until_s,
        queries=len(queries),
        accepted=accepted,
        wrong=len(wrong_m),
        wrong_from_m=WRONG_SHARE * footprint_m,
        longest_gap_s=gap_s,
        unrecognised=tuple(each for each in stretches if each in longest and each.lasts_s >= _LONG_S),
        match_error=_spread(errors_m),
        sent_error=_spread(_off_m(flown, [each for each in _sent(flown.lines) if each[0] >= lost_s])),
        autopilot_error=autopilot,
    )


def with_truth(query: LoggedQuery, at: Point) -> LoggedQuery:
    """Return a query that is judged by `at`, where its picture was taken."""
    off_m = float(distance_m(*at, *query.at)) if query.at else None
    return replace(query, gps_at=at, true_at=at, off_m=off_m)


def _sent(lines: Iterable[dict[str, Any]]) -> Iterator[tuple[float, Point]]:
    """Yield the time and the position of each fix that was sent, for a match or between two."""
    fixes: dict[str, Point] = {}
    for line in lines:
        at, sent_s = None, number(line, "t_sent_s")
        if line["kind"] == "query" and (fix := point(line, "fix")):
            fixes[text(line, "query") or ""] = fix
        elif line["kind"] == "answer":
            at = fixes.get(text(line, "query") or "")
        elif line["kind"] == "between":
            at = point(line)
        if at and sent_s is not None:
            yield sent_s, at


def _off_m(flown: Flown, told: Iterable[tuple[float, Point]]) -> list[float]:
    return [float(distance_m(*flown.true_at(t_s), *at)) for t_s, at in told]


def _spread(errors_m: Sequence[float]) -> Spread | None:
    return Spread(*np.quantile(errors_m, (0.5, 0.9, 1.0)).round(2).tolist()) if errors_m else None


def _ways_m(queries: Sequence[LoggedQuery]) -> list[float]:
    steps_m = [float(distance_m(*a.true_at, *b.true_at)) for a, b in pairwise(queries) if a.true_at and b.true_at]
    return [0.0, *np.cumsum(steps_m).tolist()]


def _stretches(flown: Flown, ground: Sequence[Place], footprint_m: float) -> Iterator[Stretch]:
    """Yield every time without an accepted match: from one to the next, or to an end of the flight."""
    queries = flown.flight.queries
    ways_m, places = _ways_m(queries), np.array([at_of(place) for place in ground])
    ends = sorted({0, *(at for at, query in enumerate(queries) if query.accepted), len(queries) - 1})
    for first, last in pairwise(ends):
        middle = queries[(first + last) // 2].true_at
        if middle and last - first > 1:
            nearest_m = min(distance_m(*middle, *places.T), default=np.inf)
            yield Stretch(
                from_m=round(ways_m[first]),
                to_m=round(ways_m[last]),
                lasts_s=round(queries[last].t_s - queries[first].t_s, 1),
                lat_deg=middle[0],
                lon_deg=middle[1],
                on_map=bool(nearest_m < footprint_m / 2),
            )
