"""Chooses the moments of a flight that its report shows: matches far from GPS, fixes refused or held back, long times
without a match, the least exact match, the slowest query. A function for each kind yields its moments."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

from edgevpr.review.logged import FixOutcome, LoggedFlight, LoggedQuery
from edgevpr.review.svg import clock

_FAR_M = 15.0  # from GPS: less is the error of a receiver, and no danger
_HELD = "held back"  # begins the `why` of a fix that was not sent because it contradicts the autopilot
_LONG_S = 5.0
_NEAR_S = 5.0  # of two moments that are closer in time only the first is shown
_OF_A_KIND, _MOST = 2, 6  # moments at most, of one kind and in all


@dataclass(frozen=True, slots=True)
class WorstMoment:
    """A query to show in the report, and a sentence on why."""

    query: LoggedQuery
    why: str


def worst(flight: LoggedFlight) -> list[WorstMoment]:
    """Return the worst moments, at most `_MOST`; those that could have been dangerous come first."""
    chosen: list[WorstMoment] = []
    for moments in (_far, _refused, _held, _nothing, _unsure, _slow):
        of_kind = 0
        for moment in moments(flight.queries):
            if of_kind < _OF_A_KIND and all(abs(moment.query.t_s - other.query.t_s) > _NEAR_S for other in chosen):
                chosen.append(moment)
                of_kind += 1
    return chosen[:_MOST]


def _far(queries: list[LoggedQuery]) -> Iterator[WorstMoment]:
    far = [(query.off_m, query) for query in queries if query.off_m is not None and query.off_m > _FAR_M]
    for off_m, query in sorted(far, key=lambda pair: -pair[0]):
        yield WorstMoment(query, f"The match lies {off_m:.0f} m from GPS: one of both is wrong.")


def _refused(queries: list[LoggedQuery]) -> Iterator[WorstMoment]:
    for query in queries:
        if query.fix and query.fix.outcome is FixOutcome.REFUSED:
            yield WorstMoment(query, f"The autopilot refused the fix: {query.fix.why or 'it does not say why'}.")


def _held(queries: list[LoggedQuery]) -> Iterator[WorstMoment]:
    for query in queries:
        if query.fix and (query.fix.why or "").startswith(_HELD):
            yield WorstMoment(query, f"The fix was {query.fix.why}.")


def _nothing(queries: list[LoggedQuery]) -> Iterator[WorstMoment]:
    """Yield the middles of the times without an accepted match, the longest first."""
    times = [list(several) for accepted, several in groupby(queries, lambda query: query.accepted) if not accepted]
    for several in sorted(times, key=lambda several: several[0].t_s - several[-1].t_s):
        if several[-1].t_s - several[0].t_s >= _LONG_S:
            since = f"{clock(several[0].t_s)} to {clock(several[-1].t_s)}"
            why = f"Nothing was recognised from {since}, in {len(several)} queries."
            yield WorstMoment(several[len(several) // 2], why)


def _unsure(queries: list[LoggedQuery]) -> Iterator[WorstMoment]:
    known = [(query.accuracy_m, query) for query in queries if query.accepted and query.accuracy_m is not None]
    for accuracy_m, query in sorted(known, key=lambda pair: -pair[0])[:1]:
        yield WorstMoment(query, f"Of the accepted matches this is the least exact: good to {accuracy_m:.1f} m.")


def _slow(queries: list[LoggedQuery]) -> Iterator[WorstMoment]:
    known = [(query.wall_ms, query) for query in queries if query.wall_ms is not None]
    for wall_ms, query in sorted(known, key=lambda pair: -pair[0])[:1]:
        yield WorstMoment(query, f"The slowest query: it took {wall_ms:.0f} ms.")
