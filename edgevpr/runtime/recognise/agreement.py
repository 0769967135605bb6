"""The agreement of two pictures: how many of their landmarks coincide after one rotation, one scaling and one shift.

Ahead, near and far landmarks shift by different amounts, so fewer agree, and they only speak for a match. Points are
complex numbers here, x + iy (to the right, down), as shares of the longest side from the picture's middle. A *way* to
lay the query on the place is two of them: a point is multiplied by the first (rotation and scale), then the second (the
shift) is added.

Two landmarks match if each is the most similar one of the other picture. Every two of the best matches define one way.
The way that most of all matches follow is taken. Nothing is random: the same pictures always give the same result.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Covariance, Singles
from edgevpr.core.geodesy import fit_similarity, wrap_deg
from edgevpr.runtime.recognise.landmarks import Landmarks

# Inliers with which an agreement is confirmed, and proven. Of 14,799 pairs of a query and a place of another site,
# expected as their match says, 31 had four inliers, 7 five, 3 six and none more. Of
# 50,940 expected at random, 111 had four, 22 five and 2 six. So fewer than one in 10,000 has eight by chance. Where
# nothing is expected, 3 of 2500 had seven.
CONFIRMED, PROVEN = 8, 10
# Largest deviations from the expected shift (share of the longest side), rotation (degrees) and scale (a factor).
_MAX_SHIFT_SHARE = 3.5 / 32
_MAX_TURN_DEG = 25.0
_MAX_SCALE = 1.35
_ANY_SCALE = 1.9  # the same factor where no ratio of heights is expected
_SCALE_LIMITS = (0.4, 2.5)  # limits of the scale where nothing is expected
_MAX_ANGLE_DEG = 30.0  # between the directions of two matching landmarks; those of ORB err by a few degrees
_SIZE_TOLERANCE = 1.2  # one level of the image pyramid: sizes are not known more exactly

_MAX_DIFFERENT_BITS = 64  # of 256 may differ; one in some thousand pairs of unrelated landmarks differs in so few
_TOLERANCE_SHARE = 10 / 640  # of the longest side: relief and tilt move landmarks of the same spot by about so much
_BEST_MATCHES = 60  # every two of so many best matches define a way that is tried
_MIN_DISTANCE_SHARE = 0.06  # of the longest side; two landmarks nearer to each other say little about the rotation
_MIN_INLIERS = 3
# Relief and tilt move neighbouring landmarks alike: so many of them count as one independent landmark. With this, half
# of the errors on aerial_caliterra and aerial_garfield28 are within the bound that the covariance gives for half.
_DEPENDENT_LANDMARKS = 40.0


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
        turned = np.radians(wrap_deg(self.rotation_deg))
        return complex(dx, -dy), complex(np.log(self.scale or 1.0), -turned)


def compose_overlays(one: Overlay, other: Overlay) -> Overlay:
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
        return max(map(abs, self.shift_share)) <= _TOLERANCE_SHARE and turned_deg <= 2 and abs(self.scale - 1) <= 0.03


def compare_near(query: Landmarks, place: Landmarks, expected: Overlay) -> Agreement:
    """Compare two pictures near the `expected` overlay. If few landmarks agree there and many on another overlay,
    return the agreement on that one, with `is_expected` False."""
    found = measure_agreement(query, place, expected)
    if found.inliers >= CONFIRMED:
        return found
    otherwise = measure_agreement(query, place)
    if otherwise.inliers < PROVEN or otherwise.is_at_rest or otherwise.shift_share is None:
        return found  # an agreement at rest may come from a display, not from the ground
    way = Overlay(otherwise.shift_share, otherwise.rotation_deg or 0.0, otherwise.scale)
    is_near = _is_near(way.turn_scale, complex(*way.shift_share), expected)
    return found if is_near else replace(otherwise, is_expected=False)


def measure_agreement(query: Landmarks, place: Landmarks, expected: Overlay | None = None) -> Agreement:
    """Compare the landmarks of two pictures, by ways near to the `expected` overlay only (None: by all ways)."""
    possible = min(len(query), len(place))
    nothing = Agreement(inliers=0, matched=0, possible=possible)
    if possible < _MIN_INLIERS:
        return nothing
    asked, known = _complex(query), _complex(place)
    differing = _differing_bits(query.bits, place.bits)
    if expected is not None:
        differing[~_plausible(query, place, asked, known, expected)] = np.inf
    best = differing.argmin(axis=1)
    least = differing[np.arange(len(asked)), best]
    mutual = np.flatnonzero((differing.argmin(axis=0)[best] == np.arange(len(asked))) & (least <= _MAX_DIFFERENT_BITS))
    mutual = mutual[np.argsort(least[mutual], kind="stable")]
    asked, known = asked[mutual].astype(complex), known[best[mutual]].astype(complex)
    way = _find_most_followed(asked, known, expected)
    nothing = replace(nothing, matched=len(mutual))
    if way is None:
        return nothing
    for _ in range(3):
        along = np.abs(way[0] * asked + way[1] - known) <= _TOLERANCE_SHARE
        if np.count_nonzero(along) < _MIN_INLIERS:
            return nothing
        way = fit_similarity(asked[along], known[along])
    along = np.abs(way[0] * asked + way[1] - known) <= _TOLERANCE_SHARE
    inliers = int(np.count_nonzero(along))
    if inliers < _MIN_INLIERS or not _is_near(*way, expected):
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
    factor = _ANY_SCALE if expected.scale is None else _MAX_SCALE
    laid = expected.turn_scale * asked + np.complex64(complex(*expected.shift_share))
    room = _MAX_SHIFT_SHARE + np.abs(asked) * (factor - 1 + np.radians(_MAX_TURN_DEG) / 2)
    there: Bools = np.abs(laid[:, None] - known) <= room[:, None].astype(np.float32)
    turned = np.radians(query.angle_deg + expected.rotation_deg)[:, None] - np.radians(place.angle_deg)
    there &= np.cos(turned) >= np.cos(np.radians(_MAX_ANGLE_DEG))
    size, most = query.size[:, None] * np.float32(expected.scale or 1.0), np.float32(factor * _SIZE_TOLERANCE)
    return there & (size <= place.size * most) & (size * most >= place.size)


def _is_near(turn_scale: Any, shift: Any, expected: Overlay | None) -> Bools:
    """Return True for each way near to the expected overlay (None: for each way with a plausible scale). `turn_scale`
    and `shift` are its two complex numbers, or arrays of them; the result has their shape."""
    if expected is None:  # only the scale is limited
        least, most = _SCALE_LIMITS
        return np.asarray((np.abs(turn_scale) >= least) & (np.abs(turn_scale) <= most))
    difference = turn_scale / expected.turn_scale
    turned_deg, stretched = np.abs(np.angle(difference, deg=True)), np.abs(np.log(np.abs(difference)))
    most = np.log(_ANY_SCALE if expected.scale is None else _MAX_SCALE)
    is_there = np.abs(shift - complex(*expected.shift_share)) <= _MAX_SHIFT_SHARE
    return np.asarray((turned_deg <= _MAX_TURN_DEG) & (stretched <= most) & is_there)


def _find_most_followed(asked: Array, known: Array, expected: Overlay | None) -> tuple[complex, complex] | None:
    """Return the way that most matches follow, out of those that two matches define; None if none is near to the
    expected overlay. `asked` and `known`, complex (n,), are the points in query and place, best matches first."""
    one, other = np.triu_indices(min(_BEST_MATCHES, len(asked)), 1)
    apart = np.abs(asked[other] - asked[one]) > _MIN_DISTANCE_SHARE
    one, other = one[apart], other[apart]
    turn_scale = (known[other] - known[one]) / (asked[other] - asked[one])
    turn_scale = np.where(turn_scale == 0, np.finfo(float).tiny, turn_scale)  # two landmarks on one spot: avoid zero
    shift = known[one] - turn_scale * asked[one]
    near = _is_near(turn_scale, shift, expected)
    if not near.any():
        return None
    turn_scale, shift = turn_scale[near], shift[near]
    off = np.abs(turn_scale[:, None] * asked + shift[:, None] - known)
    follow = np.maximum(0, 1 - (off / _TOLERANCE_SHARE) ** 2).sum(axis=1)
    best = int(follow.argmax())
    return turn_scale[best], shift[best]


def _variance(asked: Array, known: Array, turn_scale: complex, shift: complex) -> float:
    """Return the variance of the shift along each axis, in squares of the picture's longest side, from the inliers."""
    left = np.abs(turn_scale * asked + shift - known) ** 2
    per_axis = max(float(left.sum()) / (2 * len(asked) - 4), (_TOLERANCE_SHARE / 10) ** 2)
    middle = asked.mean()
    spread = float((np.abs(asked - middle) ** 2).mean())
    # The farther the inliers are from the picture's middle, the more a wrong rotation moves the middle.
    return float(per_axis * _DEPENDENT_LANDMARKS / len(asked) * (1 + abs(middle) ** 2 / max(spread, 1e-9)))
