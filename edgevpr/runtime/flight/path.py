"""The path of an aircraft, which is its velocities or accelerations summed up, and the filter of the path's errors.
`navigation` uses both.

A path starts at a known position and drifts from it. It never jumps, so that offsets from it can be compared at any two
times; the position that an autopilot reports jumps whenever it is corrected.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Position

GRAVITY_M_S2 = 9.80665
KEPT_S = 6.0  # a frame is at most 5 s old when it is recognised
# So long an error of the attitude of an autopilot that reckons lasts. Nothing but pictures shows it, and not all do: if
# it wandered without end, every fix would be taken for a proof of it.
_ATTITUDE_LASTS_S = 20.0
# The error of the attitude wanders up to five times as fast as that of good gyros, as in PX4's simulator. Of the last
# twenty pictures: the mean square of the leans that they show, over their variances, is .2 in flights of ArduPilot's
# simulator and 1.3 in those of PX4's.
_ROUGHEST, _SHOWN_GAIN = 4.0, 0.05
_CALM, _ROUGH = 0.3, 0.8
_LONGEST_STEP_S = 1.0  # after a longer gap in the reports the path is not known

_C, _S, _B, _M = (slice(first, first + 2) for first in (0, 2, 4, 6))
_EYE = np.eye(2)


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a path: `t_s`, time in seconds; `at_m` (2,), metres east and north of the path's origin;
    `velocity_m_s` (2,), m/s east and north."""

    t_s: float
    at_m: Doubles
    velocity_m_s: Doubles


class Path:
    """The points of the last seconds of a path that began at `origin` with a velocity (2,); the last one is `now`.
    `is_broken`: there was a gap of over a second between two points."""

    def __init__(self, origin: Position, t_s: float, velocity_m_s: Doubles) -> None:
        self.origin, self.is_broken = origin, False
        self._points = [Point(t_s, np.zeros(2), np.asarray(velocity_m_s, float))]

    @property
    def now(self) -> Point:
        """The newest point."""
        return self._points[-1]

    def from_origin(self, lat_deg: float, lon_deg: float) -> Doubles:
        """Return the metres (2,), east and north, from the origin to a position."""
        return np.array(offset_m(self.origin.lat_deg, self.origin.lon_deg, lat_deg, lon_deg))

    def fly(self, t_s: float, velocity_m_s: Doubles) -> float:
        """Add a point at `t_s` with this velocity (2,), and return the seconds since the last point. If `t_s` is not
        later than that, nothing is added, and 0 returned."""
        last = self._points[-1]
        step_s = t_s - last.t_s
        if not step_s > 0:
            return 0.0
        self.is_broken |= step_s > _LONGEST_STEP_S
        velocity_m_s = np.asarray(velocity_m_s, float)
        at_m = last.at_m + step_s / 2 * (last.velocity_m_s + velocity_m_s)
        self._points.append(Point(t_s, at_m, velocity_m_s))
        if self._points[0].t_s < t_s - 2 * KEPT_S:  # rarely, since this moves all points
            del self._points[: bisect_left(self._points, t_s - KEPT_S, key=lambda point: point.t_s)]
        return step_s

    def accelerate(self, t_s: float, acceleration_m_s2: Doubles) -> float:
        """Add a point, as `fly` does, that is reached with this mean acceleration (2,) over the ground."""
        last = self._points[-1]
        return self.fly(t_s, last.velocity_m_s + max(0.0, t_s - last.t_s) * np.asarray(acceleration_m_s2, float))

    def at(self, t_s: float) -> Point | None:
        """Return the point at `t_s`; after the last point, its velocity is continued. None if `t_s` is before the first
        point kept or more than a second after the last."""
        if not self._points[0].t_s <= t_s <= self._points[-1].t_s + _LONGEST_STEP_S:
            return None
        after = bisect_left(self._points, t_s, key=lambda point: point.t_s)
        if after == len(self._points):
            last = self._points[-1]
            return Point(t_s, last.at_m + (t_s - last.t_s) * last.velocity_m_s, last.velocity_m_s)
        if after == 0:
            return self._points[0]
        one, other = self._points[after - 1], self._points[after]
        step_s = other.t_s - one.t_s
        share = (t_s - one.t_s) / step_s
        velocity_m_s = one.velocity_m_s + share * (other.velocity_m_s - one.velocity_m_s)
        at_m = one.at_m + share * step_s / 2 * (one.velocity_m_s + velocity_m_s)
        return Point(t_s, at_m, velocity_m_s)


def over_ground(force_m_s2: tuple[float, float, float], roll_deg: float, pitch_deg: float, yaw_deg: float) -> Doubles:
    """Return the acceleration over the ground (2,), east and north, from the specific force that accelerometers measure
    (nose, right, down) at an attitude. Gravity, being vertical, has no part in it."""
    roll, pitch, yaw = map(math.radians, (roll_deg, pitch_deg, yaw_deg))
    ahead, right, down = force_m_s2
    low = right * math.sin(roll) + down * math.cos(roll)
    forward = ahead * math.cos(pitch) + low * math.sin(pitch)
    sideways = right * math.cos(roll) - down * math.sin(roll)
    east = forward * math.sin(yaw) + sideways * math.cos(yaw)
    north = forward * math.cos(yaw) - sideways * math.sin(yaw)
    return np.array([east, north])


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Size of the errors of a path. `velocity_sd` (m/s) and `acceleration_sd` (m/s2) are the standard deviations, of
    one axis, for a path that nothing corrects. `position_noise` (m), `velocity_noise` (m/s) and `acceleration_noise`
    (m/s2) are the standard deviations of the random change of the error of position, velocity and acceleration in one
    second."""

    velocity_sd: float
    acceleration_sd: float
    position_noise: float
    velocity_noise: float
    acceleration_noise: float
    is_of_attitude: bool  # the path rests on the attitude, so that an error of it is one of the path's acceleration


# Dead reckoning by an autopilot: nearly all of the error is wind that it does not know. In simulation, an ArduPilot
# plane in a wind of 6 m/s was 5 m/s wrong 10 s after the loss of GPS, and up to 7.5 m/s later.
RECKONED = Drift(
    velocity_sd=4.0, acceleration_sd=0.1, position_noise=0.3, velocity_noise=0.5, acceleration_noise=0.03,
    is_of_attitude=False,
)  # fmt: skip
# Accelerations, rotated into east and north by the autopilot's attitude: an error of half a degree is 0.09 m/s2.
INERTIAL = Drift(
    velocity_sd=0.5, acceleration_sd=0.1, position_noise=0.05, velocity_noise=0.1, acceleration_noise=0.02,
    is_of_attitude=True,
)  # fmt: skip


class DriftFilter:
    """Kalman filter that estimates the errors of one path. `drift` is the size of these errors, `map_sd_m` the standard
    deviation, of one axis, of the error that all fixes share.

    The state has four parts, each east and north: `c` (m), the offset from the path to the aircraft; `s` (m/s), by how
    much the aircraft is faster than the path; `b` (m/s2), the part of gravity that an error of the attitude takes for
    acceleration, the other way round, which for a path of accelerations is the rate of change of `s`; and `m` (m), the
    offset from GPS positions to fixes. A fix may be of a frame taken seconds ago: it is compared with the path at that
    time.
    """

    def __init__(self, drift: Drift, map_sd_m: float) -> None:
        self._drift, self._map_sd_m = drift, map_sd_m
        self._x, self._p = np.zeros(8), np.zeros((8, 8))
        self._shown = 0.0  # mean square of the leans of the last pictures, over their variances

    def start(self, sd_m: float, velocity_sd_m_s: float) -> None:
        """Begin with the aircraft on the path. `sd_m` and `velocity_sd_m_s` are the standard deviations, of one axis,
        of its offset and of the error of velocity."""
        self._x = np.zeros(8)
        of_parts = sd_m, velocity_sd_m_s, self._drift.acceleration_sd, self._map_sd_m
        self._p = np.diag(np.repeat(np.square(of_parts), 2))

    def go_on(self, step_s: float) -> None:
        """Predict the state `step_s` seconds later."""
        move = np.eye(8)
        move[_C, _S] = step_s * _EYE
        if self._drift.is_of_attitude:
            move[_C, _B] = step_s**2 / 2 * _EYE
            move[_S, _B] = step_s * _EYE
        else:
            move[_B, _B] = math.exp(-step_s / _ATTITUDE_LASTS_S) * _EYE
        drift = self._drift
        wander = drift.acceleration_noise * (1.0 + _ROUGHEST * self._roughness)
        noise = drift.position_noise, drift.velocity_noise, wander, 0.0
        self._x = move @ self._x
        self._p = move @ self._p @ move.T + step_s * np.diag(np.repeat(np.square(noise), 2))

    @property
    def _roughness(self) -> float:
        """Poorness of the gyros, 0 to 1, by the leans that pictures have shown."""
        share = (self._shown - _CALM) / (_ROUGH - _CALM)
        return min(1.0, max(0.0, share)) if self._drift.is_of_attitude else 0.0

    def lose_gps(self) -> None:
        """Note that GPS is lost: the error of velocity becomes more uncertain, since nothing corrects it any more."""
        self._p[_S, _S] += self._drift.velocity_sd**2 * _EYE

    def hear_gps(self, off_m: Doubles, sd_m: float, off_m_s: Doubles, velocity_sd_m_s: float) -> None:
        """Correct the state by GPS, whose position is `off_m` (2,) metres beside the path and whose velocity exceeds
        that of the path by `off_m_s` (2,). The standard deviations are those of one axis."""
        look = np.zeros((4, 8))
        look[:2, _C] = look[2:, _S] = _EYE
        self._correct(look, np.concatenate([off_m, off_m_s]), np.diag([sd_m**2] * 2 + [velocity_sd_m_s**2] * 2))

    def hear_fix(self, off_m: Doubles, covariance_m2: Doubles, age_s: float, lean_s2: float) -> None:
        """Correct the state by a fix of covariance (2, 2) that lay `off_m` (2,) metres from the path `age_s` ago. See
        `_seen` for `lean_s2`."""
        self._correct(self._seen(age_s, lean_s2), off_m, covariance_m2)

    def hear_lean(self, over_height: Doubles, sd: float) -> None:
        """Correct the state by the error of the attitude that a picture shows (see `recognise.perspective`). Where
        pictures show more than they may be wrong by, the gyros are poor and the error wanders faster."""
        shown = float(np.mean(np.square(over_height))) / sd**2
        self._shown += _SHOWN_GAIN * (shown - self._shown)
        look = np.zeros((2, 8))
        look[:, _B] = _EYE / GRAVITY_M_S2
        self._correct(look, over_height, sd**2 * _EYE)

    def trust_fix(self, off_m: Doubles, covariance_m2: Doubles, age_s: float, lean_s2: float) -> None:
        """Correct the state by a fix that contradicts it: what was known of the position is forgotten."""
        self._p[_C] = self._p[:, _C] = 0.0
        self._p[_C, _C] = 1e6 * _EYE
        self._p[_S, _S] += self._drift.velocity_sd**2 * _EYE
        self.hear_fix(off_m, covariance_m2, age_s, lean_s2)

    def expected_fix(self, age_s: float, lean_s2: float) -> tuple[Doubles, Doubles]:
        """Predict a fix of a frame taken `age_s` seconds ago. Returns its offset (2,) from the path, metres, and the
        covariance (2, 2) of this prediction, without that of the fix itself. See `_seen` for `lean_s2`."""
        look = self._seen(age_s, lean_s2)
        return look @ self._x, look @ self._p @ look.T

    def errors(self, age_s: float) -> tuple[Doubles, Doubles, Doubles]:
        """Return the errors of the path `age_s` seconds ago (negative: in the future):
        - offset (2,) from the path to the aircraft, metres
        - error of velocity (2,), m/s
        - covariance (4, 4) of both.
        """
        look = np.zeros((4, 8))
        look[:2] = self._seen(age_s)
        look[:2, _M] = 0.0
        look[2:, _S], look[2:, _B] = _EYE, -age_s * self._drift.is_of_attitude * _EYE
        off = look @ self._x
        return off[:2], off[2:], look @ self._p @ look.T

    def _correct(self, look: Doubles, seen: Doubles, covariance: Doubles) -> None:
        """Do a Kalman update with the measurement matrix `look` (n, 8) and what was `seen` (n,)."""
        gain = np.linalg.solve(look @ self._p @ look.T + covariance, look @ self._p).T
        self._x = self._x + gain @ (seen - look @ self._x)
        kept = np.eye(8) - gain @ look
        self._p = kept @ self._p @ kept.T + gain @ covariance @ gain.T  # Joseph form: keeps it positive semidefinite

    def _seen(self, age_s: float, lean_s2: float = 0.0) -> Doubles:
        """Return the measurement matrix (2, 8) of a fix of a frame taken `age_s` seconds ago.

        `lean_s2` is the height above the ground over gravity (0: the fix rests on no attitude). An error of the
        autopilot's attitude moves the point that is taken to be under the aircraft: by the height over gravity times
        the part of gravity that it turns into acceleration over the ground, which `b` makes up for, and the other way.
        """
        by_acceleration = age_s**2 / 2 * self._drift.is_of_attitude - lean_s2
        return np.hstack([_EYE, -age_s * _EYE, by_acceleration * _EYE, _EYE])
