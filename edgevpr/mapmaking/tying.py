"""Ties between the places of a map: which pictures show the same ground, and how they lie over each other.

Only pairs that can overlap are looked at: places recorded near each other, and places mapped one after the other, since
a recorded position may be far off. Once the graph has been solved, the pairs that should overlap by it are looked at
too.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from edgevpr.mapmaking.graph import Ties

_NEAREST = 8  # places recorded nearest
_BEFORE = 2  # places mapped just before
_OVERLAPS = (
    0.6  # of the longest side: pictures whose middles are nearer than that share a third of their ground or more
)
_MOST_OVERLAPPING = 12  # pairs of one place, once the graph is solved


@dataclass(frozen=True, slots=True)
class Tie:
    """The way in which one picture lies over another: `step` and `turn` complex, and their standard deviations (see
    `graph.Ties`)."""

    step: complex
    turn: complex
    step_sd: float
    turn_sd: float


Look = Callable[[int, int], Tie | None]  # at a pair: the numbers of query and place


def likely_pairs(recorded: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of places, recorded at complex (N,) metres in the order of mapping, that may overlap: the later
    one first."""
    count = len(recorded)
    pairs = {(at, at - before) for before in range(1, _BEFORE + 1) for at in range(before, count)}
    if count > 1:
        points = np.stack([recorded.real, recorded.imag], axis=1)
        _, near = cKDTree(points).query(points, k=min(_NEAREST + 1, count))
        pairs |= {
            (max(at, other), min(at, other)) for at, row in enumerate(near.tolist()) for other in row if other != at
        }
    return sorted(pairs)


def overlapping_pairs(position: np.ndarray, log: np.ndarray, of: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of the places `of` bool (N,) that overlap, by a solved graph: the later one first."""
    members = np.flatnonzero(of)
    if len(members) < 2:
        return []
    points, footprint_m = np.stack([position.real, position.imag], axis=1)[members], np.exp(log.real[members])
    tree = cKDTree(points)
    away_m, near = tree.query(points, k=min(_MOST_OVERLAPPING + 1, len(members)))
    pairs = set()
    for at, (row_m, row) in enumerate(zip(away_m.tolist(), near.tolist(), strict=True)):
        for other_m, other in zip(row_m, row, strict=True):
            if other != at and other_m <= _OVERLAPS * min(footprint_m[at], footprint_m[other]):
                pairs.add((int(members[max(at, other)]), int(members[min(at, other)])))
    return sorted(pairs)


def tied(pairs: Iterable[tuple[int, int]], look: Look) -> dict[tuple[int, int], Tie]:
    """Look at each pair; return the ties that were found."""
    return {pair: tie for pair in pairs if (tie := look(*pair))}


def ties_of(found: dict[tuple[int, int], Tie]) -> Ties:
    """Return ties as the arrays of a graph."""
    pairs = np.array(list(found), np.intp).reshape(-1, 2)
    columns = [(tie.step, tie.turn, tie.step_sd, tie.turn_sd) for tie in found.values()]
    step, turn, step_sd, turn_sd = np.array(columns, complex).reshape(-1, 4).T
    return Ties(query=pairs[:, 0], place=pairs[:, 1], step=step, turn=turn, step_sd=step_sd.real, turn_sd=turn_sd.real)
