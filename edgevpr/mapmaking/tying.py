"""Ties between the places of a map: which pictures show the same ground, and their relative poses. For `refine`.

Only pairs that may overlap are compared: places recorded near each other, and places mapped one after the other, since
a recorded position may be far off. After the pose graph (see `graph`) is solved, pairs that overlap by it follow.

Landmarks (ORB points) are compared first, as they are most exact. If too few of them agree, and the pictures are found,
the technique compares their regions as in flight, which gives a rough relative pose ("vote"). Landmarks are then
compared again near that pose.
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

_NEAREST = 8  # each place is compared with so many places recorded nearest
_BEFORE = 2  # and with so many places mapped just before
_OVERLAPS = 0.6  # of the longest side: pictures with nearer middles share a third of their ground or more
_MOST_OVERLAPPING = 12  # pairs of one place, after the graph is solved
# Chosen on aerial_caliterra and aerial_garfield28.
_VOTE = 0.06  # share of regions that must agree to use a vote without landmarks
_ASKED = 0.05  # share of regions that must agree to compare landmarks near the vote
# Standard deviations (step, turn) along one axis: of landmarks, in which tilt and relief look like turns and scalings;
# and of a vote, which has whole cells, turns of 15 degrees, and an uncertain scale if few regions agree.
_OF_LANDMARKS, _OF_VOTE = (0.01, 0.05), (0.016, 0.09)
_TRIED = 8  # hypotheses of rotation and height for a pair
_KEPT = 512  # places whose landmarks are cached: a place is compared with its neighbours soon after each other
_KEPT_PICTURES = 4  # descriptors that are cached


@dataclass(frozen=True, slots=True)
class Tie:
    """Relative pose of picture `query` to picture `place`: complex `step` (right + i up, in shares of the place's
    longest side) and `turn` (log of the scale + i counter-clockwise rotation), and their standard deviations."""

    step: complex
    turn: complex
    step_sd: float
    turn_sd: float


Pair = tuple[int, int]  # the numbers of query and place, the later one first
Look = Callable[[int, int], Tie | None]  # compares a pair (query, place); None: no tie found
Encoded = Callable[[str], Descriptor | None]  # encodes the picture of this name; None: it cannot be used


def likely_pairs(recorded: Complexes) -> list[Pair]:
    """Return the pairs of places that may overlap. `recorded` is their positions, complex (N,) metres, as mapped."""
    count = len(recorded)
    pairs = {(at, at - before) for before in range(1, _BEFORE + 1) for at in range(before, count)}
    if count > 1:
        points = np.stack([recorded.real, recorded.imag], axis=1)
        _, near = cKDTree(points).query(points, k=min(_NEAREST + 1, count))
        pairs |= {_later_first(at, other) for at, row in enumerate(near.tolist()) for other in row if other != at}
    return sorted(pairs)


def overlapping_pairs(position: Complexes, log: Complexes, of: Bools) -> list[Pair]:
    """Return the pairs that overlap by `position` and `log` of a solved graph, among places where `of` (N,) is True."""
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
    """Compare each pair with `look`; return the ties that were found."""
    return {pair: tie for pair in pairs if (tie := look(*pair))}


def ties_of(tie_of: dict[Pair, Tie]) -> Ties:
    """Convert ties to the arrays that `graph.solve` takes."""
    pairs = np.array(list(tie_of), np.intp).reshape(-1, 2)
    columns = [(tie.step, tie.turn, tie.step_sd, tie.turn_sd) for tie in tie_of.values()]
    step, turn, step_sd, turn_sd = np.array(columns, complex).reshape(-1, 4).T
    return Ties(query=pairs[:, 0], place=pairs[:, 1], step=step, turn=turn, step_sd=step_sd.real, turn_sd=turn_sd.real)


def looker(place_map: PlaceMap, technique: Technique, places: list[Place], encoded: Encoded | None) -> Look:
    """Return the function that compares two of `places`, given by their indices in this list, and returns their tie.
    `encoded` encodes the places' pictures (None: they are not at hand, so only landmarks are compared)."""
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
    """Return the function that encodes the picture of a given name in `folder` (None: missing or cannot be used)."""
    paths = {decoded_name(path.name): path for path in list_images(folder)}

    def encoded(name: str) -> Descriptor | None:
        try:
            return technique.encode(read_image(paths[name])) if name in paths else None
        except EdgevprError:
            return None

    return encoded


def _likely(technique: Technique, asking: Descriptor, part: Array) -> list[int]:
    """Return the best hypotheses (rotations of query `asking`) for `Technique.match`, by the scores with the place's
    coarse part `part`. Only the map's own height is tried: neighbours are from about the same height."""
    _, by_hypothesis = technique.coarse_scores(asking, part[None], None)
    assert by_hypothesis is not None  # set by techniques for a camera that looks down
    best = np.argsort(-by_hypothesis[0], kind="stable")[:_TRIED]
    likely: list[int] = best[np.isfinite(by_hypothesis[0][best])].tolist()
    return likely


def _vote_of(match: FineMatch, cells: int) -> Overlay:
    dx, dy = match.shift_cells or (0.0, 0.0)
    return Overlay((dx / cells, dy / cells), match.rotation_deg or 0.0, match.height_ratio)


def _of_landmarks(found: Agreement) -> Tie:
    assert found.shift_share is not None  # set if any landmarks agree
    assert found.rotation_deg is not None
    return _tie(Overlay(found.shift_share, found.rotation_deg, found.scale), _OF_LANDMARKS)


def _tie(seen: Overlay, sds: tuple[float, float]) -> Tie:
    dx, dy = seen.shift_share
    turned = np.radians((seen.rotation_deg + 180) % 360 - 180)
    return Tie(complex(dx, -dy), complex(np.log(seen.scale or 1.0), -turned), *sds)
