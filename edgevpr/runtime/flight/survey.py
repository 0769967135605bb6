"""The survey of map and camera: while GPS is good, a flight estimates the offset of the map from GPS, the map's scale
error, and the camera mount.

The offset of a match from the receiver is the sum of their effects. These vary differently: the map's offset is
constant, the mount's rotates with the heading and grows with the height, the scale's grows across the map. If a
flight cannot separate two of them, the standard deviations of both are large, and neither is reported.

With a wrong mount, receiver and map contradict each other as soon as the aircraft turns. So matches are also used while
GPS is distrusted, provided that the two halves of the flight agree."""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Bools, Doubles
from edgevpr.core.geodesy import move_position, offset_between_m
from edgevpr.core.types import Position, Vehicle
from edgevpr.frames.level import Mount
from edgevpr.mavlink.receivers import extrapolate
from edgevpr.runtime.flight.measurements import FrameMeasurement, compute_picture_error_m, position_match
from edgevpr.runtime.flight.navigation import is_gps_aided
from edgevpr.runtime.recognise.locate import mahalanobis
from edgevpr.runtime.recognise.recognition import Recognition

_MIN_INTERVAL_S = 5.0  # between two samples
_MAX_SAMPLES = 720  # the newest hour of matches
# GPS errors are correlated: matches within this time share one error, and count as one sample of it.
_GPS_CORRELATION_S = 180.0
_MAX_GPS_SD_M = 5.0  # a receiver that claims more is too inaccurate to survey a map
_FIX_INFLUENCE_S = 60.0  # our fix may affect the autopilot's position for this long: then the receiver is used
_COMMON_TILT_SD_DEG = 0.3  # of a mount: common to all pictures of a flight
# Prior standard deviations of offset (2, metres), mount (2, tangents), scale, and of the time between frames and
# positions (s), which on a straight track has the effect of a camera that looks ahead.
_PRIOR_INFORMATION = np.diag(1 / np.square([1e4, 1e4, 0.5, 0.5, 0.02, 0.1]))
_MIN_SAMPLES = 20
_MIN_INLIER_FRACTION = 0.7
_MAX_RESIDUAL_SD = 4.0  # of an inlier
# If some matches were taken while GPS was distrusted: the fraction of the others in each half of the flight, the
# standard deviation of the offset from one half, and the difference between the halves.
_MIN_TRUSTED_FRACTION = 0.1
_MAX_HALF_SD_M = 2.0
_MAX_HALVES_SD = 4.0
_MAX_TRUSTED_M = 12.0  # a match closer to GPS, given the mount, does not count against GPS
_HUBER_ITERATIONS = 6
_REJECTION_ITERATIONS = 3
_HUBER_SIGMA = 2.0
_RAYLEIGH_MEDIAN = math.sqrt(2 * math.log(2))  # of a Rayleigh distribution with a scale of 1


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveySample:
    """A match. `offset_m` (2,), metres east and north of GPS, is the product of `jacobian` (2, 6) and the parameters.
    The variance of each axis, m2, is the sum of `independent_m2` and `correlated_m2`, an error that `correlation`
    samples have in common. `distrusts_gps`: GPS was distrusted at that time."""

    jacobian: Doubles
    offset_m: Doubles
    independent_m2: float
    correlated_m2: float
    correlation: float
    distrusts_gps: bool


@dataclass(frozen=True, slots=True)
class SurveyMeasure:
    """A result with its standard deviation (of each axis), known if that is at most `max_sd`. Values that differ by
    less than `min_difference` count as equal."""

    value: tuple[float, ...]
    sd: float
    max_sd: float
    min_difference: float

    @property
    def is_known(self) -> bool:
        return self.sd <= self.max_sd

    def differs_from(self, other: tuple[float, ...], factor: float = 1.0) -> bool:
        """Return True if the value is known and clearly differs from `other`, by `factor` times `min_difference`."""
        return self.is_known and math.dist(self.value, other) > max(factor * self.min_difference, 3 * self.sd)


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyResult:
    """The result of `matches` matches. Its `measures` by name: `off_m`, the offset of the map from GPS (east, north) at
    the `middle` of the ground that they cover; `scale`, the fraction by which the map is too large around it;
    `ahead_deg` and `right_deg`, the angles by which the camera looks ahead and to the right of straight down."""

    matches: int
    middle: Position
    measures: dict[str, SurveyMeasure]

    def fields(self) -> dict[str, Any]:
        """Return this result as fields of the flight log; values that are not accurate enough are null."""
        fields: dict[str, Any] = {"matches": self.matches}
        fields["middle"] = {"lat_deg": round(self.middle.lat_deg, 7), "lon_deg": round(self.middle.lon_deg, 7)}
        for name, measure in self.measures.items():
            value = [round(number, 4) for number in measure.value]
            fields[name] = None if not measure.is_known else value if name == "off_m" else value[0]
            fields[f"{name.partition('_')[0]}_sd"] = round(measure.sd, 4) if measure.is_known else None
        return fields


class MapSurvey:
    """Collects samples. `mount`: mount used to level pictures. `is_level`: the camera is on a gimbal."""

    def __init__(self, mount: Mount, is_level: bool) -> None:
        self._mount, self._is_level = mount, is_level
        self._samples: deque[SurveySample] = deque(maxlen=_MAX_SAMPLES)
        self._origin: Position | None = None
        self._last_s = -math.inf

    def add_match(self, event: Recognition, distrusts_gps: bool = False) -> bool:
        """Add the match of an event as a sample; return False if it has no usable match, or the last sample is too
        recent. `distrusts_gps`: GPS is distrusted now."""
        vehicle, located, view = event.vehicle, event.located, event.view
        if event.frame is None or event.frame.t_mono_s - self._last_s < _MIN_INTERVAL_S:
            return False
        if vehicle is None or vehicle.gps is None or vehicle.gps.sd_m > _MAX_GPS_SD_M or not is_gps_aided(vehicle):
            return False
        # Without a view or a pose, the point below the camera is not known to within metres.
        if located is None or located.heading_deg is None or view.reason:
            return False
        if view.nadir_offset is None and view.nadir_offset_m is None:
            return False
        t_s, height_m = event.frame.t_mono_s, located.height_m or vehicle.height_m
        frame_sd_m = compute_picture_error_m(vehicle, height_m or 0.0, event.frame.t_sd_s)
        match = position_match(event, FrameMeasurement(t_s=t_s, sd_m=frame_sd_m))
        jacobian = self._compute_jacobian(vehicle, height_m, match.heading_error_deg or 0.0) if match else None
        if match is None or jacobian is None or not vehicle.is_fresh(t_s):
            return False
        # The autopilot's position, because the autopilot knows the lag of its receiver.
        reference = Position(vehicle.lat_deg, vehicle.lon_deg)
        if t_s - vehicle.t_fix_s <= _FIX_INFLUENCE_S:
            reference = Position(*extrapolate(vehicle.gps, t_s, vehicle.velocity_m_s or (0.0, 0.0)))
        correlation = max(1.0, _GPS_CORRELATION_S / min(t_s - self._last_s, _GPS_CORRELATION_S))
        self._origin = self._origin or reference
        jacobian[:, 4] = offset_between_m(self._origin, reference)
        self._samples.append(
            SurveySample(
                jacobian=jacobian,
                offset_m=np.array(offset_between_m(reference, match.position)),
                independent_m2=float(np.trace(match.scatter_m2)) / 2 - located.tilt_m2,  # the tilt is a parameter
                correlated_m2=vehicle.gps.sd_m**2,
                correlation=correlation,
                distrusts_gps=distrusts_gps,
            )
        )
        self._last_s = t_s
        return True

    def set_mount(self, mount: Mount) -> None:
        """Set the mount used to level the next pictures, and convert the samples to it."""
        change = _compute_tangents(mount) - _compute_tangents(self._mount)
        shifted = [replace(old, offset_m=old.offset_m - old.jacobian[:, 2:4] @ change) for old in self._samples]
        self._mount, self._samples = mount, deque(shifted, maxlen=_MAX_SAMPLES)

    def _compute_jacobian(self, vehicle: Vehicle, height_m: float | None, heading_error_deg: float) -> Doubles | None:
        """Return the Jacobian (2, 6) of a match in offset, mount, scale (left at 0) and time; None if unknown.
        `heading_error_deg` is the compass error measured in the picture."""
        roll_deg, pitch_deg = (0.0, 0.0) if self._is_level else (vehicle.roll_deg, vehicle.pitch_deg)
        inputs = vehicle.heading_deg, height_m, roll_deg, pitch_deg, *(vehicle.velocity_m_s or (None,))
        if not all(value is not None and math.isfinite(value) for value in inputs) or not height_m or height_m <= 0:
            return None
        heading, roll, pitch = (math.radians(angle or 0.0) for angle in (vehicle.heading_deg, roll_deg, pitch_deg))
        heading += math.radians(heading_error_deg)
        ahead_m, right_m = height_m * math.cos(roll), height_m * math.cos(pitch)  # a bank rotates the mount too
        east, north = vehicle.velocity_m_s or (0.0, 0.0)
        return np.array(
            [
                [1, 0, ahead_m * math.sin(heading), right_m * math.cos(heading), 0, east],
                [0, 1, ahead_m * math.cos(heading), -right_m * math.sin(heading), 0, north],
            ]
        )

    def compute_result(self) -> SurveyResult | None:
        """Return the result; None if there are too few samples, or they disagree."""
        samples = list(self._samples)
        if len(samples) < _MIN_SAMPLES or self._origin is None:
            return None
        solution, covariance, is_inlier = fit_samples(samples)
        middle_m = np.mean([sample.jacobian[:, 4] for sample in samples], axis=0)
        to_middle = np.eye(6)
        to_middle[:2, 4] = middle_m
        is_scattered = is_inlier.mean() < _MIN_INLIER_FRACTION
        if is_scattered or not _is_gps_plausible(samples, is_inlier, to_middle, solution[2:4]):
            return None
        solution, covariance = to_middle @ solution, to_middle @ covariance @ to_middle.T
        sd = np.sqrt(np.diag(covariance))
        ahead_deg, right_deg = np.degrees(np.arctan(solution[2:4] + _compute_tangents(self._mount))).tolist()
        ahead_sd_deg, right_sd_deg = np.hypot(np.degrees(sd[2:4]), _COMMON_TILT_SD_DEG).tolist()
        measures = {
            "off_m": SurveyMeasure((float(solution[0]), float(solution[1])), float(max(sd[:2])), 1.0, 1.0),
            "scale": SurveyMeasure((float(solution[4]),), float(sd[4]), 0.003, 0.005),
            "ahead_deg": SurveyMeasure((ahead_deg,), ahead_sd_deg, 1.5, 1.0),
            "right_deg": SurveyMeasure((right_deg,), right_sd_deg, 1.5, 1.0),
        }
        middle = move_position(self._origin, *middle_m.tolist())
        return SurveyResult(matches=int(is_inlier.sum()), middle=middle, measures=measures)


def fit_samples(samples: list[SurveySample]) -> tuple[Doubles, Doubles, Bools]:
    """Fit samples: return the parameters (6,), their covariance (6, 6), and bool (n,), False for outliers.

    The first rounds limit the weight of outliers (Huber), the last reject them. Scatter beyond the claimed accuracy of
    the matches inflates the covariance.
    """
    jacobian = np.array([sample.jacobian for sample in samples])
    offset_m = np.array([sample.offset_m for sample in samples])
    variances = [(sample.independent_m2, sample.correlated_m2, sample.correlation) for sample in samples]
    independent_m2, correlated_m2, correlation = np.array(variances).T
    inlier_weights, scatter = np.ones(len(samples)), 1.0
    for iteration in range(_HUBER_ITERATIONS + _REJECTION_ITERATIONS):
        weight = inlier_weights / (independent_m2 + correlation * correlated_m2)
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian) + _PRIOR_INFORMATION
        solution = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weight, jacobian, offset_m))
        residual_sd = np.linalg.norm(offset_m - jacobian @ solution, axis=1) / np.sqrt(independent_m2 + correlated_m2)
        scatter = max(1.0, float(np.median(residual_sd)) / _RAYLEIGH_MEDIAN)
        if iteration < _HUBER_ITERATIONS:
            inlier_weights = np.minimum(1.0, _HUBER_SIGMA * scatter / np.maximum(residual_sd, 1e-9))
        else:
            inlier_weights = (residual_sd <= _MAX_RESIDUAL_SD * scatter).astype(float)
    covariance: Doubles = scatter**2 * np.linalg.inv(normal)
    return solution, covariance, inlier_weights > 0


def _compute_tangents(mount: Mount) -> Doubles:
    """Return the tangents of a mount (2,), ahead and to the right."""
    return np.asarray(np.tan(np.radians((mount.ahead_deg, mount.right_deg))))


def _is_gps_plausible(samples: list[SurveySample], is_inlier: Bools, to_middle: Doubles, mount: Doubles) -> bool:
    """Return True if a fit with the inliers `is_inlier` (n,) leaves no reason to distrust GPS: both halves of a flight
    agree, as do the samples taken while GPS was trusted. A spoofed receiver moves between the halves. Samples that the
    `mount` (2,) explains do not count against GPS. `to_middle` (6, 6) moves parameters to the middle of the ground."""
    distrusted = np.array([sample.distrusts_gps for sample in samples])
    if not distrusted.any():
        return True
    residual_m = np.array([sample.offset_m - sample.jacobian[:, 2:4] @ mount for sample in samples])
    distrusted &= np.linalg.norm(residual_m, axis=1) > _MAX_TRUSTED_M
    halves = np.array_split(np.arange(len(samples)), 2)
    if min(np.mean(~distrusted[half]) for half in halves) < _MIN_TRUSTED_FRACTION:
        return False
    if is_inlier[~distrusted].mean() < _MIN_INLIER_FRACTION:
        return False
    first, second = (fit_samples([samples[index] for index in half])[:2] for half in halves)
    covariances = [to_middle @ covariance @ to_middle.T for _, covariance in (first, second)]
    worst_m2 = max(np.diag(covariance)[:2].max() for covariance in covariances)
    difference_sd = mahalanobis(to_middle @ (first[0] - second[0]), covariances[0] + covariances[1])
    return worst_m2 <= _MAX_HALF_SD_M**2 and difference_sd <= _MAX_HALVES_SD
