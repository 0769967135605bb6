"""Judges a rehearsed mission by where the aircraft truly was, and says what to expect of the real one. `mission` flies
it."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Place
from edgevpr.frames.positions import GeoTag
from edgevpr.lab.simulate.motion import FlownTrack, interpolate_track
from edgevpr.review.logged import LoggedFlight, LoggedQuery, Point, number, point, text
from edgevpr.review.overhead import at_of

WRONG_SHARE = 0.25  # of the ground in a picture: a match that is farther off is wrong
# The rules of docs/tutorial/first-flight.md for a dry flight; farther off, `Navigator` gives up.
_MIN_ACCEPTED_SHARE = 0.5
_MAX_GAP_S = 30.0
_MAX_OFF_M = 50.0
_LONG_S = 5.0  # a shorter time without a match is not worth a line
_MAX_STRETCHES = 8


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
class RehearsalReport:
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

    @property
    def answer(self) -> str:
        """The outcome in a sentence."""
        if not self.is_to_work:
            return f"This mission is expected to fail over this map: {'; '.join(self.reasons)}."
        most_m = self.autopilot_error.most_m if self.autopilot_error else math.nan
        return (
            "This mission is expected to work over this map: without GPS the autopilot was at most "
            f"{most_m:.0f} m off, and no match was wrong."
        )


@dataclass(frozen=True, slots=True)
class RehearsedFlight:
    """A rehearsed flight: its log, the lines of it, and the track by whose pictures it was flown. `start_s` is when the
    track began, on the clock of the log."""

    flight: LoggedFlight
    lines: Sequence[dict[str, Any]]
    track: FlownTrack
    start_s: float

    def errors_m(self, reported: Iterable[tuple[float, Point]], since_s: float) -> list[float]:
        """Return how far off positions are, of those reported since a time on the clock of the log."""
        states = [(interpolate_track(self.track, t_s - self.start_s), at) for t_s, at in reported if t_s >= since_s]
        return [float(distance_m(*state.point, *at)) for state, at in states]


def judge_by_tags(flight: LoggedFlight, tags: Mapping[str, GeoTag]) -> None:
    """Judge the queries of a flight by where their pictures were taken; those without a position are left out."""
    flight.truth = "the truth"
    positions = [(query, tags[query.name].position) for query in flight.queries]
    flight.queries = [_judge(query, (at.lat_deg, at.lon_deg)) for query, at in positions if at]


def _judge(query: LoggedQuery, truth: Point) -> LoggedQuery:
    return replace(query, gps_at=truth, true_at=truth)


def report_on(
    flown: RehearsedFlight, ground: Sequence[Place], footprint_m: float, gps_until_s: float
) -> RehearsalReport:
    """Judge a flight over the places of `ground`, whose pictures show `footprint_m` of it."""
    queries, lost_s = flown.flight.queries, flown.start_s + gps_until_s
    errors_m = [query.off_m for query in queries if query.off_m is not None]
    wrong_m = [error_m for error_m in errors_m if error_m > WRONG_SHARE * footprint_m]
    reported = [(number(query.line, "vehicle", "t_heard_s"), query.autopilot_at) for query in queries]
    autopilot = _spread(flown.errors_m([(t_s, at) for t_s, at in reported if t_s is not None and at], lost_s))
    stretches = sorted(_stretches(queries, ground, footprint_m), key=lambda stretch: -stretch.lasts_s)
    gap_s = stretches[0].lasts_s if stretches else 0.0
    accepted = sum(query.accepted for query in queries)
    off_m = autopilot.most_m if autopilot else 0.0
    findings = {
        f"{len(wrong_m)} of the accepted matches wrong, by up to {max(wrong_m, default=0):.0f} m": bool(wrong_m),
        f"only {accepted} of {len(queries)} pictures are recognised": accepted < _MIN_ACCEPTED_SHARE * len(queries),
        f"nothing is recognised for {gap_s:.0f} s": gap_s > _MAX_GAP_S,
        "the autopilot reports no position without GPS": autopilot is None,
        f"the autopilot is up to {off_m:.0f} m off without GPS": off_m > _MAX_OFF_M,
    }
    reasons = tuple(reason for reason, is_so in findings.items() if is_so)
    longest = [stretch for stretch in stretches[:_MAX_STRETCHES] if stretch.lasts_s >= _LONG_S]
    return RehearsalReport(
        is_to_work=not reasons,
        reasons=reasons,
        way_m=_ways_m(queries)[-1],
        gps_until_s=gps_until_s,
        queries=len(queries),
        accepted=accepted,
        wrong=len(wrong_m),
        wrong_from_m=WRONG_SHARE * footprint_m,
        longest_gap_s=gap_s,
        unrecognised=tuple(sorted(longest, key=lambda stretch: stretch.from_m)),
        match_error=_spread(errors_m),
        sent_error=_spread(flown.errors_m(_sent(flown.lines), lost_s)),
        autopilot_error=autopilot,
    )


def _sent(lines: Iterable[dict[str, Any]]) -> Iterator[tuple[float, Point]]:
    """Yield the time and the position of each fix that was sent, for a match or between two."""
    fixes: dict[str, Point] = {}
    for line in lines:
        name, at, sent_s = text(line, "query") or "", None, number(line, "t_sent_s")
        if line["kind"] == "query" and (fix := point(line, "fix")):
            fixes[name] = fix
        elif line["kind"] in ("answer", "between"):
            at = point(line) or fixes.get(name)
        if at and sent_s is not None:
            yield sent_s, at


def _spread(errors_m: Sequence[float]) -> Spread | None:
    return Spread(*np.quantile(errors_m, (0.5, 0.9, 1.0)).round(2).tolist()) if errors_m else None


def _ways_m(queries: Sequence[LoggedQuery]) -> list[float]:
    steps_m = [float(distance_m(*a.true_at, *b.true_at)) for a, b in pairwise(queries) if a.true_at and b.true_at]
    return [0.0, *np.cumsum(steps_m).tolist()]


def _stretches(queries: Sequence[LoggedQuery], ground: Sequence[Place], footprint_m: float) -> Iterator[Stretch]:
    """Yield every time without an accepted match: from one to the next, or to an end of the flight."""
    ways_m, places = _ways_m(queries), np.array([at_of(place) for place in ground])
    ends = sorted({0, *(index for index, query in enumerate(queries) if query.accepted), len(queries) - 1})
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
