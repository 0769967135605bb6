"""The agreement of two images: how many of their landmarks coincide after one rotation, one scaling and one shift.

With a forward-looking camera, near and far landmarks shift by different amounts, so fewer agree, and they can only
support a match. Points are complex numbers here, x + iy (right, down) from the image's centre, as fractions of the
longest side. A similarity from query to place is two complex numbers: a point is multiplied by the first (rotation and
scale), then the second (the shift) is added.

Two landmarks match if each is the most similar to the other (mutual nearest neighbours). Each pair of the best
matches defines a similarity, and the one that fits the most matches is used. Nothing is random: the same images give
the same result."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Covariance, Singles
from edgevpr.core.geodesy import fit_similarity, wrap_deg
from edgevpr.runtime.recognise.landmarks import Landmarks

# Inliers that confirm and prove an agreement. Of 14,799 pairs of a query and a place of another site, expected at the
# overlay of their match, 31 had four inliers, 7 five, 3 six and none more. Of 50,940 expected on a random overlay, 111
# had four, 22 five and 2 six. So fewer than one in 10,000 has eight by chance. Without one, 3 of 2500 had seven.
MIN_CONFIRMED_INLIERS = 8
MIN_PROVEN_INLIERS = 10
# Largest deviations from the expected shift (fraction of the longest side), rotation (degrees) and scale (a factor).
_MAX_SHIFT = 3.5 / 32
_MAX_TURN_DEG = 25.0
_MAX_SCALE = 1.35
_MAX_UNKNOWN_SCALE = 1.9  # the same factor if the ratio of heights is unknown
_SCALE_LIMITS = (0.4, 2.5)  # limits of the scale without an expectation
_MAX_ANGLE_DEG = 30.0  # between the directions of matching landmarks; ORB directions are wrong by a few degrees
_SIZE_TOLERANCE = 1.2  # one level of the image pyramid, the resolution of sizes

_MAX_DIFFERENT_BITS = 64  # out of 256; about one in a thousand pairs of unrelated landmarks differs in no more bits
_TOLERANCE = 10 / 640  # fraction of the longest side: typical displacement of a landmark by relief and tilt
_BEST_MATCHES = 60  # number of best matches whose pairs each define a similarity to try
_MIN_DISTANCE = 0.06  # fraction of the longest side; landmarks closer together hardly constrain the rotation
_MIN_INLIERS = 3
# Relief and tilt move neighbouring landmarks together, so this many count as one independent landmark. With this value,
# half of the errors on aerial_caliterra and aerial_garfield28 are within the 50 % bound of the covariance.
_DEPENDENT_LANDMARKS = 40.0


@dataclass(frozen=True, slots=True)
class Overlay:
    """Estimated transformation of one image onto another, such as of the query onto a place. `shift_share`,
    `rotation_deg` and `scale` (None: unknown) are as in `Agreement`."""

    shift_share: tuple[float, float]
    rotation_deg: float
    scale: float | None = None

    @property
    def turn_scale(self) -> np.complex64:
        """Rotation and scale as one complex factor."""
        return np.complex64((self.scale or 1.0) * np.exp(1j * np.deg2rad(self.rotation_deg)))

    @property
    def relative_pose(self) -> tuple[complex, complex]:
        """Relative pose of the query, as used in `mapmaking.graph`: its offset, right + i up, and the logarithm of
        its scale + i times its counter-clockwise rotation."""
        dx, dy = self.shift_share
        clockwise = np.radians(wrap_deg(self.rotation_deg))
        return complex(dx, -dy), complex(np.log(self.scale or 1.0), -clockwise)


def compose_overlays(one: Overlay, other: Overlay) -> Overlay:
    """Return the overlay of place `one` on place `other`, given the overlays of the same query on each."""
    turn_scale = other.turn_scale / one.turn_scale
    shift = complex(*other.shift_share) - turn_scale * complex(*one.shift_share)
    scale = None if None in (one.scale, other.scale) else float(abs(turn_scale))
    rotation_deg = float(np.angle(turn_scale, deg=True)) % 360
    return Overlay((float(shift.real), float(shift.imag)), rotation_deg, scale)


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Result of comparing the landmarks of query and place. `matched` is the number of landmarks that match, `inliers`
    the number of those that coincide, and `possible` the smaller of the two images' landmark counts.

    To overlay the query on the place, rotate it by `rotation_deg` (clockwise, 0..360) about its centre, scale it by
    `scale` (above 1 if it was taken from higher up), and shift its centre from the place's centre by `shift_share` (dx
    right, dy down), as fractions of the place's longest side. `covariance_share2` (var x, cov xy, var y) is its
    covariance. All four are None without inliers. `is_expected` is False if the landmarks agree on an overlay other
    than the expected one. `inlier_points`: the inliers in query and place, complex (n,) each (`matched_points`: all).
    """

    inliers: int
    matched: int
    possible: int
    shift_share: tuple[float, float] | None = None
    rotation_deg: float | None = None
    scale: float | None = None
    covariance_share2: Covariance | None = None
    is_expected: bool = True
    inlier_points: tuple[Array, Array] | None = field(default=None, repr=False, compare=False)
    matched_points: tuple[Array, Array] | None = field(default=None, repr=False, compare=False)

    @property
    def is_unshifted(self) -> bool:
        """True if the images coincide without shift, rotation or scaling, as they do in an on-screen display."""
        if self.shift_share is None or self.rotation_deg is None or self.scale is None:
            return False
        rotation_deg = min(self.rotation_deg, 360 - self.rotation_deg)
        return max(map(abs, self.shift_share)) <= _TOLERANCE and rotation_deg <= 2 and abs(self.scale - 1) <= 0.03


def compare_near(query: Landmarks, place: Landmarks, expected: Overlay) -> Agreement:
    """Compare two images near the `expected` overlay. If few landmarks agree there but many agree on another overlay,
    return the agreement on that one, with `is_expected` False."""
    agreement = measure_agreement(query, place, expected)
    if agreement.inliers >= MIN_CONFIRMED_INLIERS:
        return agreement
    other = measure_agreement(query, place)
    if other.inliers < MIN_PROVEN_INLIERS or other.is_unshifted or other.shift_share is None:
        return agreement  # unshifted landmarks may belong to an on-screen display, not to the ground
    similarity = Overlay(other.shift_share, other.rotation_deg or 0.0, other.scale)
    is_near = _is_near(similarity.turn_scale, complex(*similarity.shift_share), expected)
    return agreement if is_near else replace(other, is_expected=False)


def measure_agreement(query: Landmarks, place: Landmarks, expected: Overlay | None = None) -> Agreement:
    """Compare the landmarks of two images, only near the `expected` overlay (None: under any overlay)."""
    possible = min(len(query), len(place))
    no_agreement = Agreement(inliers=0, matched=0, possible=possible)
    if possible < _MIN_INLIERS:
        return no_agreement
    query_points, place_points = _to_complex(query), _to_complex(place)
    bit_counts = _count_differing_bits(query.bits, place.bits)
    if expected is not None:
        bit_counts[~_find_pairs(query, place, query_points, place_points, expected)] = np.inf
    best = bit_counts.argmin(axis=1)
    min_bits = bit_counts[np.arange(len(query_points)), best]
    is_mutual = bit_counts.argmin(axis=0)[best] == np.arange(len(query_points))
    mutual = np.flatnonzero(is_mutual & (min_bits <= _MAX_DIFFERENT_BITS))
    mutual = mutual[np.argsort(min_bits[mutual], kind="stable")]
    query_points, place_points = query_points[mutual].astype(complex), place_points[best[mutual]].astype(complex)
    similarity = _find_best(query_points, place_points, expected)
    no_agreement = replace(no_agreement, matched=len(mutual))
    if similarity is None:
        return no_agreement
    for _ in range(3):
        is_inlier = np.abs(similarity[0] * query_points + similarity[1] - place_points) <= _TOLERANCE
        if np.count_nonzero(is_inlier) < _MIN_INLIERS:
            return no_agreement
        similarity = fit_similarity(query_points[is_inlier], place_points[is_inlier])
    is_inlier = np.abs(similarity[0] * query_points + similarity[1] - place_points) <= _TOLERANCE
    inliers = int(np.count_nonzero(is_inlier))
    if inliers < _MIN_INLIERS or not _is_near(*similarity, expected):
        return no_agreement
    turn_scale, shift = similarity
    variance = _estimate_variance(query_points[is_inlier], place_points[is_inlier], turn_scale, shift)
    return replace(
        no_agreement,
        inliers=inliers,
        shift_share=(float(shift.real), float(shift.imag)),
        rotation_deg=float(np.angle(turn_scale, deg=True)) % 360,
        scale=float(abs(turn_scale)),
        covariance_share2=(variance, 0.0, variance),
        inlier_points=(query_points[is_inlier], place_points[is_inlier]),
        matched_points=(query_points, place_points),
    )


def _to_complex(landmarks: Landmarks) -> Array:
    """Return the points of landmarks as complex64 (K,), x + iy."""
    return np.ascontiguousarray(landmarks.points, np.float32).view(np.complex64).ravel()


def _count_differing_bits(one: Bytes, other: Bytes) -> Singles:
    """Count the differing bits of each pair of descriptors: uint8 (N, 32) and (M, 32) -> float32 (N, M)."""
    signs, other_signs = (2 * np.unpackbits(bits, axis=1).astype(np.float32) - 1 for bits in (one, other))
    return np.asarray((signs.shape[1] - signs @ other_signs.T) / 2)


def _find_pairs(
    query: Landmarks, place: Landmarks, query_points: Array, place_points: Array, expected: Overlay
) -> Bools:
    """Return bool (N, M): True if a landmark of the query can be that landmark of the place, judging by position,
    direction and size under an overlay near the `expected` one. The points are complex (N,) and (M,)."""
    factor = _MAX_UNKNOWN_SCALE if expected.scale is None else _MAX_SCALE
    expected_points = expected.turn_scale * query_points + np.complex64(complex(*expected.shift_share))
    tolerance = _MAX_SHIFT + np.abs(query_points) * (factor - 1 + np.radians(_MAX_TURN_DEG) / 2)
    is_plausible: Bools = np.abs(expected_points[:, None] - place_points) <= tolerance[:, None].astype(np.float32)
    rotation = np.radians(query.angle_deg + expected.rotation_deg)[:, None] - np.radians(place.angle_deg)
    is_plausible &= np.cos(rotation) >= np.cos(np.radians(_MAX_ANGLE_DEG))
    size, max_ratio = query.size[:, None] * np.float32(expected.scale or 1.0), np.float32(factor * _SIZE_TOLERANCE)
    return is_plausible & (size <= place.size * max_ratio) & (size * max_ratio >= place.size)


def _is_near(turn_scale: Any, shift: Any, expected: Overlay | None) -> Bools:
    """Return True for a similarity near the expected overlay (None: for one of plausible scale). `turn_scale` and
    `shift` are its complex numbers, or arrays of them; the result has the same shape."""
    if expected is None:  # only the scale is limited
        min_scale, max_scale = _SCALE_LIMITS
        return np.asarray((np.abs(turn_scale) >= min_scale) & (np.abs(turn_scale) <= max_scale))
    difference = turn_scale / expected.turn_scale
    rotation_deg, log_scale = np.abs(np.angle(difference, deg=True)), np.abs(np.log(np.abs(difference)))
    max_log_scale = np.log(_MAX_UNKNOWN_SCALE if expected.scale is None else _MAX_SCALE)
    is_shift_near = np.abs(shift - complex(*expected.shift_share)) <= _MAX_SHIFT
    return np.asarray((rotation_deg <= _MAX_TURN_DEG) & (log_scale <= max_log_scale) & is_shift_near)


def _find_best(query_points: Array, place_points: Array, expected: Overlay | None) -> tuple[complex, complex] | None:
    """Return the similarity that fits the most matches, among those defined by two matches; None if none is near the
    expected overlay. The points are complex (n,), best matches first."""
    one, other = np.triu_indices(min(_BEST_MATCHES, len(query_points)), 1)
    is_apart = np.abs(query_points[other] - query_points[one]) > _MIN_DISTANCE
    one, other = one[is_apart], other[is_apart]
    turn_scale = (place_points[other] - place_points[one]) / (query_points[other] - query_points[one])
    turn_scale = np.where(turn_scale == 0, np.finfo(float).tiny, turn_scale)  # two landmarks at one point: avoid zero
    shift = place_points[one] - turn_scale * query_points[one]
    is_near = _is_near(turn_scale, shift, expected)
    if not is_near.any():
        return None
    turn_scale, shift = turn_scale[is_near], shift[is_near]
    residual = np.abs(turn_scale[:, None] * query_points + shift[:, None] - place_points)
    support = np.maximum(0, 1 - (residual / _TOLERANCE) ** 2).sum(axis=1)
    best = int(support.argmax())
    return turn_scale[best], shift[best]


def _estimate_variance(query_points: Array, place_points: Array, turn_scale: complex, shift: complex) -> float:
    """Return the variance of the shift along each axis, in squares of the image's longest side, from the inliers."""
    residual2 = np.abs(turn_scale * query_points + shift - place_points) ** 2
    per_axis = max(float(residual2.sum()) / (2 * len(query_points) - 4), (_TOLERANCE / 10) ** 2)
    centre = query_points.mean()
    spread = float((np.abs(query_points - centre) ** 2).mean())
    # The farther the inliers are from the image's centre, the more a rotation error moves the centre.
    return float(per_axis * _DEPENDENT_LANDMARKS / len(query_points) * (1 + abs(centre) ** 2 / max(spread, 1e-9)))
