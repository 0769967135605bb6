"""Computes the position of the aircraft, with a covariance, from the recognised places. The recogniser uses it.

A match gives the shift between the centres of the pictures of query and place. If the `Pose` of the place is known (how
its picture maps to the ground), the shift gives a position. Places that show the same ground must give about
the same position, and their mean is more accurate. Without a pose, as ahead, the position is that of the place."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from edgevpr.core.arrays import Covariance, Doubles
from edgevpr.core.contract import FineMatch
from edgevpr.core.geodesy import distance_m, move_position, offset_between_m, picture_axes
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Candidate, Place, Position
from edgevpr.frames.level import UNKNOWN_VIEW, View
from edgevpr.runtime.recognise.agreement import MIN_CONFIRMED_INLIERS, Agreement
from edgevpr.runtime.recognise.levelling import TILT_SD_WITHOUT_ATTITUDE
from edgevpr.runtime.recognise.perspective import TYPICAL_FOCAL, AttitudeError, fit_attitude_error
from edgevpr.runtime.recognise.relief import UNKNOWN_HEIGHT_SD, compute_nadir_sd

# Chosen on aerial_caliterra and aerial_garfield28. Standard deviations along one axis of a shift, as fractions of the
# longest side, added to the covariance of a match: tilt and relief shift the parts of a picture differently.
_VOTE_SD = 0.016
_LANDMARK_SD = 0.008
# Due to scale and rotation of a place's pose, as a fraction of the length of a shift. If no other picture has confirmed
# them, both are as recorded: barometers over sloping ground, and compasses or courses in wind, err by a fifth.
_POSE_SD = 0.03
_RECORDED_POSE_SD = 0.2
_MEAN_VARIANCE_RATIO = 0.25  # variance of the mean of the votes, relative to that of a single vote
_MIN_BASELINE = 0.2  # of the longest side: nearer places do not show the scale
_MIN_SCORE_RATIO = 0.5  # matches with at least this fraction of the best score are also used
_MAX_DIFFERENCE_SD = 4.0  # places whose positions differ by more are not used
_MAX_POSITION_SPREAD = 0.2  # fraction of the footprint: if positions are farther apart, one of the places is wrong
_MAX_CONTRADICTION_RATIO = 0.4  # sum of the scores of contradicting places, relative to agreeing ones
MAX_PLACES_CHECKED = 12  # this many show the same ground in a dense map
_MAX_PLACES_AVERAGED = 5  # number of these that determine the position


@dataclass(frozen=True, slots=True, kw_only=True)
class Located:
    """Position of the aircraft, with `covariance_m2` (variance east, covariance, variance north). `heading_deg` is the
    compass direction of the top of the picture. `height_ratio` is the height of the camera divided by that of the map's
    pictures, `footprint_m` the length of the longest side on the ground, and `height_m` the resulting height above the
    ground, independent of any reported one (None: unknown). `places` are the numbers of the places that agree on the
    position. `objection` is the reason not to trust it (None: trusted). `attitude_error` is the error of the reported
    attitude measured in the picture; the position still contains its effect. `tilt_m2` is the part of both variances
    due to an unreported tilt, and `common_tilt_m` the standard deviation due to one that all images have."""

    position: Position
    covariance_m2: Covariance
    heading_deg: float | None = None
    height_ratio: float | None = None
    footprint_m: float | None = None
    height_m: float | None = None
    places: tuple[int, ...] = ()
    objection: Reason | None = None
    attitude_error: AttitudeError | None = None
    tilt_m2: float = 0.0
    common_tilt_m: float = 0.0

    @property
    def accuracy_m(self) -> float:
        """Standard deviation along the worst direction, metres."""
        return compute_worst_sd(covariance_matrix(self.covariance_m2))

    @property
    def sd_m(self) -> float:
        """Standard deviation along one axis, averaged over all directions, metres."""
        return math.sqrt((self.covariance_m2[0] + self.covariance_m2[2]) / 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class _PlaceEstimate:
    """Position of the aircraft computed from one place. `position_m` (2,) is metres east and north of the best place.
    Its covariances (2, 2) are `match_covariance`, of the match, and `pose_covariance`, of the pose. `recorded_m2`:
    variance along each axis due to direction and size of a pose that are only recorded; neighbours have the same error.
    `rotation_deg` and `height_ratio`, of the query on the place, are as in `FineMatch`."""

    place_id: int
    score: float
    position_m: Doubles
    match_covariance: Doubles
    pose_covariance: Doubles
    recorded_m2: float
    rotation_deg: float
    height_ratio: float | None

    def agrees_with(self, other: "_PlaceEstimate") -> bool:
        """Return True if both positions are about the same. Relative to each other, poses are far more accurate than on
        the Earth, so only half of each variance counts."""
        covariance = self.match_covariance + other.match_covariance + (self.pose_covariance + other.pose_covariance) / 2
        return mahalanobis(self.position_m - other.position_m, covariance) <= _MAX_DIFFERENCE_SD


def locate_at_place(position: Position, accuracy_m: float) -> Located:
    """Return the position of a place as that of the aircraft; `accuracy_m` is the standard deviation along one axis."""
    return Located(position=position, covariance_m2=(accuracy_m**2, 0.0, accuracy_m**2))


def measure_distance_m(places: Sequence[Candidate], cells: int | None) -> float:
    """Return the distance from the image centre of the first of the matched `places` to that of the query, without
    poses: if several show the same ground, their positions give the scale (unknown: 0.0). `cells`: see `locate`."""
    nearest = _find_centre(places[0].match, cells)
    if nearest is None:
        return 0.0
    min_score = _MIN_SCORE_RATIO * places[0].match.score
    known = [
        (centre, candidate.place.position)
        for candidate in places
        if candidate.match.score >= min_score and candidate.place.position
        if (centre := _find_centre(candidate.match, cells)) is not None
    ]
    footprints_m = [
        distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg) / abs(first - second)
        for (first, one), (second, other) in combinations(known, 2)
        if abs(first - second) >= _MIN_BASELINE
    ]
    return abs(nearest) * float(np.median(footprints_m)) if footprints_m else 0.0


def _find_centre(match: FineMatch, cells: int | None) -> complex | None:
    """Return the centre of the image of a matched place in that of the query, right + down j, in longest sides; None if
    the match has no shift."""
    if cells is None or match.shift_cells is None or match.rotation_deg is None:
        return None
    turn_scale = cmath.rect(match.height_ratio or 1.0, math.radians(match.rotation_deg))
    return -complex(*match.shift_cells) / cells / turn_scale


def locate(
    places: Sequence[Candidate],
    cells: int | None,
    view: View = UNKNOWN_VIEW,
    agreement: Agreement | None = None,
    height_sd: float = UNKNOWN_HEIGHT_SD,
) -> Located | None:
    """Return the position of the aircraft from the matched `places`, best first; None if the best has no pose or its
    match no shift. `cells` is the number of cells along the longest side of a picture (None: unknown, so shifts cannot
    be converted to metres). `view` is how the query's picture maps to the ground; if the point below the aircraft is
    unknown, the centre is used. `agreement` is that of the landmarks of the best place, which gives a second shift.
    `height_sd` is `Relief.height_sd`.

    Of the places that show the same ground, those whose positions agree with the first are listed in the result. The
    first five of these with at least half of the best score determine the position. Places with such a score and a
    position far from the first contradict it; if the sum of their scores is too large, the position is not trusted."""
    best, pose, nadir, error = places[0].place, places[0].place.pose, view.nadir_offset or (0.0, 0.0), None
    first = _estimate_position(places[0], best, cells, nadir)
    if first is None or best.position is None or pose is None:
        return None
    estimates = [first, *filter(None, (_estimate_position(place, best, cells, nadir) for place in places[1:]))]
    if agreement and agreement.is_expected and agreement.inliers >= MIN_CONFIRMED_INLIERS:
        first = _estimate_position(places[0], best, cells, nadir, agreement) or first
        estimates.insert(0, first)
        if agreement.inlier_points:
            error = fit_attitude_error(*agreement.inlier_points, view, pose.up_deg + first.rotation_deg)
    min_score = _MIN_SCORE_RATIO * first.score
    agreeing = [estimate for estimate in estimates if first.agrees_with(estimate)]
    position_m, covariance = _average([other for other in agreeing if other.score >= min_score][:_MAX_PLACES_AVERAGED])
    footprint_m = pose.footprint_m * (first.height_ratio or 1.0)
    if view.nadir_offset_m is not None:
        position_m = position_m + view.nadir_offset_m
        # The lens is unknown, so the height may be wrong if a usual lens would show other ground from it.
        doubt = 1.0 - TYPICAL_FOCAL * footprint_m / max(view.nadir_height_m or 0.0, 1.0)
        covariance += doubt**2 * np.outer(view.nadir_offset_m, view.nadir_offset_m)
    else:
        tilt_sd = TILT_SD_WITHOUT_ATTITUDE if view.nadir_offset is None else compute_nadir_sd(view, height_sd)
        covariance += (tilt_sd * footprint_m) ** 2 * np.eye(2)
    others = [estimate for estimate in estimates if estimate.score >= min_score and not first.agrees_with(estimate)]
    agreeing_score = sum(estimate.score for estimate in agreeing)
    total_score, far_m = agreeing_score + sum(other.score for other in others), _MAX_POSITION_SPREAD * pose.footprint_m
    far_score = farthest_m = 0.0
    for other in others:  # any of them may be right, in proportion to its score
        offset_m = other.position_m - first.position_m
        covariance += other.score / total_score * np.outer(offset_m, offset_m)
        if (distance_m := float(np.hypot(*offset_m))) > far_m:
            far_score, farthest_m = far_score + other.score, max(farthest_m, distance_m)
    is_contradicted = far_score > _MAX_CONTRADICTION_RATIO * agreeing_score
    return Located(
        position=move_position(best.position, float(position_m[0]), float(position_m[1]), best.position.alt_m),
        covariance_m2=to_triple(covariance),
        heading_deg=(pose.up_deg + first.rotation_deg) % 360,
        height_ratio=first.height_ratio and first.height_ratio * view.zoom,
        footprint_m=footprint_m,
        height_m=view.focal and view.focal * footprint_m,
        places=tuple(dict.fromkeys(estimate.place_id for estimate in agreeing)),
        objection=Reason(ReasonCode.POSITIONS_DISAGREE, {"distance_m": farthest_m}) if is_contradicted else None,
        attitude_error=error,
    )


def add_tilt_covariance(located: Located, single_sd: float, common_sd: float) -> Located:
    """Return the position with its covariance increased by the effect of the tilt that may remain after levelling.
    Standard deviations, as tangents, of the tilt that this image shows, and of the one common to all images."""
    height_m = located.height_m or TYPICAL_FOCAL * (located.footprint_m or 0.0)
    tilt_m2 = (max(single_sd, common_sd) * height_m) ** 2
    east_m2, cross_m2, north_m2 = located.covariance_m2
    covariance_m2 = (east_m2 + tilt_m2, cross_m2, north_m2 + tilt_m2)
    common_tilt_m = math.hypot(located.common_tilt_m, common_sd * height_m)
    return replace(located, covariance_m2=covariance_m2, tilt_m2=located.tilt_m2 + tilt_m2, common_tilt_m=common_tilt_m)


def covariance_matrix(covariance: Covariance) -> Doubles:
    """Return a covariance (variance, covariance, variance) as a matrix (2, 2)."""
    return np.array([[covariance[0], covariance[1]], [covariance[1], covariance[2]]])


def compute_worst_sd(covariance: Doubles) -> float:
    """Return the standard deviation along the worst direction of a covariance (2, 2)."""
    (var_east, cov), (_, var_north) = covariance.tolist()
    return math.sqrt((var_east + var_north) / 2 + math.hypot((var_east - var_north) / 2, cov))


def mahalanobis(step: Doubles, covariance: Doubles) -> float:
    """Return the Mahalanobis distance of a shift (n,): its length in standard deviations of a covariance (n, n)."""
    return math.sqrt(step @ np.linalg.solve(covariance, step))


def _average(estimates: list[_PlaceEstimate]) -> tuple[Doubles, Doubles]:
    """Return the mean (2,) of the positions computed from several places, and its covariance (2, 2)."""
    match_covariance = np.linalg.inv(sum(np.linalg.inv(place.match_covariance) for place in estimates))
    position_m = match_covariance @ sum(np.linalg.inv(place.match_covariance) @ place.position_m for place in estimates)
    if len(estimates) > 1:
        # If places differ by more than their covariances allow, the covariances are scaled up (Birge 1932).
        errors_m = [(place.position_m - position_m, place.match_covariance) for place in estimates]
        chi2 = sum(error_m @ np.linalg.solve(covariance, error_m) for error_m, covariance in errors_m)
        match_covariance = match_covariance * max(1.0, float(chi2) / (2 * (len(estimates) - 1)))
    # Neighbours have the same pose errors, so averaging does not reduce them.
    pose_covariances = [place.pose_covariance + place.recorded_m2 * np.eye(2) for place in estimates]
    return position_m, match_covariance + np.mean(pose_covariances, axis=0)


def _estimate_position(
    candidate: Candidate, best: Place, cells: int | None, nadir: tuple[float, float], agreement: Agreement | None = None
) -> _PlaceEstimate | None:
    """Compute the position of the aircraft from one place, using the shift of its match or, with `agreement`, of the
    landmarks that agree. None if the match has no shift or rotation, the place no pose, or the `best` place's picture
    is too far away to show the same ground. `cells` is as in `locate`, and `nadir` is `View.nadir_offset`."""
    match, place, pose = candidate.match, candidate.place, candidate.place.pose
    if cells is None or match.shift_cells is None or match.rotation_deg is None:
        return None
    if place.position is None or pose is None or best.position is None or best.pose is None:
        return None
    place_offset_m = np.array(offset_between_m(best.position, place.position))
    if float(np.hypot(*place_offset_m)) > (pose.footprint_m + best.pose.footprint_m) / 2:
        return None
    if agreement:
        rotation_deg, height_ratio = agreement.rotation_deg or 0.0, agreement.scale
        step, landmark_share2 = np.array(agreement.shift_share), _LANDMARK_SD**2 * np.eye(2)
        covariance = covariance_matrix(agreement.covariance_share2 or (0.0, 0.0, 0.0)) + landmark_share2
    else:
        rotation_deg, height_ratio, step = match.rotation_deg, match.height_ratio, np.array(match.shift_cells) / cells
        # The covariance of the match is that of a single vote; that of the mean is smaller.
        covariance = covariance_matrix(match.covariance_cells2 or (0.0, 0.0, 0.0)) / cells**2
        covariance = covariance * _MEAN_VARIANCE_RATIO + _VOTE_SD**2 * np.eye(2)
    # The point below the aircraft in the place's picture is that in the query's picture, rotated, scaled and shifted.
    ratio, turn = height_ratio or 1.0, math.radians(rotation_deg)
    right, up = nadir
    dx = step[0] + ratio * (right * math.cos(turn) + up * math.sin(turn))
    dy = step[1] + ratio * (right * math.sin(turn) - up * math.cos(turn))
    axes = picture_axes(pose.up_deg)
    step_m = pose.footprint_m * (axes @ (dx, -dy))
    length_m = float(np.hypot(*step_m))
    covariance_up = covariance * [[1, -1], [-1, 1]]  # y up instead of down
    return _PlaceEstimate(
        place_id=place.place_id,
        score=match.score,
        position_m=place_offset_m + step_m,
        match_covariance=pose.footprint_m**2 * (axes @ covariance_up @ axes.T) + (_POSE_SD * length_m) ** 2 * np.eye(2),
        pose_covariance=covariance_matrix(pose.covariance_m2),
        recorded_m2=0.0 if pose.is_confirmed else (_RECORDED_POSE_SD * length_m) ** 2,
        rotation_deg=rotation_deg,
        height_ratio=height_ratio,
    )


def to_triple(covariance: Doubles) -> Covariance:
    """Return a covariance matrix (2, 2) as (variance, covariance, variance), the inverse of `covariance_matrix`."""
    return float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
