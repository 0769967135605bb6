"""Matching of sequences: a place is recognised if the last queries match the places that were mapped before it.

This is the trajectory search of Milford and Wyeth 2012 (SeqSLAM, equations 4 to 6), applied to the scores of any
technique. A trajectory assigns a slot of the index to each of the last queries, at a constant speed of 0.8 to 1.2
places per query, so places must be mapped in the order of the flight. At another speed, or backwards, the search finds
places that lag behind. So trajectories at other speeds (-2.5 to 3) are scored as well, and a place is accepted only if
it scores higher than these *rivals* at all places elsewhere."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgevpr.core.arrays import Bools, Floats, Singles
from edgevpr.places.index import PlaceIndex
from edgevpr.places.ranking import Ranking

_SEARCH_SPEEDS = np.linspace(0.8, 1.2, 5)  # places per query, as in the paper
_SPEEDS = np.arange(-2.5, 3.01, 0.25)  # places per query; ten queries can distinguish steps of 0.25
_OTHER_SPEEDS = _SPEEDS[(_SEARCH_SPEEDS[0] > _SPEEDS) | (_SEARCH_SPEEDS[-1] < _SPEEDS)]
# After 5 s at 10 m/s the vehicle has left the 50 m neighbourhood, and no trajectory covers the places in between.
_MAX_PAUSE_S = 5.0
_MAX_PAUSE_INTERVALS = 3  # a slow board may need longer for each query, such as 6 s
_MIN_QUERIES_AVERAGED = 3
_MIN_QUERIES_SINGLE = 2
_MAX_BETTER_FRACTION = 0.1


def make_sequence_search(length: int) -> "SequenceSearch | None":
    """Make the search over sequences of `length` queries; None for a length of 1: each query is matched alone."""
    return SequenceSearch(length) if length > 1 else None


def compute_sequence_bytes(length: int) -> int:
    """Return the bytes of RAM that a sequence needs per place: a float32 score per query and one for the rivals."""
    return 4 * (length + 1) if length > 1 else 0


class SequenceSearch:
    """The scores of all places for the last `length` queries, and the search for trajectories in them.

    Call `add_query` for each query. No place may be accepted before `frames`, the number of queries, is `length`.
    `rivals` float32 (N,) has, for each place, the best mean score of a trajectory that ends there at a speed outside
    0.8 to 1.2. A pause of over five seconds, and over three times the previous interval, starts a new sequence."""

    def __init__(self, length: int) -> None:
        self.length = length
        self._trajectories = make_trajectories(length, _SEARCH_SPEEDS)
        self._other_trajectories = make_trajectories(length, _OTHER_SPEEDS)
        self.rivals: Singles = np.empty(0, np.float32)
        self._rows: deque[Singles] = deque(maxlen=length)  # newest first
        self._default_scores: deque[float] = deque(maxlen=_MIN_QUERIES_SINGLE)  # of places not compared, per query
        self._t_last_s: float | None = None
        self._interval_s = 0.0

    @property
    def frames(self) -> int:
        """The number of queries in the sequence so far, at most `length`."""
        return len(self._rows)

    def add_query(self, ranking: Ranking, index: PlaceIndex, t_mono_s: float) -> Ranking:
        """Add the ranking of the newest query, taken at `t_mono_s` (monotonic seconds). Return a ranking of the places
        by the mean score of their best trajectory, with the matches of the newest query. A place that was not compared
        gets the median score of those that were (0 is too low for rivals); slots before the first place score 0."""
        if self._is_broken(t_mono_s):
            self._rows.clear()
        if self.frames == self.length:
            self._rows.pop()  # frees its memory before the next row is allocated
        default_score = float(np.median(ranking.scores)) if len(ranking.slots) < len(index) else 0.0
        self._default_scores.appendleft(default_score)
        row = np.full(len(index), default_score, np.float32)
        row[ranking.slots] = ranking.scores
        self._rows.appendleft(row)
        means = find_best_means(self._rows, self._trajectories)
        self.rivals = find_best_means(self._rows, self._other_trajectories)
        is_ranked = means > 0
        is_ranked[ranking.slots] = True
        slots = np.flatnonzero(is_ranked)
        slots = slots[np.argsort(-means[slots], kind="stable")]
        matches = {slot: replace(match, score=float(means[slot])) for slot, match in ranking.compared.items()}
        return replace(ranking, slots=slots, scores=means[slots], compared=matches)

    def is_continued(self, near: Bools, min_score: float) -> bool:
        """Return True if the newest queries alone still agree with the sequence, whose mean score stays high for a
        while after a vehicle has left the mapped track.

        `near` bool (N,) is True in the neighbourhood of the sequence's best place. The place with the best mean score
        over the last three queries must be in `near`. And for each of the last two, the best score in `near` must be at
        least `min_score`, and so high that at most a tenth of all neighbourhoods would reach it."""
        newest = list(self._rows)[:_MIN_QUERIES_AVERAGED]
        means = find_best_means(newest, [trajectory[:_MIN_QUERIES_AVERAGED] for trajectory in self._trajectories])
        if not near[means.argmax()]:
            return False
        for row, default_score in zip(newest[:_MIN_QUERIES_SINGLE], self._default_scores, strict=False):
            best = float(row[near].max(initial=0))
            # The default score, which places that were not compared have, would reach a `min_score` of 0.
            better_count = np.count_nonzero(row > best)
            if best <= default_score or best < min_score or better_count * near.sum() > _MAX_BETTER_FRACTION * len(row):
                return False
        return True

    def _is_broken(self, t_mono_s: float) -> bool:
        """Return True if this query cannot continue the sequence because the pause was too long."""
        last_s, last_interval_s = self._t_last_s, self._interval_s
        self._t_last_s = t_mono_s
        if last_s is None:
            return False
        self._interval_s = t_mono_s - last_s
        return self._interval_s > max(_MAX_PAUSE_S, _MAX_PAUSE_INTERVALS * last_interval_s)


def make_trajectories(length: int, velocities: Floats) -> list[list[int]]:
    """Return the trajectories of `length` queries at `velocities` (V,), in places per query, without duplicates: for
    each query, newest first, its distance in slots from the newest query, such as [0, 1, 2, ...] at a velocity of 1."""
    # Round halves up, even if the product has a rounding error in the last bit.
    lag = np.floor(velocities[:, None] * np.arange(length) + 0.5 + 1e-9).astype(int)
    unique: list[list[int]] = np.unique(lag, axis=0).tolist()
    return unique


def find_best_means(rows: Sequence[Singles], trajectories: Sequence[Sequence[int]]) -> Singles:
    """Return, for each slot, the best mean score of the trajectories that end there, float32 (N,). `rows` has the
    scores (N,) of each query, newest first."""
    best, total = np.zeros_like(rows[0]), np.empty_like(rows[0])
    for trajectory in trajectories:
        total[:] = 0
        for row, lag in zip(rows, trajectory, strict=False):
            first, last = max(0, -lag), min(len(total), len(total) - lag)
            if first < last:
                total[first + lag : last + lag] += row[first:last]
        np.maximum(best, total, out=best)
    best /= len(rows)
    return best
