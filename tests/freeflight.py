"""A vehicle that starts on the ground and does what it is told: hovers, circles, drives, lands. Plain kinematics: what
matters here is where it is, not how its motors feel."""

import cmath
import math

from edgevpr.core.geodesy import moved
from edgevpr.core.types import Position
from edgevpr.lab.simulate.motion import Motion, TrueState

GRAVITY_M_S2 = 9.81
AIRSPEED_M_S = 22.0  # of a plane
CIRCLE_M = 80.0  # radius, where a plane waits
_CLIMB_M_S = {"copter": 3.0, "plane": 4.0, "rover": 0.0}
_DESCENT_M_S = 0.5
_COMMAND_GOOD_FOR_S = 3.0  # a copter that is told no velocity any more stops
_CRUISE_DEG = 90.0  # the nose at the start


class FreeFlight(Motion):
    """A copter, plane or rover that begins at `home`, on the ground."""

    is_known = True

    def __init__(self, kind: str, home: Position) -> None:
        self._kind, self._home = kind, home
        self._at_m, self._height_m, self._goal_m = 0j, 0.0, 0.0
        self._heading_deg = _CRUISE_DEG
        self._told: tuple[complex, float] = 0j, -math.inf
        self._lands = False

    @property
    def is_flying(self) -> bool:
        """True from take-off to landing; for a rover since it was first told to drive."""
        if self._kind == "rover":
            return self._told[1] > -math.inf
        return self._goal_m > 0 or self._height_m > 0

    def begin(self, now_s: float) -> None:
        """Do nothing: it moves when it is told to."""

    def take_off(self, height_m: float) -> None:
        """Climb to a height over home."""
        self._goal_m, self._lands = height_m, False

    def fly(self, velocity_m_s: complex, now_s: float) -> None:
        """Fly so for three seconds; a plane does not obey."""
        self._told = velocity_m_s, now_s

    def land(self) -> None:
        """Sink where it is, whatever it is told."""
        self._lands, self._goal_m = True, 0.0

    def step(self, now_s: float, dt_s: float) -> TrueState:
        """Move on by `dt_s`."""
        most_m = (_DESCENT_M_S if self._lands else _CLIMB_M_S[self._kind]) * dt_s
        climb_m = max(-most_m, min(most_m, self._goal_m - self._height_m))
        self._height_m += climb_m
        roll_deg = 0.0
        if self._kind == "plane":
            velocity, roll_deg = self._circled(dt_s)
        else:
            velocity, told_s = self._told
            if not self.is_flying or self._lands or now_s - told_s > _COMMAND_GOOD_FOR_S:
                velocity = 0j
        self._at_m += velocity * dt_s
        lat_deg, lon_deg = moved(self._home.lat_deg, self._home.lon_deg, self._at_m.real, self._at_m.imag)
        return TrueState(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=(self._home.alt_m or 0.0) + self._height_m,
            height_m=self._height_m,
            velocity_m_s=velocity,
            climb_m_s=climb_m / dt_s if dt_s else 0.0,
            roll_deg=roll_deg,
            pitch_deg=0.0,
            heading_deg=self._heading_deg,
        )

    def _circled(self, dt_s: float) -> tuple[complex, float]:
        """Fly straight until the height is reached, then circle to the right; return velocity and bank."""
        if not self.is_flying:
            return 0j, 0.0
        roll_deg = 0.0
        if self._height_m >= self._goal_m - 1:
            self._heading_deg = (self._heading_deg + math.degrees(AIRSPEED_M_S / CIRCLE_M * dt_s)) % 360
            roll_deg = math.degrees(math.atan(AIRSPEED_M_S**2 / (CIRCLE_M * GRAVITY_M_S2)))
        return cmath.rect(AIRSPEED_M_S, math.radians(90 - self._heading_deg)), roll_deg
