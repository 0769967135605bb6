"""The path of an aircraft: its velocities or accelerations integrated from a known position. It never jumps, so
offsets from it at different times can be compared; the position that an autopilot reports jumps at each correction."""

import math
from bisect import bisect_left
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Position

HISTORY_S = 6.0  # a frame is at most 5 s old when it is recognised
_MAX_STEP_S = 1.0  # after a longer gap in the reports the path is unknown

_get_time_s = attrgetter("t_s")


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a path: `t_s`, time in seconds; `position_m` (2,), metres east and north of the path's origin;
    `velocity_m_s` (2,), m/s east and north."""

    t_s: float
    position_m: Doubles
    velocity_m_s: Doubles


class Path:
    """The points of the last seconds of a path that began at `origin` with a velocity (2,); `now` is the newest.
    `is_broken`: there was a gap of over a second between two points."""

    def __init__(self, origin: Position, t_s: float, velocity_m_s: Doubles) -> None:
        self.origin, self.is_broken = origin, False
        self._points = [Point(t_s, np.zeros(2), np.asarray(velocity_m_s, float))]

    @property
    def now(self) -> Point:
        """The newest point."""
        return self._points[-1]

    def compute_offset_m(self, lat_deg: float, lon_deg: float) -> Doubles:
        """Return the offset (2,) of a position from the origin, metres east and north."""
        return np.array(offset_m(self.origin.lat_deg, self.origin.lon_deg, lat_deg, lon_deg))

    def add_velocity(self, t_s: float, velocity_m_s: Doubles) -> float:
        """Add a point at `t_s` with this velocity (2,), and return the seconds since the last point. If `t_s` is not
        later than the last point, add nothing and return 0."""
        last = self._points[-1]
        step_s = t_s - last.t_s
        if not step_s > 0:
            return 0.0
        self.is_broken |= step_s > _MAX_STEP_S
        velocity_m_s = np.asarray(velocity_m_s, float)
        position_m = last.position_m + step_s / 2 * (last.velocity_m_s + velocity_m_s)
        self._points.append(Point(t_s, position_m, velocity_m_s))
        if self._points[0].t_s < t_s - 2 * HISTORY_S:  # rarely, since this moves all points
            del self._points[: bisect_left(self._points, t_s - HISTORY_S, key=_get_time_s)]
        return step_s

    def add_acceleration(self, t_s: float, acceleration_m_s2: Doubles) -> float:
        """Add a point like `add_velocity`, given the mean acceleration (2,) over the ground since the last point."""
        last = self._points[-1]
        step_s = max(0.0, t_s - last.t_s)
        return self.add_velocity(t_s, last.velocity_m_s + step_s * np.asarray(acceleration_m_s2, float))

    def restart(self, origin: Position, t_s: float) -> "Path | None":
        """Return the path from `t_s` on as if it had begun there at `origin`, at rest; None if it is unknown then."""
        start = self.interpolate(t_s)
        if start is None:
            return None
        path = Path(origin, t_s, np.zeros(2))
        for point in self._points[bisect_left(self._points, t_s, key=_get_time_s) :]:
            path.add_velocity(point.t_s, point.velocity_m_s - start.velocity_m_s)
        return path

    def interpolate(self, t_s: float) -> Point | None:
        """Return the point at `t_s`, extrapolated with the last velocity. None if `t_s` is before the first
        stored point or more than a second after the last."""
        if not self._points[0].t_s <= t_s <= self._points[-1].t_s + _MAX_STEP_S:
            return None
        after = bisect_left(self._points, t_s, key=_get_time_s)
        if after == len(self._points):
            last = self._points[-1]
            return Point(t_s, last.position_m + (t_s - last.t_s) * last.velocity_m_s, last.velocity_m_s)
        if after == 0:
            return self._points[0]
        start, end = self._points[after - 1], self._points[after]
        step_s = end.t_s - start.t_s
        fraction = (t_s - start.t_s) / step_s
        velocity_m_s = start.velocity_m_s + fraction * (end.velocity_m_s - start.velocity_m_s)
        position_m = start.position_m + fraction * step_s / 2 * (start.velocity_m_s + velocity_m_s)
        return Point(t_s, position_m, velocity_m_s)


def to_ground_acceleration(
    force_m_s2: tuple[float, float, float], roll_deg: float, pitch_deg: float, yaw_deg: float
) -> Doubles:
    """Return the acceleration over the ground (2,), east and north, from the specific force that accelerometers measure
    (forward, right, down) at an attitude. Gravity is vertical and does not contribute."""
    roll, pitch, yaw = map(math.radians, (roll_deg, pitch_deg, yaw_deg))
    ahead, right, down = force_m_s2
    low = right * math.sin(roll) + down * math.cos(roll)
    forward = ahead * math.cos(pitch) + low * math.sin(pitch)
    sideways = right * math.cos(roll) - down * math.sin(roll)
    east = forward * math.sin(yaw) + sideways * math.cos(yaw)
    north = forward * math.cos(yaw) - sideways * math.sin(yaw)
    return np.array([east, north])
