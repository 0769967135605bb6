"""The motion of a simulated vehicle: along a recorded track, at an unknown place, or where its autopilot's estimate
leads it. A point is (latitude, longitude) in degrees; a vector on the ground is one complex number, east + 1j * north.
"""

import cmath
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from edgevpr.core.arrays import LatLon
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_m, offset_position, wrap_deg
from edgevpr.core.types import Position
from edgevpr.frames.positions import read_positions

GRAVITY_M_S2 = 9.80665
_MAX_ACCELERATION_M_S2 = GRAVITY_M_S2 * math.tan(math.radians(30.0))
_MAX_CORRECTION_M_S = 5.0
_SPEED_GAIN_HZ = 0.5
_ACCELERATION_GAIN_HZ = 1.5
_ANGLES = ("roll_deg", "pitch_deg", "heading_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueState:
    """The true state of the vehicle: position in degrees, `alt_m` above sea level, `height_m` above the ground,
    velocity over the ground and climb rate upwards. Angles and height are NaN where unknown. On a track, `t_s` are the
    seconds from its start. `acceleration_m_s2` is horizontal; a recorded track has none."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    height_m: float = math.nan
    velocity_m_s: complex = 0j
    climb_m_s: float = 0.0
    roll_deg: float = math.nan
    pitch_deg: float = math.nan
    heading_deg: float = math.nan
    t_s: float = 0.0
    acceleration_m_s2: complex = 0j

    @property
    def point(self) -> LatLon:
        return self.lat_deg, self.lon_deg


FlownTrack = Sequence[TrueState]  # the path of a vehicle, in the order of time


class Motion:
    """A vehicle at an unknown place that obeys no command. `is_known`: its position is known, and reported;
    `obeys_estimate`: the errors of its autopilot's estimate move it."""

    is_known = False
    obeys_estimate = False

    def begin(self, now_s: float) -> None:
        """Start the track, if there is one: an onboard computer in flight was heard."""

    def steer(self, error_m: complex, velocity_error_m_s: complex, tilt: complex, turn: complex) -> None:
        """Steer by an estimate with these errors (see `Estimator`), and a heading wrong by `turn`, if it is obeyed."""

    def step(self, now_s: float, dt_s: float) -> TrueState:
        """Move for `dt_s` seconds, up to `now_s`, and return the state then."""
        return TrueState(lat_deg=0.0, lon_deg=0.0, alt_m=0.0)


class Hover(Motion):
    """A vehicle in the air that holds its *estimated* position at a target, by the tilt that its *estimated* attitude
    shows. The target is `home` or moves from there with a velocity. `away_m` is the true distance from the target."""

    is_known = True
    obeys_estimate = True

    def __init__(self, home: Position, height_m: float, velocity_m_s: complex = 0j) -> None:
        self._home, self._height_m, self._cruise_m_s = home, height_m, velocity_m_s
        self._target_m = self._offset_m = self._acceleration_m_s2 = 0j
        self._velocity_m_s = velocity_m_s
        self._heading_deg = 90 - math.degrees(cmath.phase(velocity_m_s)) if velocity_m_s else 0.0

    @property
    def away_m(self) -> float:
        return abs(self._offset_m - self._target_m)

    def cruise(self, velocity_m_s: complex) -> None:
        """Move the target by another velocity from now on; the heading stays."""
        self._cruise_m_s = velocity_m_s

    def steer(self, error_m: complex, velocity_error_m_s: complex, tilt: complex, turn: complex) -> None:
        to_target_m = self._target_m - (self._offset_m + error_m)
        wanted_m_s = self._cruise_m_s + _limit(_SPEED_GAIN_HZ * to_target_m, _MAX_CORRECTION_M_S)
        missing_m_s = wanted_m_s - (self._velocity_m_s + velocity_error_m_s)
        self._acceleration_m_s2 = turn * _limit(_ACCELERATION_GAIN_HZ * missing_m_s, _MAX_ACCELERATION_M_S2)
        self._acceleration_m_s2 -= GRAVITY_M_S2 * tilt

    def step(self, now_s: float, dt_s: float) -> TrueState:
        self._target_m += self._cruise_m_s * dt_s
        self._offset_m += self._velocity_m_s * dt_s + self._acceleration_m_s2 * dt_s**2 / 2
        self._velocity_m_s += self._acceleration_m_s2 * dt_s
        lat_deg, lon_deg = displace((self._home.lat_deg, self._home.lon_deg), self._offset_m)
        roll_deg, pitch_deg = compute_tilt(self._acceleration_m_s2, self._heading_deg)
        return TrueState(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=(self._home.alt_m or 0.0) + self._height_m,
            height_m=self._height_m,
            velocity_m_s=self._velocity_m_s,
            acceleration_m_s2=self._acceleration_m_s2,
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
            heading_deg=self._heading_deg,
            t_s=now_s,
        )


class AlongTrack(Motion):
    """A vehicle that flies along a track once an onboard computer is heard. It stays at the end and obeys nothing."""

    is_known = True

    def __init__(self, track: FlownTrack) -> None:
        self._track = track
        self._start_s = math.inf

    def begin(self, now_s: float) -> None:
        self._start_s = min(self._start_s, now_s)

    def step(self, now_s: float, dt_s: float) -> TrueState:
        return interpolate_track(self._track, max(0.0, now_s - self._start_s))


def read_track(csv_path: str | Path) -> list[TrueState]:
    """Read the rows of a positions.csv with position and time, sorted by time. Without roll and pitch the vehicle flies
    level, without a heading along its way. Raises UsageError if there are no such rows."""
    rows = [
        (tag.t_utc_s, tag.position, tag)
        for tag in read_positions(csv_path).values()
        if tag.position and tag.t_utc_s is not None
    ]
    if not rows:
        raise UsageError(f"{csv_path} has no row with lat, lon and time: a track needs them.")
    rows.sort(key=lambda row: row[0])
    points = [(position.lat_deg, position.lon_deg) for _, position, _ in rows]
    track, course_deg = [], math.nan
    for (t_s, position, tag), (here, ahead) in zip(rows, pairwise([*points, points[-1]]), strict=True):
        if way_m := displacement_m(here, ahead):
            course_deg = math.degrees(math.atan2(way_m.real, way_m.imag)) % 360
        state = TrueState(
            lat_deg=position.lat_deg,
            lon_deg=position.lon_deg,
            alt_m=position.alt_m or 0.0,
            height_m=math.nan if tag.height_m is None else tag.height_m,
            roll_deg=tag.roll_deg or 0.0,
            pitch_deg=tag.pitch_deg or 0.0,
            heading_deg=course_deg if tag.heading_deg is None else tag.heading_deg,
            t_s=t_s - rows[0][0],
        )
        track.append(state)
    return track


def interpolate_track(track: FlownTrack, t_s: float) -> TrueState:
    """Return the state on a track at `t_s` seconds from its start. Before and after it, the vehicle stands still."""
    leg = bisect_right(track, t_s, key=lambda state: state.t_s)  # it ends at the point of this index
    passed = track[max(0, leg - 1)]
    if not 0 < leg < len(track):
        return passed
    ahead = track[leg]
    share = (t_s - passed.t_s) / (ahead.t_s - passed.t_s)
    values = {}
    for name in ("lat_deg", "lon_deg", "alt_m", "height_m", "roll_deg", "pitch_deg", "heading_deg"):
        change = getattr(ahead, name) - getattr(passed, name)
        if not math.isnan(change):
            values[name] = getattr(passed, name) + share * (wrap_deg(change) if name in _ANGLES else change)
    velocity_m_s = displacement_m(passed.point, ahead.point) / (ahead.t_s - passed.t_s)
    return replace(passed, **values, velocity_m_s=velocity_m_s, t_s=t_s)


def compute_tilt(acceleration_m_s2: complex, heading_deg: float) -> tuple[float, float]:
    """Return the roll and pitch in degrees of a vehicle that only thrusts along its vertical axis, and accelerates
    horizontally by this much at constant height."""
    ahead = acceleration_m_s2 * cmath.rect(1.0, math.radians(heading_deg))  # 1j * forward + right
    thrust_m_s2 = math.hypot(GRAVITY_M_S2, abs(acceleration_m_s2))
    roll = math.asin(ahead.real / thrust_m_s2)
    return math.degrees(roll), -math.degrees(math.atan2(ahead.imag, GRAVITY_M_S2))


def displacement_m(point: LatLon, other: LatLon) -> complex:
    """Return the vector from one point to another, metres."""
    east_m, north_m = offset_m(*point, *other)
    return complex(float(east_m), float(north_m))


def displace(point: LatLon, vector_m: complex) -> LatLon:
    """Return the point that lies `vector_m` metres from another: the inverse of `displacement_m`."""
    return offset_position(*point, vector_m.real, vector_m.imag) if vector_m else point


def _limit(value: complex, most: float) -> complex:
    return value * min(1.0, most / max(abs(value), 1e-9))
