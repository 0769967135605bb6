"""The moments of a flight that are worth a look: where a match is far from GPS, the autopilot refused, nothing was
recognised for long, or little was sure."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from edgevpr.review.charts import clock
from edgevpr.review.flight import Flight, Outcome, Query

_FAR_M = 15.0  # from GPS: less is the error of a receiver, and no danger
_HELD = "held back"  # how the reason begins, why a fix that contradicts the autopilot was not sent
_LONG_S = 5.0
_NEAR_S = 5.0  # two moments that are nearer show the same
_OF_A_KIND, _MOST = 2, 6


@dataclass(frozen=True, slots=True)
class Moment:
    """A query worth a look, and why it is."""

    query: Query
    why: str


def worst(flight: Flight) -> list[Moment]:
    """Return the worst moments, those first that could have been dangerous."""
    kinds = (_far(flight), _refused(flight), _held(flight), _nothing(flight), _unsure(flight), _slow(flight))
    chosen: list[Moment] = []
    for kind in kinds:
        chosen += _apart(kind, [each.query.t_s for each in chosen])
    return chosen[:_MOST]


def _apart(moments: Iterable[Moment], taken_s: list[float]) -> list[Moment]:
    chosen: list[Moment] = []
    for moment in moments:
        if all(abs(moment.query.t_s - each) > _NEAR_S for each in taken_s):
            chosen.append(moment)
            taken_s.append(moment.query.t_s)
        if len(chosen) == _OF_A_KIND:
            break
    return chosen


def _far(flight: Flight) -> Iterator[Moment]:
    far = [each for each in flight.queries if each.off_m is not None and each.off_m > _FAR_M]
    for query in sorted(far, key=lambda each: -each.off_m):
        yield Moment(query, f"The match lies {query.off_m:.0f} m from GPS: one of both is wrong.")


def _refused(flight: Flight) -> Iterator[Moment]:
    for query in flight.queries:
        if query.fix and query.fix.outcome is Outcome.REFUSED:
            yield Moment(query, f"The autopilot refused the fix: {query.fix.why or 'it does not say why'}.")


def _held(flight: Flight) -> Iterator[Moment]:
    for query in flight.queries:
        if query.fix and (query.fix.why or "").startswith(_HELD):
            yield Moment(query, f"The fix was {query.fix.why}.")


def _nothing(flight: Flight) -> Iterator[Moment]:
    """Yield the middles of the times without an accepted match, the longest first."""
    times: list[list[Query]] = [[]]
    for query in flight.queries:
        if query.accepted:
            times.append([])
        else:
            times[-1].append(query)
    lasting = [(each[-1].t_s - each[0].t_s, each) for each in times if each]
    for lasted_s, each in sorted(lasting, key=lambda one: -one[0]):
        if lasted_s >= _LONG_S:
            since = f"{clock(each[0].t_s)} to {clock(each[-1].t_s)}"
            yield Moment(each[len(each) // 2], f"Nothing was recognised from {since}, in {len(each)} queries.")


def _unsure(flight: Flight) -> Iterator[Moment]:
    known = [each for each in flight.queries if each.accepted and each.accuracy_m is not None]
    for query in sorted(known, key=lambda each: -each.accuracy_m)[:1]:
        yield Moment(query, f"Of the accepted matches this is the least exact: good to {query.accuracy_m:.1f} m.")


def _slow(flight: Flight) -> Iterator[Moment]:
    known = [each for each in flight.queries if each.wall_ms is not None]
    for query in sorted(known, key=lambda each: -each.wall_ms)[:1]:
        yield Moment(query, f"The slowest query: it took {query.wall_ms:.0f} ms.")
