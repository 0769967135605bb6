"""Ties between the places of a map: which pictures show the same ground, and how they lie over each other.

Only pairs that can overlap are looked at: places recorded near each other, and places mapped one after the other, since
a recorded position may be far off. Once the graph has been solved, the pairs that should overlap by it are looked at
too.

Landmarks tell it most exactly. Where too few of them agree, and the pictures are at hand, all regions of one vote
against the other, as in flight; landmarks are then asked again about what the vote says.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from edgevpr.core.arrays import Array, Bools, Complexes
from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import decoded_name
from edgevpr.core.types import Place
from edgevpr.frames.images import list_images, read_image
from edgevpr.mapmaking.graph import Ties
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.agreement import CONFIRMED, PROVEN, Agreement, Overlay, agreement
from edgevpr.runtime.recognise.landmarks import Landmarks, unpacked

_NEAREST = 8  # places recorded nearest
_BEFORE = 2  # places mapped just before
_OVERLAPS = 0.6  # of the longest side: pictures with nearer middles share a third of their ground or more
_MOST_OVERLAPPING = 12  # pairs of one place, once the graph is solved
# Chosen on aerial_caliterra and aerial_garfield28.
_VOTE = 0.06  # share of the regions that agree, so that it is believed without any landmark
_ASKED = 0.05  # share of the regions that agree, so that landmarks are asked about it
# Standard deviations of one axis: of landmarks, which see tilt and relief as turns and scalings, and of a vote, which
# is of whole cells, of turns of 15 degrees, and of any scaling within a fifth where few regions agree.
_OF_LANDMARKS, _OF_VOTE = (0.01, 0.05), (0.016, 0.09)
_TRIED = 8  # rotations of a pair
_KEPT = 512  # landmarks and descriptors: a place is looked at with its neighbours, which come soon after each other
_KEPT_PICTURES = 4


@dataclass(frozen=True, slots=True)
class Tie:
    """The way in which one picture lies over another: `step` and `turn` complex, and their standard deviations (see
    `graph.Ties`)."""

    step: complex
    turn: complex
    step_sd: float
    turn_sd: float


Pair = tuple[int, int]  # the numbers of query and place, the later one first
Look = Callable[[int, int], Tie | None]  # at a pair
Encoded = Callable[[str], Descriptor | None]  # the picture of this name


def likely_pairs(recorded: Complexes) -> list[Pair]:
    """Return the pairs of places, recorded at complex (N,) metres in the order of mapping, that may overlap."""
    count = len(recorded)
    pairs = {(at, at - before) for before in range(1, _BEFORE + 1) for at in range(before, count)}
    if count > 1:
        points = np.stack([recorded.real, recorded.imag], axis=1)
        _, near = cKDTree(points).query(points, k=min(_NEAREST + 1, count))
        pairs |= {_later_first(at, other) for at, row in enumerate(near.tolist()) for other in row if other != at}
    return sorted(pairs)


def overlapping_pairs(position: Complexes, log: Complexes, of: Bools) -> list[Pair]:
    """Return the pairs of the places `of` bool (N,) that overlap, by a solved graph."""
    members = np.flatnonzero(of).tolist()
    if len(members) < 2:
        return []
    points, footprint_m = np.stack([position.real, position.imag], axis=1)[members], np.exp(log.real[members])
    away_m, near = cKDTree(points).query(points, k=min(_MOST_OVERLAPPING + 1, len(members)))
    return sorted(
        {
            _later_first(members[at], members[other])
            for at, (row_m, row) in enumerate(zip(away_m.tolist(), near.tolist(), strict=True))
            for other_m, other in zip(row_m, row, strict=True)
            if other != at and other_m <= _OVERLAPS * min(footprint_m[at], footprint_m[other])
        }
    )


def _later_first(one: int, other: int) -> Pair:
    return max(one, other), min(one, other)


def tied(pairs: Iterable[Pair], look: Look) -> dict[Pair, Tie]:
    """Look at each pair; return the ties that were found."""
    return {pair: tie for pair in pairs if (tie := look(*pair))}


def ties_of(tie_of: dict[Pair, Tie]) -> Ties:
    """Return ties as the arrays of a graph."""
    pairs = np.array(list(tie_of), np.intp).reshape(-1, 2)
    columns = [(tie.step, tie.turn, tie.step_sd, tie.turn_sd) for tie in tie_of.values()]
    step, turn, step_sd, turn_sd = np.array(columns, complex).reshape(-1, 4).T
    return Ties(query=pairs[:, 0], place=pairs[:, 1], step=step, turn=turn, step_sd=step_sd.real, turn_sd=turn_sd.real)


def looker(place_map: PlaceMap, technique: Technique, places: list[Place], encoded: Encoded | None) -> Look:
    """Return the look at a pair of `places`, by their numbers in this list. A place that cannot be read, or has no
    landmarks, ties nothing by them."""
    coarse = {place_id: part for place_id, *_, part in place_map.coarse_parts()}

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

    def agreed(query: int, place: int, expected: Overlay | None) -> Agreement | None:
        one, other = landmarks(query), landmarks(place)
        return None if one is None or other is None else agreement(one, other, expected)

    def look(query: int, place: int) -> Tie | None:
        by_landmarks = agreed(query, place, None)
        if by_landmarks and by_landmarks.inliers >= PROVEN:
            return _of_landmarks(by_landmarks)
        asking, part = descriptor(query), coarse.get(places[place].place_id)
        if asking is None or part is None:
            return None
        try:
            fine, _ = place_map.fine_part(places[place].place_id)
        except EdgevprError:
            return None
        match = technique.match(asking, fine, _likely(technique, asking, part))
        if match.score < _ASKED:
            return None
        vote = _vote_of(match, technique.spec.cells or 1)
        by_landmarks = agreed(query, place, vote)
        if by_landmarks and by_landmarks.inliers >= CONFIRMED:
            return _of_landmarks(by_landmarks)
        return _tie(vote, _OF_VOTE) if match.score >= _VOTE else None

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


def _likely(technique: Technique, asking: Descriptor, part: Array) -> list[int]:
    """Choose the hypotheses to try; neighbours of a map are from about the same height."""
    _, by_hypothesis = technique.coarse_scores(asking, part[None], None)
    assert by_hypothesis is not None  # of a technique that looks down
    best = np.argsort(-by_hypothesis[0], kind="stable")[:_TRIED]
    likely: list[int] = best[np.isfinite(by_hypothesis[0][best])].tolist()
    return likely


def _vote_of(match: FineMatch, cells: int) -> Overlay:
    dx, dy = match.shift_cells or (0.0, 0.0)
    return Overlay((dx / cells, dy / cells), match.rotation_deg or 0.0, match.height_ratio)


def _of_landmarks(found: Agreement) -> Tie:
    assert found.shift_share is not None  # of landmarks that agree
    assert found.rotation_deg is not None
    return _tie(Overlay(found.shift_share, found.rotation_deg, found.scale), _OF_LANDMARKS)


def _tie(seen: Overlay, sds: tuple[float, float]) -> Tie:
    dx, dy = seen.shift_share
    turned = np.radians((seen.rotation_deg + 180) % 360 - 180)
    return Tie(complex(dx, -dy), complex(np.log(seen.scale or 1.0), -turned), *sds)
