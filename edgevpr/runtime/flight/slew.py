"""A position that never jumps, for an autopilot that follows no jump."""

import math

from edgevpr.core.geodesy import moved, offset_m
from edgevpr.runtime.flight.navigation import Estimate

_FASTEST_M_S = 2.0  # ArduPilot did not follow a jump of 25 m for 8 s


class Slew:
    """Follows estimates at their own velocity, and catches up with them at 2 m/s at most."""

    def __init__(self) -> None:
        self._said: Estimate | None = None
        self._at = 0.0, 0.0

    def forget(self) -> None:
        """Begin anew with the next estimate."""
        self._said = None

    def followed(self, estimate: Estimate) -> tuple[float, float, float]:
        """Return latitude and longitude that follow an estimate, later than the one before, and by how many metres they
        lie behind it."""
        here = estimate.position
        if self._said is None:
            self._said, self._at = estimate, (here.lat_deg, here.lon_deg)
            return *self._at, 0.0
        step_s = max(0.0, estimate.t_s - self._said.t_s)
        east_m_s, north_m_s = estimate.velocity_m_s
        carried = moved(*self._at, step_s * east_m_s, step_s * north_m_s)
        east_m, north_m = offset_m(*carried, here.lat_deg, here.lon_deg)
        behind_m = math.hypot(east_m, north_m)
        part = min(1.0, _FASTEST_M_S * step_s / behind_m) if behind_m > 0 else 1.0
        self._said, self._at = estimate, moved(*carried, part * float(east_m), part * float(north_m))
        return *self._at, (1 - part) * behind_m
