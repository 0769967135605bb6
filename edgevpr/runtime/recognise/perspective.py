"""Estimates the tilt of a camera, beyond the tilt reported by the autopilot, from its pictures.

A picture is levelled with the reported attitude. If that is wrong, the picture remains tilted by the error, and one
rotation, scaling and shift cannot align its landmarks with those of the place: a tilt moves a landmark by a term that
grows with the square of its distance from the point below the camera. This term is fitted here. The constant term is
indistinguishable from a shift: it is the effect of a wrong attitude on the position."""

import cmath
import logging
import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from edgevpr.core.arrays import Array
from edgevpr.core.contract import Perspective
from edgevpr.core.geodesy import fit_similarity, picture_axes
from edgevpr.frames.level import View

_log = logging.getLogger(__name__)
_MIN_LANDMARKS = 12
_POINT_SD = 2.5 / 640  # standard deviation of a landmark, as a fraction of the longest side
_SHEAR_SD = 0.01
TYPICAL_FOCAL = 0.77  # 66 degrees along the longest side
_UNKNOWN_TILT_SD = math.tan(math.radians(30.0))  # if too few regions agree to measure a tilt
_CLEAR_SD = 3.0  # standard deviations by which a clear tilt exceeds the reported one
_CLEAR_TILT = math.tan(math.radians(5.0))
# Error of a slope: the pictures of places are tilted by a few degrees, and relief also looks like a tilt.
_PLACE_SLOPE_SD = 0.1
# Relative difference of scales with direction. Level views of aerial_garfield28 and aerial_caliterra have 0.07 at most,
# those of 45 degrees 0.08 to 0.25; it is the square of the tangent of half the tilt.
_CLEAR_STRETCH = 0.075
_TILT_RELATIVE_SD = 0.3  # relative to the tilt: it adds to the claimed error, but cannot refuse an image at 30 degrees
# Errors of the mean over matches: slopes of the ground, which a map of an orthophoto does not contain; and of a match:
# the tilt of the place's image, as in a map made with the same camera.
_COMMON_TILT_SD = math.tan(math.radians(2.0))
_SINGLE_TILT_SD = math.tan(math.radians(4.0))
_MAX_TILT = math.tan(math.radians(60.0))  # a larger tilt is a wrong fit
_COMMON_RELATIVE_SD = 0.15  # relative to the tilt: large tilts, which are mostly wrong, count little
# Before any match: odds that a camera is tilted otherwise than reported, and the tilt of such a camera along each axis.
_WRONG_MOUNT_ODDS = 0.5
_WRONG_MOUNT_SD = math.tan(math.radians(10.0))
_MAX_UNCLAIMED = 0.05  # probability that an error exceeds two standard deviations
_MIN_WARNING_PROBABILITY = 0.95
_DECAY = 0.98  # of the weight of earlier matches, per match: a gimbal may move
# Relief moves neighbouring landmarks together, so this many count as one. The place's own picture is tilted too.
_CORRELATED_LANDMARKS = 5.0
_PLACE_TILT_SD = math.tan(math.radians(0.5))


@dataclass(frozen=True, slots=True)
class AttitudeError:
    """Camera tilt beyond the reported attitude. `nadir_shift` (east, north) is the offset of the point below the camera
    from its position by the reported attitude, over the height above ground. `sd`: standard deviation of each axis."""

    nadir_shift: tuple[float, float]
    sd: float


@dataclass(frozen=True, slots=True)
class ObservedTilt:
    """Tilt of a levelled picture relative to that of a place, measured from both: its `tangent`, and the standard
    deviation of each axis due to the regions compared (`sd`) and to tilt and relief of the place (`place_sd`)."""

    tangent: float
    sd: float
    place_sd: float = 0.0

    @property
    def deg(self) -> float:
        """The tilt in degrees."""
        return math.degrees(math.atan(self.tangent))

    @property
    def least_deg(self) -> float:
        """The tilt in degrees, less two standard deviations."""
        return math.degrees(math.atan(self.tangent - 2 * math.hypot(self.sd, self.place_sd)))

    @property
    def is_clear(self) -> bool:
        """True if there is clearly a tilt."""
        return self.tangent > max(_CLEAR_SD * math.hypot(self.sd, self.place_sd), _CLEAR_TILT)

    def get_sd(self, is_reported: bool) -> float:
        """Return the standard deviation of the tilt used for levelling, as a tangent. A reported tilt is trusted unless
        this picture clearly contradicts it. Without one, the error is the full measured tilt plus its error, because it
        is measured too small if only a few, clustered regions agree, as in the data set tilt_ariel."""
        if is_reported:
            return math.hypot(self.tangent, self.sd) if self.is_clear else 0.0
        return self.tangent + self.sd


def convert_to_tilt(perspective: Perspective | None, focal: float | None) -> ObservedTilt:
    """Convert a perspective (None: unknown) to a tilt. `focal` is the focal length as a fraction of the longest side
    (None: unknown, use that of a typical camera)."""
    if perspective is None:
        return ObservedTilt(0.0, _UNKNOWN_TILT_SD)
    focal = focal or TYPICAL_FOCAL
    from_slope = ObservedTilt(focal * perspective.slope, focal * perspective.slope_sd, focal * _PLACE_SLOPE_SD)
    largest, smallest = perspective.scales
    stretch_tangent = math.sqrt((largest / smallest) ** 2 - 1)
    is_stretched = (largest - smallest) / (largest + smallest) >= _CLEAR_STRETCH
    if not is_stretched or (from_slope.is_clear and from_slope.tangent > stretch_tangent):
        return from_slope
    return ObservedTilt(stretch_tangent, _TILT_RELATIVE_SD * stretch_tangent)


class CommonTilt:
    """The tilt that all images have beyond the reported one, in camera axes: that of a mount that is not configured.
    It is the mean over accepted matches, because few of them show a tilt clearly (none with a narrow lens), and tilts
    due to the ground or to the images of places have a different direction each time."""

    def __init__(self) -> None:
        self._weighted = 0j
        self._weight = 0.0
        self._place_id: int | None = None
        self._has_warned = False

    @property
    def mean(self) -> ObservedTilt:
        """The mean tilt so far."""
        if not self._weight:
            return ObservedTilt(0.0, _UNKNOWN_TILT_SD)
        return ObservedTilt(abs(self._weighted) / self._weight, self._weight**-0.5, _COMMON_TILT_SD)

    @property
    def probability(self) -> float:
        """Probability that the camera is tilted otherwise than reported, given the mean so far: by Bayes' theorem, from
        the probability densities of this mean with such a tilt and without one."""
        mean, variance = self.mean, self._variance
        total = variance + _WRONG_MOUNT_SD**2
        odds = _WRONG_MOUNT_ODDS * variance / total * math.exp(mean.tangent**2 / 2 * (1 / variance - 1 / total))
        return odds / (1 + odds)

    @property
    def sd(self) -> float:
        """Standard deviation of the reported tilt along any axis, as a tangent, given the mean so far. The tilt is
        either as reported or not, so twice its root mean square may exceed less than 95 % of all cases: then it is half
        of the tilt that does."""
        probability = self.probability
        trust = _WRONG_MOUNT_SD**2 / (self._variance + _WRONG_MOUNT_SD**2)
        tangent, tangent_sd = trust * self.mean.tangent, math.sqrt(trust * self._variance)
        root_mean_square = math.sqrt(probability) * math.hypot(tangent, tangent_sd)
        if probability <= _MAX_UNCLAIMED:
            return root_mean_square
        quantile = tangent + tangent_sd * NormalDist().inv_cdf(1 - _MAX_UNCLAIMED / probability)
        return max(root_mean_square, quantile / 2)

    @property
    def _variance(self) -> float:
        """Variance of each axis of the mean."""
        return self.mean.sd**2 + self.mean.place_sd**2

    def add(self, perspective: Perspective, view: View, place_id: int) -> None:
        """Add the perspective of an accepted match. A repeat of the previous place is ignored."""
        if place_id == self._place_id:
            return
        self._place_id, focal = place_id, view.focal or TYPICAL_FOCAL
        right, down = perspective.over_place[2, :2]
        tilt = cmath.rect(focal, -math.radians(view.rotation_deg)) * complex(right, down)
        if not abs(tilt) <= _MAX_TILT:  # also of a fit that failed (NaN)
            return
        sd = math.hypot(focal * perspective.slope_sd, _SINGLE_TILT_SD, _COMMON_RELATIVE_SD * abs(tilt))
        weight = sd**-2
        self._weighted = _DECAY * self._weighted + weight * tilt
        self._weight = _DECAY * self._weight + weight
        if self.probability >= _MIN_WARNING_PROBABILITY and not self._has_warned:
            self._has_warned = True
            _log.warning(
                "the camera is tilted by about %.0f degrees more than reported: set source.mount_ahead_deg and "
                "source.mount_right_deg (until then the reported position accuracy includes this error)",
                self.mean.deg,
            )


def fit_attitude_error(query: Array, place: Array, view: View, up_deg: float) -> AttitudeError | None:
    """Fit the attitude error to landmarks; None if there are too few, or the view has no attitude or focal length.

    `query` and `place`, complex (n,), are their landmarks that agree, as in `agreement`. `up_deg` is
    the compass direction of the top of the query's levelled picture."""
    count = len(query)
    if count < _MIN_LANDMARKS or view.nadir_offset is None or view.focal is None:
        return None
    # A ray at x + iy (focal lengths right and down of straight down) moves by t + (x Re t + y Im t)(x + iy) when the
    # camera rotates by the small angle t = right + i down. t is in the scale and rotation of the picture itself.
    ray = (query - complex(view.nadir_offset[0], -view.nadir_offset[1])) / view.focal
    turn_scale, _ = fit_similarity(query, place)
    right_column, down_column = (turn_scale * view.focal * part * ray for part in (ray.real, ray.imag))
    # A slope of the ground also stretches and shears the picture, by a few per cent.
    linear = (query, 1j * query, query.conj(), 1j * query.conj())
    columns = (*linear, np.ones(count), 1j * np.ones(count), right_column, down_column)
    design = np.concatenate([np.real(columns), np.imag(columns)], axis=1).T
    observed = np.concatenate([place.real, place.imag])
    normal = design.T @ design
    normal[2, 2] += _POINT_SD**2 / _SHEAR_SD**2
    normal[3, 3] += _POINT_SD**2 / _SHEAR_SD**2
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None  # all landmarks are on one line
    fit = inverse @ design.T @ observed
    residual = observed - design @ fit
    residual_variance = float(residual @ residual) / (2 * count - len(fit))
    variance = residual_variance * _CORRELATED_LANDMARKS * float(inverse[6, 6] + inverse[7, 7]) / 2
    right, down = fit[6:]
    east, north = picture_axes(up_deg) @ (-right, down)
    return AttitudeError((float(east), float(north)), math.hypot(math.sqrt(variance), _PLACE_TILT_SD))
