"""Agreement of two pictures: how many of their landmarks lie over each other after one turn, one scaling and one step.

Points are complex numbers here, x + iy: turning and scaling by a product, moving by a sum.

Landmarks that resemble each other most, either way, are matched. Every two of the best matches say how one picture lies
on the other, and the way that most of all matches follow counts. Nothing is drawn at random, so that the same two
pictures always agree alike.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Covariance, Singles
from edgevpr.runtime.recognise.landmarks import Landmarks

# Inliers. Of 14,799 pairs of a query and a place of another site, laid as the match says, 31 had four, 7 five, 3 six
# and none more (benchmarks/verification.py); of 50,940 laid at random 111, 22 and 2. So fewer than one in 10,000 has
# eight by chance. Where nothing is expected, 3 of 2500 had seven.
CONFIRMED, PROVEN = 8, 10
# How far the landmarks may be from what is expected: shares of the longest side, degrees, a factor.
_STEP, _TURN_DEG, _SCALE = 3.5 / 32, 25.0, 1.35
_ANY_SCALE = 1.9  # the same factor where no ratio of heights is expected
_LEAST_SCALE, _MOST_SCALE = 0.4, 2.5  # where nothing is expected
_ANGLE_DEG = 30.0  # between the directions of two landmarks that are the same; the corners of ORB turn by a few degrees
_SIZE_BEYOND = 1.2  # one level of the pyramid: sizes are known no better

_MOST_BITS = 64  # of 256 that differ: of unrelated landmarks one in some thousand differs in so few
_TOLERANCE = 10 / 640  # of the longest side: relief and tilt move what does lie on the same spot by about so much
_BEST_MATCHES = 60  # of which every two are tried
_APART = 0.06  # two landmarks nearer to each other say little about the turn
_FEWEST = 3
# Relief and tilt move neighbouring landmarks alike, so that so many of them say as much as one. With it, half of the
# errors on aerial_caliterra and aerial_garfield28 are within what the covariance says of half of them.
_ALIKE = 40.0


@dataclass(frozen=True, slots=True)
class Overlay:
    """Guess of how one picture lies on another, such as the query on a place: `shift_share` (dx, dy) of its middle,
    `rotation_deg` and `scale`
    (None: unknown), as in `Agreement`."""

    shift_share: tuple[float, float]
    rotation_deg: float
    scale: float | None = None


def onto(one: Overlay, other: Overlay) -> Overlay:
    """Return how one place lies on another, of how the same query lies on both."""
    turn_scale = _turn_scale(other) / _turn_scale(one)
    shift = complex(*other.shift_share) - turn_scale * complex(*one.shift_share)
    scale = None if None in (one.scale, other.scale) else float(abs(turn_scale))
    rotation_deg = float(np.angle(turn_scale, deg=True)) % 360
    return Overlay((float(shift.real), float(shift.imag)), rotation_deg, scale)


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Result of a comparison: `inliers` of the `matched` landmarks lie over each other; `possible` is the number of
    landmarks of the picture that has fewer.

    The query, turned by `rotation_deg` (clockwise, 0..360) about its middle and scaled by `scale`, lies over the place
    when its middle is moved by `shift_share` (dx to the right, dy down) from the place's middle, as shares of the
    place's longest side, with `covariance_share2` (var x, cov xy, var y). `scale` is above 1 for a query from higher
    up. All of them are None without inliers. `is_expected` is False where they agree, but otherwise than expected."""

    inliers: int
    matched: int
    possible: int
    shift_share: tuple[float, float] | None = None
    rotation_deg: float | None = None
    scale: float | None = None
    covariance_share2: Covariance | None = None
    is_expected: bool = True

    @property
    def way(self) -> tuple[complex, complex] | None:
        """The turn with the scale, and the step, that lay the query on the place."""
        if self.shift_share is None or self.rotation_deg is None or self.scale is None:
            return None
        return complex(self.scale * np.exp(1j * np.radians(self.rotation_deg))), complex(*self.shift_share)

    @property
    def is_at_rest(self) -> bool:
        """True where one picture lies on the other without any step, as a display over all pictures does."""
        if self.shift_share is None or self.rotation_deg is None or self.scale is None:
            return False
        turned_deg = min(self.rotation_deg, 360 - self.rotation_deg)
        return max(map(abs, self.shift_share)) <= _TOLERANCE and turned_deg <= 2 and abs(self.scale - 1) <= 0.03


def held_against(query: Landmarks, place: Landmarks, expected: Overlay) -> Agreement:
    """Return how two pictures agree as `expected`; where few of their landmarks do, and many agree otherwise, that."""
    found = agreement(query, place, expected)
    if found.inliers >= CONFIRMED:
        return found
    otherwise = agreement(query, place)
    way = otherwise.way
    if way is None or otherwise.inliers < PROVEN or otherwise.is_at_rest or _is_near(*way, expected):
        return found  # what is at rest may be a display, and says nothing of the ground
    return replace(otherwise, is_expected=False)


def agreement(query: Landmarks, place: Landmarks, expected: Overlay | None = None) -> Agreement:
    """Compare the landmarks of two pictures. Only ways in which the query may lie near to what is `expected` are tried;
    None: all."""
    possible = min(len(query), len(place))
    if possible < _FEWEST:
        return Agreement(inliers=0, matched=0, possible=possible)
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
    nothing = Agreement(inliers=0, matched=len(mutual), possible=possible)
    if way is None:
        return nothing
    for _ in range(3):
        along = np.abs(way[0] * asked + way[1] - known) <= _TOLERANCE
        if np.count_nonzero(along) < _FEWEST:
            return nothing
        way = _fitted(asked[along], known[along])
    along = np.abs(way[0] * asked + way[1] - known) <= _TOLERANCE
    inliers = int(np.count_nonzero(along))
    if inliers < _FEWEST or not _is_near(*way, expected):
        return nothing
    turn_scale, shift = way
    variance = _variance(asked[along], known[along], turn_scale, shift)
    return Agreement(
        inliers=inliers,
        matched=len(mutual),
        possible=possible,
        shift_share=(float(shift.real), float(shift.imag)),
        rotation_deg=float(np.angle(turn_scale, deg=True)) % 360,
        scale=float(abs(turn_scale)),
        covariance_share2=(variance, 0.0, variance),
    )


def _complex(landmarks: Landmarks) -> Array:
    return np.ascontiguousarray(landmarks.points, np.float32).view(np.complex64).ravel()


def _differing_bits(one: Bytes, other: Bytes) -> Singles:
    """Count the bits in which descriptions differ, uint8 (N, 32) and (M, 32) -> float32 (N, M)."""
    ours, theirs = (2 * np.unpackbits(bits, axis=1).astype(np.float32) - 1 for bits in (one, other))
    return np.asarray((ours.shape[1] - ours @ theirs.T) / 2)


def _turn_scale(expected: Overlay) -> np.complex64:
    return np.complex64((expected.scale or 1.0) * np.exp(1j * np.deg2rad(expected.rotation_deg)))


def _plausible(query: Landmarks, place: Landmarks, asked: Array, known: Array, expected: Overlay) -> Bools:
    """Tell which landmarks of the place (M,) those of the query (N,) can be, bool (N, M): by where they lie, their
    directions and sizes."""
    factor = _factor(expected)
    laid = _turn_scale(expected) * asked + np.complex64(complex(*expected.shift_share))
    room = _STEP + np.abs(asked) * (factor - 1 + np.radians(_TURN_DEG) / 2)
    there: Bools = np.abs(laid[:, None] - known) <= room[:, None].astype(np.float32)
    turned = np.radians(query.angle_deg + expected.rotation_deg)[:, None] - np.radians(place.angle_deg)
    there &= np.cos(turned) >= np.cos(np.radians(_ANGLE_DEG))
    size, most = query.size[:, None] * np.float32(expected.scale or 1.0), np.float32(factor * _SIZE_BEYOND)
    return there & (size <= place.size * most) & (size * most >= place.size)


def _factor(expected: Overlay) -> float:
    return _ANY_SCALE if expected.scale is None else _SCALE


def _is_near(turn_scale: Any, shift: Any, expected: Overlay | None) -> Bools:
    """Tell which ways to lay the query on the place are near to what is expected, bool like `shift`."""
    if expected is None:
        return np.asarray((np.abs(turn_scale) >= _LEAST_SCALE) & (np.abs(turn_scale) <= _MOST_SCALE))
    beside = turn_scale / _turn_scale(expected)
    turned, stretched = np.abs(np.angle(beside, deg=True)), np.abs(np.log(np.abs(beside)))
    is_there = np.abs(shift - complex(*expected.shift_share)) <= _STEP
    return np.asarray((turned <= _TURN_DEG) & (stretched <= np.log(_factor(expected))) & is_there)


def _most_followed(asked: Array, known: Array, expected: Overlay | None) -> tuple[complex, complex] | None:
    """Return the turn with the scale, and the step, of two matches, that most of the matches follow; None where there
    is none. The nearer they come, the more they count."""
    one, other = np.triu_indices(min(_BEST_MATCHES, len(asked)), 1)
    apart = np.abs(asked[other] - asked[one]) > _APART
    one, other = one[apart], other[apart]
    turn_scale = (known[other] - known[one]) / (asked[other] - asked[one])
    turn_scale = np.where(turn_scale == 0, np.finfo(float).tiny, turn_scale)  # two landmarks on one spot: no scale
    shift = known[one] - turn_scale * asked[one]
    near = _is_near(turn_scale, shift, expected)
    if not near.any():
        return None
    turn_scale, shift = turn_scale[near], shift[near]
    off = np.abs(turn_scale[:, None] * asked + shift[:, None] - known)
    follow = np.maximum(0, 1 - (off / _TOLERANCE) ** 2).sum(axis=1)
    best = int(follow.argmax())
    return turn_scale[best], shift[best]


def _fitted(asked: Array, known: Array) -> tuple[complex, complex]:
    """Return the turn with the scale, and the step, that lay `asked` over `known` by least squares."""
    middle, there = asked.mean(), known.mean()
    spread = np.vdot(asked - middle, asked - middle).real
    turn_scale = np.vdot(asked - middle, known - there) / spread if spread > 0 else 1.0 + 0j
    return turn_scale, there - turn_scale * middle


def _variance(asked: Array, known: Array, turn_scale: complex, shift: complex) -> float:
    """Return the variance of the step of the query's middle, along x as along y: the farther the landmarks are from the
    middle, the more a wrong turn moves it."""
    left = np.abs(turn_scale * asked + shift - known) ** 2
    per_axis = max(float(left.sum()) / max(2 * len(asked) - 4, 1), (_TOLERANCE / 10) ** 2)
    middle = asked.mean()
    spread = float((np.abs(asked - middle) ** 2).mean())
    return float(per_axis * _ALIKE / len(asked) * (1 + abs(middle) ** 2 / max(spread, 1e-9)))
