"""Matching in sequences: a place counts as recognised when the queries before it fit the places before it.

The trajectory search of Milford and Wyeth 2012 (SeqSLAM, equations 4 to 6) over the scores of any technique. The map
is taken to have been flown in its order, and the queries to be made in the same direction, at 0.8 to 1.2 places a
query. What flies the other way, or asks much more or less often than the map was made, is not followed: the places
found would lag behind. So that none of them is accepted, all other speeds are tried too, as rivals.
"""

import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgevpr.contract import TechniqueSpec
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking

V_MIN, V_MAX, _V_STEP = 0.8, 1.2, 0.1  # places a query, as in the paper
_OTHER_SPEEDS = np.arange(-2.5, 3.01, 0.25)  # places a query; ten queries tell them from those between
# At 10 m/s the vehicle has then left the neighbourhood of 50 m, and no velocity makes up for the places in between.
_GAP_S = 5.0
_NEWEST, _NEWEST_ALONE, _BEST_SHARE = 3, 2, 0.1
_USUAL_INTERVALS = 3  # a technique that takes 6 s a query leaves gaps of 6 s, and they are none


def length_of(spec: TechniqueSpec, asked: int | None) -> int:
    """Say how many queries are matched together: what is asked for, else the technique's own number."""
    return asked or spec.sequence


def search_of(length: int) -> "Search":
    """Make the search over sequences of `length` queries; of one query, none."""
    return SequenceSearch(length) if length > 1 else Alone()


def bytes_beside_place(length: int) -> int:
    """What a sequence adds to the resident bytes of a place: a score a query, and that of its rivals."""
    return 4 * (length + 1) if length > 1 else 0


class Alone:
    """Each query by itself: what a `SequenceSearch` is where nothing is searched."""

    length = frames = 1

    def follow(self, ranking: Ranking, index: PlaceIndex, t_mono_s: float) -> Ranking:
        """Give the ranking of the newest query as it is."""
        return ranking


class SequenceSearch:
    """The last `length` queries' scores of all places, followed from query to query.

    `frames` of them are there: until there are `length`, nothing may be accepted. `rivals`, float32 (N,), are the best
    mean scores at speeds that are not followed: no place may be accepted that is not ahead of those elsewhere. `gap_s`
    seconds without a query begin a new sequence, unless the queries before came almost as seldom.
    """

    def __init__(self, length: int, v_min: float = V_MIN, v_max: float = V_MAX, gap_s: float = _GAP_S) -> None:
        self.length = length
        self._trajectories = trajectories(length, _followed(v_min, v_max))
        others = [velocity for velocity in _OTHER_SPEEDS if not v_min <= velocity <= v_max]
        self._other_trajectories = trajectories(length, np.array(others))
        self.rivals = np.empty(0, np.float32)
        self._gap_s = gap_s
        self._rows: deque[np.ndarray] = deque(maxlen=length)  # newest first
        self._usual: deque[float] = deque(maxlen=_NEWEST_ALONE)  # score of the places that were not compared
        self._known = (0, 0)  # places of the index, and the checksum of their ids
        self._t_last_s: float | None = None
        self._interval_s = 0.0

    @property
    def frames(self) -> int:
        """Queries in the sequence so far, at most `length`."""
        return len(self._rows)

    @property
    def nbytes(self) -> int:
        return sum(row.nbytes for row in self._rows) + self.rivals.nbytes

    def follow(self, ranking: Ranking, index: PlaceIndex, t_mono_s: float) -> Ranking:
        """Take the ranking of the newest query, made at `t_mono_s`, and rank the places by their best trajectory.

        A place that a query was not compared with has the usual score there, the median of those that were: with 0,
        rivals would sink, and any place that is always compared would seem ahead. What lies before the first place of
        the map has score 0. Matches keep what the newest query says of the place (step, rotation), where it was
        compared.
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
        self._known = (len(index), zlib.crc32(index.place_ids))

        means = best_means(self._rows, self._trajectories)
        self.rivals = best_means(self._rows, self._other_trajectories)
        worth_naming = means > 0
        worth_naming[ranking.slots] = True
        slots = np.flatnonzero(worth_naming)
        slots = slots[np.argsort(-means[slots], kind="stable")]
        matches = {slot: replace(match, score=float(means[slot])) for slot, match in ranking.compared.items()}
        return Ranking(slots, means[slots], matches)

    def goes_on(self, near: np.ndarray, min_score: float) -> bool:
        """Whether the newest queries alone still see what the sequence sees: `near` bool (N,) is the neighbourhood of
        its best place. The mean of a sequence follows a vehicle that has left the mapped way, or the map, for as long
        as the queries before bear it. So the last three together must see that neighbourhood too, and each of the last
        two must find it, with `min_score`, where one neighbourhood in ten would be found by chance."""
        newest = list(self._rows)[:_NEWEST]
        together = best_means(newest, [trajectory[:_NEWEST] for trajectory in self._trajectories])
        if not near[together.argmax()]:
            return False
        for row, usual in zip(newest[:_NEWEST_ALONE], self._usual, strict=False):
            seen = float(row[near[: len(row)]].max(initial=0))
            # The usual score is that of a place not compared, which a technique without a limit would let pass.
            if seen <= usual or seen < min_score or np.count_nonzero(row > seen) * near.sum() > _BEST_SHARE * len(row):
                return False
        return True

    def _broken(self, index: PlaceIndex, t_mono_s: float) -> bool:
        """Whether this query does not go on where the last one was: too much time between, or another index."""
        before_s, usual_s = self._t_last_s, self._interval_s
        self._t_last_s = t_mono_s
        if before_s is None:
            return False
        self._interval_s = t_mono_s - before_s
        places, checksum = self._known
        return (
            self._interval_s > max(self._gap_s, _USUAL_INTERVALS * usual_s)
            or len(index) < places
            or zlib.crc32(index.place_ids[:places]) != checksum
        )


def trajectories(length: int, velocities: np.ndarray) -> list[list[int]]:
    """How many slots before the newest each query of a trajectory was, newest first; one list a velocity."""
    # Halves go up, whatever the last bit of the product.
    back = np.floor(velocities[:, None] * np.arange(length) + 0.5 + 1e-9).astype(int)
    return np.unique(back, axis=0).tolist()


def _followed(v_min: float, v_max: float) -> np.ndarray:
    """The speeds of the search."""
    return np.linspace(v_min, v_max, round((v_max - v_min) / _V_STEP) + 1)


def best_means(rows: Sequence[np.ndarray], trajectories: Sequence[Sequence[int]]) -> np.ndarray:
    """The best mean score of the trajectories that end at each slot: rows float32 (up to N,), newest first -> (N,).

    Older rows may be shorter, where the index has grown since.
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


def offline(scores: np.ndarray, length: int, v_min: float = V_MIN, v_max: float = V_MAX) -> np.ndarray:
    """Give what `SequenceSearch` makes of all queries of a flight at once, the same numbers: float32 (Q, N) -> (Q,
    N)."""
    queries, places = scores.shape
    best = np.zeros((queries, places), np.float32)
    for trajectory in trajectories(length, _followed(v_min, v_max)):
        total = np.zeros_like(best)
        for age, back in enumerate(trajectory):
            if age < queries and back < places:
                total[age:, back:] += scores[: queries - age, : places - back]
        np.maximum(best, total, out=best)
    frames = np.minimum(np.arange(queries) + 1, length).astype(np.float32)
    return best / frames[:, None]


Search = Alone | SequenceSearch
