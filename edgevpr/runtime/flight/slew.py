"""The position that a continuous channel sends: it follows the estimate without jumps. The `navigator` uses it."""

import math

from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.runtime.flight.navigation import NavState

MAX_CORRECTION_M_S = 2.0  # ArduPilot did not follow a jump of 25 m for 8 s
# At a larger lag the position jumps. The autopilot's filter rejects the jump for seven to ten seconds, then resets to
# it: sooner than the slew would remove the lag, and nothing far from the estimate is sent meanwhile.
MAX_LAG_M = 40.0


class Slew:
    """A position that does not jump: it moves with the velocity of the estimates and approaches them at 2 m/s at most.
    It restarts at the estimate if it is more than 40 m away."""

    def __init__(self) -> None:
        self._last: NavState | None = None
        self._position_deg = 0.0, 0.0

    def reset(self) -> None:
        """Restart at the next estimate."""
        self._last = None

    def follow(self, estimate: NavState) -> tuple[float, float, float]:
        """Move towards an estimate that is later than the last one. Returns latitude and longitude in degrees, and the
        remaining distance to the estimate in metres."""
        target = estimate.position
        if self._last is None:
            self._last, self._position_deg = estimate, (target.lat_deg, target.lon_deg)
            return *self._position_deg, 0.0
        step_s = max(0.0, estimate.t_s - self._last.t_s)
        east_m_s, north_m_s = estimate.velocity_m_s
        predicted_deg = offset_position(*self._position_deg, step_s * east_m_s, step_s * north_m_s)
        east_m, north_m = offset_m(*predicted_deg, target.lat_deg, target.lon_deg)
        lag_m = math.hypot(east_m, north_m)
        if lag_m > MAX_LAG_M:
            self.reset()
            return self.follow(estimate)
        gain = min(1.0, MAX_CORRECTION_M_S * step_s / lag_m) if lag_m > 0 else 1.0
        self._last = estimate
        self._position_deg = offset_position(*predicted_deg, gain * float(east_m), gain * float(north_m))
        return *self._position_deg, (1 - gain) * lag_m
