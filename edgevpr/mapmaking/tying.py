"""Ties between the places of a map: which pictures show the same ground, and how they lie over each other.

Only pairs that can overlap are looked at: places recorded near each other, and places mapped one after the other, since
a recorded position may be far off. Once the graph has been solved, the pairs that should overlap by it are looked at
too.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import decoded_name
from edgevpr.core.types import Place
from edgevpr.frames.images import list_images, read_image
from edgevpr.mapmaking.graph import Ties
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.agreement import CONFIRMED, PROVEN, Agreement, Expected, agreement
from edgevpr.runtime.recognise.landmarks import Landmarks, unpacked

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


Encoded = Callable[[str], Descriptor | None]  # the picture of this name

# Chosen on aerial_caliterra and aerial_garfield28.
_VOTE = 0.06  # share of the regions that agree, so that it is believed without any landmark
_ASKED = 0.05  # share of the regions that agree, so that landmarks are asked about it
# Standard deviations of one axis: of landmarks, which see tilt and relief as turns and scalings, and of a vote, which
# is of whole cells, of turns of 15 degrees, and of any scaling within a fifth where few regions agree.
_OF_LANDMARKS, _OF_VOTE = (0.01, 0.05), (0.016, 0.09)
_TRIED = 8  # rotations of a pair
_KEPT = 512  # landmarks and descriptors: a place is looked at with its neighbours, which come soon after each other
_KEPT_PICTURES = 4


def looker(place_map: PlaceMap, technique: Technique, places: list[Place], encoded: Encoded | None) -> Look:
    """Return the look at a pair of `places`, by their numbers in this list. A place that cannot be read, or has no
    landmarks, ties nothing by them."""

    coarse = {place_id: part for place_id, *_, part in place_map.coarse_parts()}

    def likely(asking: Descriptor, part: np.ndarray) -> list[int]:
        """Choose the hypotheses to try; neighbours of a map are from about the same height."""
        _, scores = technique.coarse_scores(asking, part[None], None)
        best = np.argsort(-scores[0], kind="stable")[:_TRIED]
        return best[np.isfinite(scores[0][best])].tolist()

    @lru_cache(_KEPT)
    def landmarks(at: int) -> Landmarks | None:
        try:
            blob = place_map.landmarks_of(places[at].place_id)
            return unpacked(blob) if blob else None
        except (EdgevprError, ValueError):
            return None

    @lru_cache(_KEPT_PICTURES)
    def descriptor(at: int) -> Descriptor | None:
        found = encoded(places[at].source_image) if encoded else None
        return found if found and place_map.is_of(places[at].place_id, found.coarse) else None

    def agreed(query: int, place: int, told: Expected | None) -> Agreement | None:
        pair = landmarks(query), landmarks(place)
        return agreement(*pair, told) if None not in pair else None

    def look(query: int, place: int) -> Tie | None:
        found = agreed(query, place, None)
        if found and found.inliers >= PROVEN:
            return _of_landmarks(found)
        asking = descriptor(query)
        if asking is None:
            return None
        part = coarse.get(places[place].place_id)
        try:
            fine, _ = place_map.fine_part(places[place].place_id)
        except EdgevprError:
            part = None
        if part is None:
            return None
        match = technique.match(asking, fine, likely(asking, part))
        if match.score < _ASKED:
            return None
        found = agreed(query, place, _told(match, technique.spec.cells))
        if found and found.inliers >= CONFIRMED:
            return _of_landmarks(found)
        return _of_vote(match, technique.spec.cells) if match.score >= _VOTE else None

    return look


def pictures(folder: str | Path, technique: Technique) -> Encoded:
    """Return the pictures of a folder by name, as descriptors; None for one that is not there or cannot be used."""
    paths = {decoded_name(path.name): path for path in list_images(folder)}

    def encoded(name: str) -> Descriptor | None:
        try:
            return technique.encode(read_image(paths[name])) if name in paths else None
        except EdgevprError:
            return None

    return encoded


def _told(match: FineMatch, cells: int) -> Expected:
    dx, dy = match.shift_cells
    return Expected((dx / cells, dy / cells), match.rotation_deg, match.height_ratio)


def _of_landmarks(found: Agreement) -> Tie:
    dx, dy = found.shift_share
    return Tie(complex(dx, -dy), complex(np.log(found.scale), -_radians(found.rotation_deg)), *_OF_LANDMARKS)


def _of_vote(match: FineMatch, cells: int) -> Tie:
    dx, dy = match.shift_cells
    scaled = np.log(match.height_ratio) if match.height_ratio else 0.0
    return Tie(complex(dx, -dy) / cells, complex(scaled, -_radians(match.rotation_deg)), *_OF_VOTE)


def _radians(turned_deg: float) -> float:
    return float(np.radians((turned_deg + 180) % 360 - 180))
