"""Verification of the best place by landmarks, which had no part in finding it, and the agreement of two pictures: how
many of their landmarks coincide after one rotation, one scaling and one shift.

Ahead, near and far landmarks shift by different amounts, so fewer agree, and they only speak for a match. Points are
complex numbers here, x + iy (to the right, down), as shares of the longest side from the picture's middle. A *way* to
lay the query on the place is two of them: a point is multiplied by the first (rotation and scale), then the second (the
shift) is added.

Two landmarks match if each is the most similar one of the other picture. Every two of the best matches define one way.
The way that most of all matches follow is taken. Nothing is random: the same pictures always give the same result.
"""

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Covariance, Singles
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import PlaceError
from edgevpr.core.geodesy import shorter_deg
from edgevpr.frames.level import Levelled
from edgevpr.places.index import PlaceIndex
from edgevpr.places.readmap import ReadMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.runtime.recognise.landmarks import (
    AHEAD_PX,
    DOWN_PX,
    OF_PLACE,
    OF_QUERY,
    Landmarks,
    describe,
    unpacked,
)

# Inliers with which an agreement is confirmed, and proven. Of 14,799 pairs of a query and a place of another site,
# expected as their match says, 31 had four inliers, 7 five, 3 six and none more (benchmarks/verification.py). Of
# 50,940 expected at random, 111 had four, 22 five and 2 six. So fewer than one in 10,000 has eight by chance. Where
# nothing is expected, 3 of 2500 had seven.
CONFIRMED, PROVEN = 8, 10
# Largest deviations from the expected shift (share of the longest side), rotation (degrees) and scale (a factor).
_STEP, _TURN_DEG, _SCALE = 3.5 / 32, 25.0, 1.35
_ANY_SCALE = 1.9  # the same factor where no ratio of heights is expected
_LEAST_SCALE, _MOST_SCALE = 0.4, 2.5  # limits of the scale where nothing is expected
_ANGLE_DEG = 30.0  # largest difference of the directions of two matching landmarks; those of ORB err by a few degrees
_SIZE_BEYOND = 1.2  # one level of the image pyramid: sizes are not known more exactly

_MOST_BITS = 64  # of 256 may differ; one in some thousand pairs of unrelated landmarks differs in so few
_TOLERANCE = 10 / 640  # of the longest side: relief and tilt move landmarks of the same spot by about so much
_BEST_MATCHES = 60  # every two of so many best matches define a way that is tried
_APART = 0.06  # share of the longest side; two landmarks nearer to each other say little about the rotation
_FEWEST = 3
# Relief and tilt move neighbouring landmarks alike: so many of them count as one independent landmark. With this, half
# of the errors on aerial_caliterra and aerial_garfield28 are within the bound that the covariance gives for half.
_ALIKE = 40.0
_MAY_BE_THE_SAME = 12  # places that may show the same ground: so many overlap on kite_ochota, which has no positions


@dataclass(frozen=True, slots=True)
class Overlay:
    """Guess of how one picture lies on another, such as the query on a place. `shift_share` (dx, dy), `rotation_deg`
    and `scale` (None: unknown) are as in `Agreement`."""

    shift_share: tuple[float, float]
    rotation_deg: float
    scale: float | None = None

    @property
    def turn_scale(self) -> np.complex64:
        """Rotation and scale as one complex factor."""
        return np.complex64((self.scale or 1.0) * np.exp(1j * np.deg2rad(self.rotation_deg)))

    @property
    def step_and_turn(self) -> tuple[complex, complex]:
        """Relative pose of the query as in a tie of `mapmaking.graph`: its offset, right + i up, and the logarithm of
        its scale + i times its counter-clockwise rotation."""
        dx, dy = self.shift_share
        turned = np.radians(shorter_deg(self.rotation_deg))
        return complex(dx, -dy), complex(np.log(self.scale or 1.0), -turned)


def onto(one: Overlay, other: Overlay) -> Overlay:
    """Return how one place lies on another, given the overlays `one` and `other` of the same query on these places."""
    turn_scale = other.turn_scale / one.turn_scale
    shift = complex(*other.shift_share) - turn_scale * complex(*one.shift_share)
    scale = None if None in (one.scale, other.scale) else float(abs(turn_scale))
    rotation_deg = float(np.angle(turn_scale, deg=True)) % 360
    return Overlay((float(shift.real), float(shift.imag)), rotation_deg, scale)


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Result of comparing the landmarks of query and place. `matched` is the number of landmarks that match, `inliers`
    the number of those that coincide, and `possible` the number of landmarks of the picture that has fewer.

    The query is turned by `rotation_deg` (clockwise, 0..360) about its middle, scaled by `scale` (above 1 if it was
    taken from higher up), and its middle is moved from the place's middle by `shift_share` (dx to the right, dy down),
    as shares of the place's longest side. It then lies over the place. `covariance_share2` (var x, cov xy, var y) is
    that of the shift. All four are None without inliers. `is_expected` is False if the landmarks agree, but on another
    overlay than the one that was expected. `coinciding` are the points of the inliers in query and place, complex (n,).
    """

    inliers: int
    matched: int
    possible: int
    shift_share: tuple[float, float] | None = None
    rotation_deg: float | None = None
    scale: float | None = None
    covariance_share2: Covariance | None = None
    is_expected: bool = True
    coinciding: tuple[Array, Array] | None = field(default=None, repr=False, compare=False)

    @property
    def is_at_rest(self) -> bool:
        """True if the pictures coincide without shift, turn or scaling, as a display drawn over all pictures does."""
        if self.shift_share is None or self.rotation_deg is None or self.scale is None:
            return False
        turned_deg = min(self.rotation_deg, 360 - self.rotation_deg)
        return max(map(abs, self.shift_share)) <= _TOLERANCE and turned_deg <= 2 and abs(self.scale - 1) <= 0.03


def held_against(query: Landmarks, place: Landmarks, expected: Overlay) -> Agreement:
    """Compare two pictures near the `expected` overlay. If few landmarks agree there and many on another overlay,
    return the agreement on that one, with `is_expected` False."""
    found = agreement(query, place, expected)
    if found.inliers >= CONFIRMED:
        return found
    otherwise = agreement(query, place)
    if otherwise.inliers < PROVEN or otherwise.is_at_rest or otherwise.shift_share is None:
        return found  # an agreement at rest may come from a display, not from the ground
    turn_scale = (otherwise.scale or 1.0) * np.exp(1j * np.radians(otherwise.rotation_deg or 0.0))
    is_near = _is_near(complex(turn_scale), complex(*otherwise.shift_share), expected)
    return found if is_near else replace(otherwise, is_expected=False)


def agreement(query: Landmarks, place: Landmarks, expected: Overlay | None = None) -> Agreement:
    """Compare the landmarks of two pictures, by ways near to the `expected` overlay only (None: by all ways)."""
    possible = min(len(query), len(place))
    nothing = Agreement(inliers=0, matched=0, possible=possible)
    if possible < _FEWEST:
        return nothing
    asked, known = _complex(query), _complex(place)
    differing = _differing_bits(query.bits, place.bits)
    if expected is not None:
        differing[~_plausible(query, place, asked, known, expected)] = np.inf
    best = differing.argmin(axis=1)
    least = differing[np.arange(len(asked)), best]
    mutual = np.flatnonzero((differing.argmin(axis=0)[best] == np.arange(len(asked))) & (least <= _MOST_BITS))
    mutual = mutual[np.argsort(least[mutual], kind="stable")]
    asked, known = asked[mutual].astype(complex), known[best[mutual]].astype(complex)
    way = _most_followed(asked, known, expected)
    nothing = replace(nothing, matched=len(mutual))
    if way is None:
        return nothing
    for _ in range(3):
        along = np.abs(way[0] * asked + way[1] - known) <= _TOLERANCE
        if np.count_nonzero(along) < _FEWEST:
            return nothing
        way = fitted(asked[along], known[along])
    along = np.abs(way[0] * asked + way[1] - known) <= _TOLERANCE
    inliers = int(np.count_nonzero(along))
    if inliers < _FEWEST or not _is_near(*way, expected):
        return nothing
    turn_scale, shift = way
    variance = _variance(asked[along], known[along], turn_scale, shift)
    return replace(
        nothing,
        inliers=inliers,
        shift_share=(float(shift.real), float(shift.imag)),
        rotation_deg=float(np.angle(turn_scale, deg=True)) % 360,
        scale=float(abs(turn_scale)),
        covariance_share2=(variance, 0.0, variance),
        coinciding=(asked[along], known[along]),
    )


def landmarks_in(picture: Levelled, spec: TechniqueSpec, most: int = OF_PLACE) -> Landmarks:
    """Find the `most` best landmarks of a picture, of the size at which those of a technique's places are found."""
    return describe(picture.image, picture.mask, most, DOWN_PX if spec.looks_down else AHEAD_PX)


class Verification:
    """Compares the landmarks of one query, which are computed when first needed, with those of places."""

    def __init__(self, spec: TechniqueSpec, picture: Levelled, index: PlaceIndex, place_map: ReadMap) -> None:
        self._spec, self.picture, self._index, self._map = spec, picture, index, place_map

    @cached_property
    def landmarks(self) -> Landmarks:
        """Landmarks of the query."""
        most = OF_QUERY if self._spec.looks_down else OF_QUERY // 2
        return landmarks_in(self.picture, self._spec, most)

    @property
    def _sides(self) -> tuple[float, float]:
        """Width and height of the picture that a technique has made a square of, as shares of its longest side."""
        if self._spec.looks_down:  # its picture was put into the square, and not stretched
            return 1.0, 1.0
        height, width = self.picture.image.shape[:2]
        return width / max(height, width), height / max(height, width)

    def proof(self, ranking: Ranking) -> Agreement | None:
        """Compare the landmarks of the query with those of the best place, expected to agree on the overlay that its
        match gives. None if the place has no landmarks, or its match no shift or rotation. Raises PlaceError if the
        landmarks cannot be read; the place is then left out."""
        expected, known = self._place(ranking, int(ranking.slots[0]))
        return held_against(self.landmarks, known, expected) if expected and known is not None else None

    def rival(self, ranking: Ranking, neighbour_m: float, same: Collection[int]) -> int:
        """Return the number of landmarks of the query and of the best place elsewhere (see `places.retrieve.elsewhere`)
        that agree on the overlay of its match: 0 if there is no place elsewhere, the largest possible number if its
        landmarks are unknown. Places with the numbers `same` are not elsewhere. Raises PlaceError as `proof` does."""
        away = ranking.slots[elsewhere(self._index, int(ranking.slots[0]), ranking.slots, neighbour_m, same)]
        if not len(away):
            return 0
        expected, known = self._place(ranking, int(away[0]))
        return OF_PLACE if known is None else agreement(self.landmarks, known, expected).inliers

    def inliers(self, ranking: Ranking) -> int:
        """Return the number of landmarks of the query and of the best place that agree on the overlay of its match: 0
        if those of the place are unknown, or if they are at rest, as a display is. Raises PlaceError as `proof` does.
        """
        expected, known = self._place(ranking, int(ranking.slots[0]))
        found = None if known is None else agreement(self.landmarks, known, expected)
        return 0 if found is None or found.is_at_rest else found.inliers

    def same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Of the best few places compared, return the numbers of those that show the same ground as the best one: the
        landmarks of both agree, on the overlay that follows from their matches. Empty if the best place has a position,
        since distances then tell the same. Raises PlaceError as `proof` does."""
        slots = ranking.compared_slots[:_MAY_BE_THE_SAME]
        if not slots or not np.isnan(self._index.lat_deg[slots[0]]):
            return ()
        expected, known = self._place(ranking, slots[0])
        if expected is None or known is None:
            return ()
        others = {int(self._index.place_ids[slot]): self._place(ranking, slot) for slot in slots[1:]}
        return tuple(
            place_id
            for place_id, (other, landmarks) in others.items()
            if other and landmarks and agreement(known, landmarks, onto(expected, other)).inliers >= CONFIRMED
        )

    def _place(self, ranking: Ranking, slot: int) -> tuple[Overlay | None, Landmarks | None]:
        """Return the overlay of the query on the place in row `slot`, by its match, and the place's landmarks (None:
        unknown). Both are None if the match has no shift."""
        match, cells = ranking.compared.get(slot), self._spec.cells
        if match is None or match.shift_cells is None or cells is None:
            return None, None
        dx, dy = (cells_off * side for cells_off, side in zip(match.shift_cells, self._sides, strict=True))
        expected = Overlay((dx / cells, dy / cells), match.rotation_deg or 0.0, match.height_ratio)
        try:
            blob = self._map.landmarks_of(int(self._index.place_ids[slot]))
        except PlaceError as error:
            self._map.left_out.setdefault(error.place_id, error.problem)
            raise
        with suppress(ValueError):
            return expected, None if blob is None else unpacked(blob)
        return expected, None


def _complex(landmarks: Landmarks) -> Array:
    """Return the points of landmarks as complex64 (K,), x + iy."""
    return np.ascontiguousarray(landmarks.points, np.float32).view(np.complex64).ravel()


def _differing_bits(one: Bytes, other: Bytes) -> Singles:
    """Count the bits in which each pair of descriptions differs: uint8 (N, 32) and (M, 32) -> float32 (N, M)."""
    ours, theirs = (2 * np.unpackbits(bits, axis=1).astype(np.float32) - 1 for bits in (one, other))
    return np.asarray((ours.shape[1] - ours @ theirs.T) / 2)


def _plausible(query: Landmarks, place: Landmarks, asked: Array, known: Array, expected: Overlay) -> Bools:
    """Return bool (N, M): True where a landmark of the query can be that landmark of the place, by position, direction
    and size, if the query lies on the place about as `expected`. `asked` (N,) and `known` (M,) are their points."""
    factor = _ANY_SCALE if expected.scale is None else _SCALE
    laid = expected.turn_scale * asked + np.complex64(complex(*expected.shift_share))
    room = _STEP + np.abs(asked) * (factor - 1 + np.radians(_TURN_DEG) / 2)
    there: Bools = np.abs(laid[:, None] - known) <= room[:, None].astype(np.float32)
    turned = np.radians(query.angle_deg + expected.rotation_deg)[:, None] - np.radians(place.angle_deg)
    there &= np.cos(turned) >= np.cos(np.radians(_ANGLE_DEG))
    size, most = query.size[:, None] * np.float32(expected.scale or 1.0), np.float32(factor * _SIZE_BEYOND)
    return there & (size <= place.size * most) & (size * most >= place.size)


def _is_near(turn_scale: Any, shift: Any, expected: Overlay | None) -> Bools:
    """Return True for each way near to the expected overlay (None: for each way with a plausible scale). `turn_scale`
    and `shift` are its two complex numbers, or arrays of them; the result has their shape."""
    if expected is None:  # only the scale is limited
        return np.asarray((np.abs(turn_scale) >= _LEAST_SCALE) & (np.abs(turn_scale) <= _MOST_SCALE))
    beside = turn_scale / expected.turn_scale
    turned, stretched = np.abs(np.angle(beside, deg=True)), np.abs(np.log(np.abs(beside)))
    most = np.log(_ANY_SCALE if expected.scale is None else _SCALE)
    is_there = np.abs(shift - complex(*expected.shift_share)) <= _STEP
    return np.asarray((turned <= _TURN_DEG) & (stretched <= most) & is_there)


def _most_followed(asked: Array, known: Array, expected: Overlay | None) -> tuple[complex, complex] | None:
    """Return the way that most matches follow, out of those that two matches define; None if none is near to the
    expected overlay. `asked` and `known`, complex (n,), are the points in query and place, best matches first."""
    one, other = np.triu_indices(min(_BEST_MATCHES, len(asked)), 1)
    apart = np.abs(asked[other] - asked[one]) > _APART
    one, other = one[apart], other[apart]
    turn_scale = (known[other] - known[one]) / (asked[other] - asked[one])
    turn_scale = np.where(turn_scale == 0, np.finfo(float).tiny, turn_scale)  # two landmarks on one spot: avoid zero
    shift = known[one] - turn_scale * asked[one]
    near = _is_near(turn_scale, shift, expected)
    if not near.any():
        return None
    turn_scale, shift = turn_scale[near], shift[near]
    off = np.abs(turn_scale[:, None] * asked + shift[:, None] - known)
    follow = np.maximum(0, 1 - (off / _TOLERANCE) ** 2).sum(axis=1)
    best = int(follow.argmax())
    return turn_scale[best], shift[best]


def fitted(asked: Array, known: Array) -> tuple[complex, complex]:
    """Return the way that lays `asked` of the query over `known` of the place, complex (n,) each, by least squares."""
    middle, there = asked.mean(), known.mean()
    spread = np.vdot(asked - middle, asked - middle).real
    turn_scale = np.vdot(asked - middle, known - there) / spread if spread > 0 else 1.0 + 0j
    return turn_scale, there - turn_scale * middle


def _variance(asked: Array, known: Array, turn_scale: complex, shift: complex) -> float:
    """Return the variance of the shift along each axis, in squares of the picture's longest side, from the inliers."""
    left = np.abs(turn_scale * asked + shift - known) ** 2
    per_axis = max(float(left.sum()) / max(2 * len(asked) - 4, 1), (_TOLERANCE / 10) ** 2)
    middle = asked.mean()
    spread = float((np.abs(asked - middle) ** 2).mean())
    # The farther the inliers are from the picture's middle, the more a wrong rotation moves the middle.
    return float(per_axis * _ALIKE / len(asked) * (1 + abs(middle) ** 2 / max(spread, 1e-9)))
