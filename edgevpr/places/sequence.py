"""Matching in sequences: a place is recognised when the queries before the newest one fit the places before it.

The trajectory search of Milford and Wyeth 2012 (SeqSLAM, equations 4 to 6) over the scores of any technique. It
assumes that the places of the map are in the order of the flight, and that the queries pass them in the same direction,
at 0.8 to 1.2 places a query. An aircraft that flies the other way, or at a very different number of places a query, is
not followed: the places found would lag behind. To keep such places from being accepted, other speeds are tried too,
as rivals.
"""

import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgevpr.core.arrays import Bools, Floats, Ints, Singles
from edgevpr.core.contract import TechniqueSpec
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking

FOLLOWED_SPEEDS = np.linspace(0.8, 1.2, 5)  # places a query, as in the paper
_SPEEDS = np.arange(-2.5, 3.01, 0.25)  # places a query; a step that a sequence of ten queries can tell apart
_OTHER_SPEEDS = _SPEEDS[(FOLLOWED_SPEEDS[0] > _SPEEDS) | (FOLLOWED_SPEEDS[-1] < _SPEEDS)]
# After this time at 10 m/s the vehicle has left the neighbourhood of 50 m, and no velocity covers the places between.
_GAP_S = 5.0
_NEWEST, _NEWEST_ALONE, _BEST_SHARE = 3, 2, 0.1
_USUAL_INTERVALS = 3  # a technique that takes 6 s a query always pauses for 6 s: that is no gap


def length_of(spec: TechniqueSpec, asked: int | None) -> int:
    """Return how many queries are matched together: the number asked for, else the technique's own."""
    return asked or spec.sequence


def search_of(length: int) -> "SequenceSearch | None":
    """Make the search over sequences of `length` queries; None for a length of one: each query is matched alone."""
    return SequenceSearch(length) if length > 1 else None


def bytes_beside_place(length: int) -> int:
    """Return the resident bytes that a sequence adds to each place: a score for each query, and one for the rivals."""
    return 4 * (length + 1) if length > 1 else 0


class SequenceSearch:
    """The scores of all places for the last `length` queries, followed from query to query.

    `frames` is the number of queries so far: until it is `length`, no place may be accepted. `rivals`, float32 (N,),
    are the best mean scores at speeds that are not followed: an accepted place must be ahead of the rivals elsewhere. A
    pause longer than five seconds, and than three times the interval before it, begins a new sequence.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._trajectories = trajectories(length, FOLLOWED_SPEEDS)
        self._other_trajectories = trajectories(length, _OTHER_SPEEDS)
        self.rivals: Singles = np.empty(0, np.float32)
        self._rows: deque[Singles] = deque(maxlen=length)  # newest first
        self._usual: deque[float] = deque(maxlen=_NEWEST_ALONE)  # score of the places not compared, by query
        self._known = (0, 0)  # number of places of the index, and the checksum of their ids
        self._t_last_s: float | None = None
        self._interval_s = 0.0

    @property
    def frames(self) -> int:
        """Number of queries in the sequence so far, at most `length`."""
        return len(self._rows)

    @property
    def nbytes(self) -> int:
        return sum(row.nbytes for row in self._rows) + self.rivals.nbytes

    def follow(self, ranking: Ranking, index: PlaceIndex, t_mono_s: float) -> Ranking:
        """Take the ranking of the newest query, made at `t_mono_s`, and rank the places by their best trajectory.

        A place that a query was not compared with gets the usual score, the median score of the compared places. With
        0 instead, rivals would sink, and any place that is always compared would seem ahead. A trajectory has score 0
        before the first place of the map. Matches exist for the places compared with the newest query: they keep its
        step and rotation, and have the score of the sequence.
        """
        if self._broken(index, t_mono_s):
            self._rows.clear()
        if self.frames == self.length:
            self._rows.pop()
        usual = float(np.median(ranking.scores)) if len(ranking.slots) < len(index) else 0.0
        self._usual.appendleft(usual)
        row = np.full(len(index), usual, np.float32)
        row[ranking.slots] = ranking.scores
        self._rows.appendleft(row)
        self._known = (len(index), _checksum(index.place_ids))

        means = best_means(self._rows, self._trajectories)
        self.rivals = best_means(self._rows, self._other_trajectories)
        worth_naming = means > 0
        worth_naming[ranking.slots] = True
        slots = np.flatnonzero(worth_naming)
        slots = slots[np.argsort(-means[slots], kind="stable")]
        matches = {slot: replace(match, score=float(means[slot])) for slot, match in ranking.compared.items()}
        return replace(ranking, slots=slots, scores=means[slots], compared=matches)

    def goes_on(self, near: Bools, min_score: float) -> bool:
        """Tell whether the newest queries alone still agree with the sequence.

        `near` bool (N,) is the neighbourhood of the sequence's best place. After a vehicle has left the mapped track,
        or the map, the mean of the sequence stays high until enough old queries are gone. So the best place of the
        last three queries together must be in `near`. And each of the last two must score in `near` at least
        `min_score`, and so high that at most one neighbourhood in ten would reach it by chance.
        """
        newest = list(self._rows)[:_NEWEST]
        together = best_means(newest, [trajectory[:_NEWEST] for trajectory in self._trajectories])
        if not near[together.argmax()]:
            return False
        for row, usual in zip(newest[:_NEWEST_ALONE], self._usual, strict=False):
            seen = float(row[near[: len(row)]].max(initial=0))
            # Places that were not compared have the usual score, which would pass a `min_score` of 0.
            if seen <= usual or seen < min_score or np.count_nonzero(row > seen) * near.sum() > _BEST_SHARE * len(row):
                return False
        return True

    def _broken(self, index: PlaceIndex, t_mono_s: float) -> bool:
        """Tell whether this query cannot continue the sequence: too long since the last query, or another index."""
        before_s, usual_s = self._t_last_s, self._interval_s
        self._t_last_s = t_mono_s
        if before_s is None:
            return False
        self._interval_s = t_mono_s - before_s
        places, checksum = self._known
        return (
            self._interval_s > max(_GAP_S, _USUAL_INTERVALS * usual_s)
            or len(index) < places
            or _checksum(index.place_ids[:places]) != checksum
        )


def trajectories(length: int, velocities: Floats) -> list[list[int]]:
    """Return how many slots before the newest query each query of a trajectory was, newest first.

    Gives one list for each velocity (places a query); velocities with equal lists share one.
    """
    # Halves go up, also where the product has a rounding error in its last bit.
    back = np.floor(velocities[:, None] * np.arange(length) + 0.5 + 1e-9).astype(int)
    unique: list[list[int]] = np.unique(back, axis=0).tolist()
    return unique


def _checksum(place_ids: Ints) -> int:
    return zlib.crc32(place_ids.data)


def best_means(rows: Sequence[Singles], trajectories: Sequence[Sequence[int]]) -> Singles:
    """Return the best mean score of the trajectories that end at each slot: rows float32 (up to N,), newest first ->
    (N,). Older rows may be shorter, where the index has grown since.
    """
    best, total = np.zeros_like(rows[0]), np.empty_like(rows[0])
    for trajectory in trajectories:
        total[:] = 0
        for row, back in zip(rows, trajectory, strict=False):
            first, last = max(0, -back), min(len(row), len(total) - back)
            if first < last:
                total[first + back : last + back] += row[first:last]
        np.maximum(best, total, out=best)
    best /= len(rows)
    return best
