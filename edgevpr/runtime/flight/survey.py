"""The survey of map and camera: while GPS is good, a flight finds the offset of the map from GPS, its error of scale,
and the mount of the camera.

The offset of a match from the receiver is the sum of all three. They are told apart by what they turn with: the map's
offset stays, a mount turns with the heading and grows with the height, a scale grows across the map. Where a flight
cannot tell two of them apart, the standard deviations of both are large, and neither is reported.

A mount alone makes receiver and map contradict each other as soon as the aircraft turns. So matches count while GPS is
held to be wrong too; but then those before such doubts and those after must agree."""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Bools, Doubles
from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Position, Vehicle
from edgevpr.frames.level import Mount
from edgevpr.mavlink.receivers import extrapolate
from edgevpr.runtime.flight.measurements import FrameMeasurement, picture_error_m, position_match
from edgevpr.runtime.flight.navigation import rests_on_gps
from edgevpr.runtime.recognise.locate import mahalanobis
from edgevpr.runtime.recognise.recognition import Recognition

_EVERY_S = 5.0  # matches that are nearer in time count once
_MOST = 720  # the newest hour of matches
# An error of GPS lasts: the matches within this time have it in common, and say as much of it as one.
_GPS_LASTS_S = 180.0
_WORST_GPS_M = 5.0  # a receiver that says less of itself is not good enough to hold a map against
_OURS_S = 60.0  # so long after a fix of ours the autopilot's position may still be that, and the receiver's is taken
_LEVEL_SD_DEG = 0.3  # of a mount: what all pictures of a flight have in common
# Before the first match: the standard deviations of offset (2, metres), mount (2, tangents), scale, and of the time
# between frames and positions (s), which on a straight line does the same as a camera that looks ahead.
_BEFORE = np.diag(1 / np.square([1e4, 1e4, 0.5, 0.5, 0.02, 0.1]))
_FEWEST, _LEAST_ALIKE = 20, 0.7  # matches, and the share of them that must agree
_WRONG = 4.0  # standard deviations: matches that are off by more do not count
# Where some matches were taken while GPS was held to be wrong: the share of the others in each half of the flight, the
# standard deviation (m) by which a half must know the offset, and the standard deviations by which halves may differ.
_UNDOUBTED, _HALF_KNOWS_M, _HALVES_AGREE = 0.1, 2.0, 4.0
_NO_DOUBT_M = 12.0  # so near to GPS, as the camera is found to look, a match is no reason to doubt it
_SOFT_ROUNDS, _HARD_ROUNDS, _SOFT = 6, 3, 2.0
_RAYLEIGH = math.sqrt(2 * math.log(2))  # median length of a deviation on two axes, over its standard deviation


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A match `off_m` (2,) metres east and north of GPS, which is the product of `jacobian` (2, 6) and what is sought.
    The variance of each axis, m2, has a part `own_m2` and one that it shares with its neighbours in time, `shared_m2`,
    of which it says as much as one of `alike` matches. `is_doubted`: GPS was held to be wrong."""

    jacobian: Doubles
    off_m: Doubles
    own_m2: float
    shared_m2: float
    alike: float
    is_doubted: bool


@dataclass(frozen=True, slots=True)
class Measure:
    """A result with its standard deviation (of each axis). It `is_known` with one of at most `worst_sd`. Values that
    are nearer than `least` to each other count as the same."""

    value: tuple[float, ...]
    sd: float
    worst_sd: float
    least: float

    @property
    def is_known(self) -> bool:
        return self.sd <= self.worst_sd

    def differs_from(self, other: tuple[float, ...], times: float = 1.0) -> bool:
        """Tell whether it is known, and clearly another value: by so many `times` of the least that counts."""
        return self.is_known and math.dist(self.value, other) > max(times * self.least, 3 * self.sd)


@dataclass(frozen=True, slots=True, kw_only=True)
class Surveyed:
    """The result of so many `matches`. Its `measures` by name: `off_m`, the offset of the map from GPS (east, north) at
    the `middle` of the ground that they cover; `scale`, the share by which the map is too large, around there;
    `ahead_deg` and `right_deg`, by how much the camera looks ahead and to the right of straight down."""

    matches: int
    middle: Position
    measures: dict[str, Measure]

    def fields(self) -> dict[str, Any]:
        """Return this result as fields of the flight log; what is not known well enough is null."""
        fields: dict[str, Any] = {"matches": self.matches}
        fields["middle"] = {"lat_deg": round(self.middle.lat_deg, 7), "lon_deg": round(self.middle.lon_deg, 7)}
        for name, found in self.measures.items():
            value = [round(each, 4) for each in found.value]
            fields[name] = None if not found.is_known else value if name == "off_m" else value[0]
            fields[f"{name.partition('_')[0]}_sd"] = round(found.sd, 4) if found.is_known else None
        return fields


class Sightings:
    """Collects sightings. `mount` is where the camera is taken to look, by which its pictures are levelled. `is_level`:
    the camera hangs in a gimbal, whatever the airframe's attitude."""

    def __init__(self, mount: Mount, is_level: bool) -> None:
        self._mount, self._is_level = mount, is_level
        self._kept: deque[Sighting] = deque(maxlen=_MOST)
        self._origin: Position | None = None
        self._taken_s = -math.inf

    def take(self, event: Recognition, is_doubted: bool = False) -> bool:
        """Take an event for a sighting, if it can be one and the last was long enough ago; return True if it was. GPS
        `is_doubted` while it is held to be wrong."""
        vehicle, where, view = event.vehicle, event.located, event.view
        if event.frame is None or event.frame.t_mono_s - self._taken_s < _EVERY_S:
            return False
        if vehicle is None or vehicle.gps is None or vehicle.gps.sd_m > _WORST_GPS_M or not rests_on_gps(vehicle):
            return False
        # Without a view or a pose, the match may be metres beside the point that is taken to be under the camera.
        if view.reason or (view.aside is None and view.lean_m is None) or where is None or where.heading_deg is None:
            return False
        t_s, height_m = event.frame.t_mono_s, where.height_m or vehicle.height_m
        frame_sd_m = picture_error_m(vehicle, height_m or 0.0, event.frame.t_sd_s)
        seen = position_match(event, FrameMeasurement(t_s=t_s, sd_m=frame_sd_m))
        jacobian = self._derive(vehicle, height_m, seen.turn_deg or 0.0) if seen else None
        if seen is None or jacobian is None or not vehicle.is_fresh(t_s):
            return False
        at = Position(vehicle.lat_deg, vehicle.lon_deg)  # by the autopilot, which knows how late its receiver is
        if t_s - vehicle.t_fix_s <= _OURS_S:  # it may repeat us
            at = Position(*extrapolate(vehicle.gps, t_s, vehicle.velocity_m_s or (0.0, 0.0)))
        alike = max(1.0, _GPS_LASTS_S / min(t_s - self._taken_s, _GPS_LASTS_S))
        self._origin = self._origin or at
        jacobian[:, 4] = offset_m(self._origin.lat_deg, self._origin.lon_deg, at.lat_deg, at.lon_deg)
        off_m = np.array(offset_m(at.lat_deg, at.lon_deg, seen.position.lat_deg, seen.position.lon_deg))
        own_m2 = float(np.trace(seen.scatter_m2)) / 2 - where.tilt_m2  # a tilt is what is sought
        shared_m2 = vehicle.gps.sd_m**2
        self._kept.append(
            Sighting(
                jacobian=jacobian, off_m=off_m, own_m2=own_m2, shared_m2=shared_m2, alike=alike, is_doubted=is_doubted
            )
        )
        self._taken_s = t_s
        return True

    def set_mount(self, mount: Mount) -> None:
        """Note that the next pictures are levelled by another mount, and keep the sightings as if all had been."""
        by = _tangents(mount) - _tangents(self._mount)
        kept = [replace(each, off_m=each.off_m - each.jacobian[:, 2:4] @ by) for each in self._kept]
        self._mount, self._kept = mount, deque(kept, maxlen=_MOST)

    def _derive(self, vehicle: Vehicle, height_m: float | None, turn_deg: float) -> Doubles | None:
        """Return how offset, mount, scale and time move a match (2, 6), but for the scale; None if it is unknown. The
        mount turns with the picture, which is turned by `turn_deg` against a compass that is wrong."""
        roll_deg, pitch_deg = (0.0, 0.0) if self._is_level else (vehicle.roll_deg, vehicle.pitch_deg)
        known = vehicle.heading_deg, height_m, roll_deg, pitch_deg, *(vehicle.velocity_m_s or (None,))
        if not all(each is not None and math.isfinite(each) for each in known) or not height_m or height_m <= 0:
            return None
        heading, roll, pitch = (math.radians(each or 0.0) for each in (vehicle.heading_deg, roll_deg, pitch_deg))
        heading += math.radians(turn_deg)
        ahead_m, right_m = height_m * math.cos(roll), height_m * math.cos(pitch)  # an airframe that banks turns it too
        east, north = vehicle.velocity_m_s or (0.0, 0.0)
        return np.array(
            [
                [1, 0, ahead_m * math.sin(heading), right_m * math.cos(heading), 0, east],
                [0, 1, ahead_m * math.cos(heading), -right_m * math.sin(heading), 0, north],
            ]
        )

    def result(self) -> Surveyed | None:
        """Return what the sightings say; None if they are too few, or do not agree."""
        kept = list(self._kept)
        if len(kept) < _FEWEST or self._origin is None:
            return None
        way, covariance, counts = fit_sightings(kept)
        middle_m = np.mean([each.jacobian[:, 4] for each in kept], axis=0)
        there = np.eye(6)
        there[:2, 4] = middle_m
        if counts.mean() < _LEAST_ALIKE or not _explains_doubts(kept, counts, there, way[2:4]):
            return None
        way, covariance = there @ way, there @ covariance @ there.T
        sd = np.sqrt(np.diag(covariance))
        ahead_deg, right_deg = np.degrees(np.arctan(way[2:4] + _tangents(self._mount))).tolist()
        ahead_sd_deg, right_sd_deg = np.hypot(np.degrees(sd[2:4]), _LEVEL_SD_DEG).tolist()
        measures = {
            "off_m": Measure((float(way[0]), float(way[1])), float(max(sd[:2])), 1.0, 1.0),
            "scale": Measure((float(way[4]),), float(sd[4]), 0.003, 0.005),
            "ahead_deg": Measure((ahead_deg,), ahead_sd_deg, 1.5, 1.0),
            "right_deg": Measure((right_deg,), right_sd_deg, 1.5, 1.0),
        }
        middle = Position(*offset_position(self._origin.lat_deg, self._origin.lon_deg, *middle_m.tolist()))
        return Surveyed(matches=int(counts.sum()), middle=middle, measures=measures)


def fit_sightings(sightings: list[Sighting]) -> tuple[Doubles, Doubles, Bools]:
    """Fit sightings: return what is sought (6,), its covariance (6, 6), and bool (n,), False for those that are wrong.

    The first rounds let no sighting pull much harder than the others, the last leave out what is far off. Scatter that
    is larger than the matches claim makes the covariance larger.
    """
    jacobian = np.array([each.jacobian for each in sightings])
    off_m = np.array([each.off_m for each in sightings])
    own_m2, shared_m2, alike = np.array([(each.own_m2, each.shared_m2, each.alike) for each in sightings]).T
    counts, scatter = np.ones(len(sightings)), 1.0
    for nth in range(_SOFT_ROUNDS + _HARD_ROUNDS):
        weight = counts / (own_m2 + alike * shared_m2)
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian) + _BEFORE
        way = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weight, jacobian, off_m))
        miss = np.linalg.norm(off_m - jacobian @ way, axis=1) / np.sqrt(own_m2 + shared_m2)
        scatter = max(1.0, float(np.median(miss)) / _RAYLEIGH)
        if nth < _SOFT_ROUNDS:
            counts = np.minimum(1.0, _SOFT * scatter / np.maximum(miss, 1e-9))
        else:
            counts = (miss <= _WRONG * scatter).astype(float)
    covariance: Doubles = scatter**2 * np.linalg.inv(normal)
    return way, covariance, counts > 0


def _tangents(mount: Mount) -> Doubles:
    """Return by how much of its height a camera looks ahead and to the right (2,)."""
    tangents: Doubles = np.tan(np.radians((mount.ahead_deg, mount.right_deg)))
    return tangents


def _explains_doubts(sightings: list[Sighting], counts: Bools, there: Doubles, mount: Doubles) -> bool:
    """Tell whether a fit of sightings, of which it `counts` some (n,), leaves no reason to hold GPS for wrong. A
    receiver that is led away says something else before than after, and something else than what nobody doubted, or
    would if the camera were known to look beside straight down as the `mount` (2,) says. `there` (6, 6) takes what is
    sought to the middle of the ground."""
    doubted = np.array([each.is_doubted for each in sightings])
    if not doubted.any():
        return True
    left_m = np.array([each.off_m - each.jacobian[:, 2:4] @ mount for each in sightings])
    doubted &= np.linalg.norm(left_m, axis=1) > _NO_DOUBT_M
    halves = np.array_split(np.arange(len(sightings)), 2)
    if min(np.mean(~doubted[half]) for half in halves) < _UNDOUBTED or counts[~doubted].mean() < _LEAST_ALIKE:
        return False
    (one, of_one, _), (other, of_other, _) = (fit_sightings([sightings[at] for at in half]) for half in halves)
    worst_m2 = max(np.diag(there @ covariance @ there.T)[:2].max() for covariance in (of_one, of_other))
    off_sd = mahalanobis(there @ (one - other), there @ (of_one + of_other) @ there.T)
    return worst_m2 <= _HALF_KNOWS_M**2 and off_sd <= _HALVES_AGREE
