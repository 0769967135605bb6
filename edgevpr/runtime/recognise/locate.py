"""Positions in metres: from places that were recognised to the position of the aircraft, in metres and with a
covariance.

A match says by what step the middle of the query's picture lies off the middle of the place's. Where it is known how
that picture lies on the ground (its `Pose`), this is a position. Several places that show the same ground must then say
the same, and together say it more exactly. Without a pose, such as ahead, the position is the place's own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from edgevpr.core.arrays import Covariance, Doubles
from edgevpr.core.geodesy import axes_of, moved, offset_m
from edgevpr.core.types import Candidate, Pose, Position
from edgevpr.frames.level import UNKNOWN_VIEW, View
from edgevpr.runtime.recognise.agreement import CONFIRMED, Agreement
from edgevpr.runtime.recognise.levelling import UNTOLD_TILT

# Chosen on aerial_caliterra and aerial_garfield28. Standard deviations of one axis of a step, as shares of the longest
# side, that come on top of what a match knows of its own: tilt and relief move parts of a picture by different steps.
_OF_VOTE, _OF_LANDMARKS = 0.016, 0.008
_SCALE_SD, _TURN_SD = 0.03, 0.03  # of the pose of a place, which stretch and turn a step
_OF_SCATTER = 0.25
_LIKE_THE_BEST = 0.5  # of its score: such a match is heard too
_DISAGREES = 4.0  # standard deviations: such a place is not heard
_CONTRADICTS = 0.2  # of the footprint: farther apart than that, one of the two is not the right place
HEARD = 12  # places at most: over a dense map so many show the same ground, and none of them is a rival
_SAYING = 5  # of these make the position


@dataclass(frozen=True, slots=True, kw_only=True)
class Located:
    """Position of the aircraft: `position`, with `covariance_m2` (variance east, covariance, variance north).
    `heading_deg` is the compass direction of the top of the picture, and `height_ratio` the height of the camera over
    that of the map and `footprint_m` the length on the ground of its longest side (None: unknown). `places` are the
    numbers of those that say so. `objection` says why it is not to be believed (None: nothing is against it)."""

    position: Position
    covariance_m2: Covariance
    heading_deg: float | None = None
    height_ratio: float | None = None
    footprint_m: float | None = None
    places: tuple[int, ...] = ()
    objection: str | None = None

    @property
    def accuracy_m(self) -> float:
        """Standard deviation along the worst direction."""
        var_east, cov, var_north = self.covariance_m2
        middle, half = (var_east + var_north) / 2, math.hypot((var_east - var_north) / 2, cov)
        return math.sqrt(middle + half)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lies:
    """The way in which the query lies on a place at `position` with a `pose`: the `step` (2,) of its middle, to the
    right and down, as a share of the place's longest side, with its `covariance` (2, 2); its rotation in degrees, and
    its height over that of then."""

    place_id: int
    position: Position
    pose: Pose
    step: Doubles
    covariance: Doubles
    rotation_deg: float
    height_ratio: float | None


@dataclass(frozen=True, slots=True)
class _Said:
    """Position by one place: east and north (2,) in metres from the best place, the covariance (2, 2) of the step that
    led there, and that of its pose."""

    at_m: Doubles
    of_step: Doubles
    of_pose: Doubles

    def apart(self, other: "_Said") -> float:
        """Return how far apart two places say that the aircraft is, in standard deviations. Their poses are known
        against each other far better than on the Earth: half of a variance of each is what they may differ by."""
        return in_sd(self.at_m - other.at_m, self.of_step + other.of_step + (self.of_pose + other.of_pose) / 2)


def at_place(position: Position, accuracy_m: float) -> Located:
    """Return the position of a place as that of the aircraft, with a standard deviation of one axis."""
    return Located(position=position, covariance_m2=(accuracy_m**2, 0.0, accuracy_m**2))


def located(
    found: Sequence[Candidate], cells: int | None, view: View = UNKNOWN_VIEW, proof: Agreement | None = None
) -> Located | None:
    """Return where the aircraft is by the places `found`, best first; None where the best has no pose.

    `cells` is the number of cells along the longest side of a picture (None: shifts say nothing about metres). `view`
    is the way in which the query's picture lies on the ground; where it is unknown what is straight under the aircraft,
    that is about the middle. `proof` is how the landmarks of the best place agree: they say the step as well as the
    vote does. Places whose score is less than half of the best's, and those that do not show the same ground, are not
    heard; of those that are, the first five make the position.
    """
    best = _by_vote(found[0], cells)
    if best is None:
        return None
    least = _LIKE_THE_BEST * found[0].match.score
    others = (_by_vote(candidate, cells) for candidate in found[1:] if not candidate.match.score < least)
    heard = [best, *(lies for lies in others if lies and _shows_the_same(lies, best))]
    if proof and proof.is_expected and proof.inliers >= CONFIRMED:
        heard.insert(0, _by_landmarks(best, proof))
    said = [_said(lies, best.position, view.aside or (0.0, 0.0)) for lies in heard]
    first = said[0]
    agree = [True, *(first.apart(each) <= _DISAGREES for each in said[1:])]
    against_m = [float(np.hypot(*(each.at_m - first.at_m))) for each, ok in zip(said, agree, strict=True) if not ok]
    heard, said = list(compress(heard, agree)), list(compress(said, agree))
    at_m, covariance = _joined(said[:_SAYING])
    way = heard[0]
    if view.lean_m is not None:
        at_m = at_m + view.lean_m
    elif view.aside is None:
        covariance += (UNTOLD_TILT * best.pose.footprint_m * (way.height_ratio or 1.0)) ** 2 * np.eye(2)
    objection = None
    if max(against_m, default=0.0) > _CONTRADICTS * best.pose.footprint_m:
        objection = f"places of the same ground say positions that are {max(against_m):.0f} m apart"
    lat_deg, lon_deg = moved(best.position.lat_deg, best.position.lon_deg, *at_m.tolist())
    return Located(
        position=Position(lat_deg, lon_deg, best.position.alt_m),
        covariance_m2=_triple(covariance),
        heading_deg=(best.pose.up_deg + way.rotation_deg) % 360,
        height_ratio=way.height_ratio and way.height_ratio * view.zoom,
        footprint_m=best.pose.footprint_m * (way.height_ratio or 1.0),
        places=tuple(dict.fromkeys(lies.place_id for lies in heard)),
        objection=objection,
    )


def matrix_of(covariance: Covariance) -> Doubles:
    """Return a covariance (variance, covariance, variance) as a matrix (2, 2)."""
    return np.array([[covariance[0], covariance[1]], [covariance[1], covariance[2]]])


def in_sd(step: Doubles, covariance: Doubles) -> float:
    """Return the length of a step (2,) in standard deviations: its Mahalanobis distance, by a covariance (2, 2)."""
    return math.sqrt(step @ np.linalg.solve(covariance, step))


def as_learnt(where: Located, recorded: Position, recorded_sd_m: float) -> tuple[Position, Pose] | None:
    """Return position and pose of a new place that is `recorded` with a standard deviation of one axis, and lies where
    places around it say; None where the two contradict each other."""
    off_m = _off_m(recorded, where.position)
    by_places, by_record = matrix_of(where.covariance_m2), recorded_sd_m**2 * np.eye(2)
    both = by_places + by_record
    if in_sd(off_m, both) > _DISAGREES or where.heading_deg is None or where.footprint_m is None:
        return None
    gain = by_record @ np.linalg.inv(both)
    covariance = gain @ by_places
    pose = Pose(
        up_deg=where.heading_deg,
        footprint_m=where.footprint_m,
        covariance_m2=_triple(covariance),
        recorded=Position(recorded.lat_deg, recorded.lon_deg),
    )
    lat_deg, lon_deg = moved(recorded.lat_deg, recorded.lon_deg, *(gain @ off_m).tolist())
    return Position(lat_deg, lon_deg, recorded.alt_m), pose


def _joined(said: list[_Said]) -> tuple[Doubles, Doubles]:
    """Return the position that places say together, east and north (2,) in metres, and its covariance (2, 2)."""
    of_step = np.linalg.inv(sum(np.linalg.inv(each.of_step) for each in said))
    at_m = of_step @ sum(np.linalg.inv(each.of_step) @ each.at_m for each in said)
    if len(said) > 1:
        # Places that differ by more than they should say how inexact all of them are (Birge 1932).
        off = sum((each.at_m - at_m) @ np.linalg.solve(each.of_step, each.at_m - at_m) for each in said)
        of_step = of_step * max(1.0, float(off) / (2 * (len(said) - 1)))
    # What is wrong with the poses is common to neighbours: hearing several makes it no smaller.
    return at_m, of_step + np.mean([each.of_pose for each in said], axis=0)


def _by_vote(candidate: Candidate, cells: int | None) -> _Lies | None:
    """Return how the query lies on a place by its match; None where it cannot be laid over the ground of the place."""
    match, place = candidate.match, candidate.place
    if cells is None or match.shift_cells is None or match.rotation_deg is None:
        return None
    if place.position is None or place.pose is None:
        return None
    covariance = matrix_of(match.covariance_cells2 or (0.0, 0.0, 0.0)) / cells**2
    # Votes scatter around their peak; of their mean, what is left of that.
    covariance = covariance * _OF_SCATTER + _OF_VOTE**2 * np.eye(2)
    return _Lies(
        place_id=place.place_id,
        position=place.position,
        pose=place.pose,
        step=np.array(match.shift_cells) / cells,
        covariance=covariance,
        rotation_deg=match.rotation_deg,
        height_ratio=match.height_ratio,
    )


def _by_landmarks(best: _Lies, proof: Agreement) -> _Lies:
    """Return how the query lies on the best place by its landmarks, which agree."""
    covariance = matrix_of(proof.covariance_share2 or (0.0, 0.0, 0.0)) + _OF_LANDMARKS**2 * np.eye(2)
    step, rotation_deg = np.array(proof.shift_share), proof.rotation_deg or 0.0
    return replace(best, step=step, covariance=covariance, rotation_deg=rotation_deg, height_ratio=proof.scale)


def _shows_the_same(lies: _Lies, best: _Lies) -> bool:
    # Both show the middle of the query: their middles are not farther from each other than that.
    room_m = (lies.pose.footprint_m + best.pose.footprint_m) / 2
    return float(np.hypot(*_off_m(best.position, lies.position))) <= room_m


def _said(lies: _Lies, origin: Position, aside: tuple[float, float]) -> _Said:
    pose = lies.pose
    # The point under the aircraft, in the place's picture: first as the query has it, then turned and scaled as it is.
    ratio, turn = lies.height_ratio or 1.0, math.radians(lies.rotation_deg)
    right, up = aside
    dx = lies.step[0] + ratio * (right * math.cos(turn) + up * math.sin(turn))
    dy = lies.step[1] + ratio * (right * math.sin(turn) - up * math.cos(turn))
    axes = axes_of(pose.up_deg)
    off_m = pose.footprint_m * (axes @ (dx, -dy))
    length_m = float(np.hypot(*off_m))
    towards = off_m / length_m if length_m else np.zeros(2)
    aslant = np.array([-towards[1], towards[0]])
    of_pose = np.outer(towards, towards) * (_SCALE_SD * length_m) ** 2
    of_pose += np.outer(aslant, aslant) * (_TURN_SD * length_m) ** 2
    upwards = lies.covariance * [[1, -1], [-1, 1]]  # of a step up, and not down
    return _Said(
        at_m=_off_m(origin, lies.position) + off_m,
        of_step=pose.footprint_m**2 * (axes @ upwards @ axes.T) + of_pose,
        of_pose=matrix_of(pose.covariance_m2),
    )


def _off_m(origin: Position, position: Position) -> Doubles:
    """Return how far a position is from another, east and north (2,)."""
    return np.array(offset_m(origin.lat_deg, origin.lon_deg, position.lat_deg, position.lon_deg))


def _triple(covariance: Doubles) -> Covariance:
    return float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
