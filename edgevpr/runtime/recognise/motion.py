"""The motion of the aircraft between two queries, as the belief (see `belief`) takes it."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles

FASTEST_M_S = 30.0  # unless the configuration says another speed
_LONGEST_S = 3600.0  # longest time that counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Motion of the aircraft since the previous query, in metres or places: `reach` is how far it can have moved in
    `elapsed_s` seconds, and `by` (2,) its displacement by odometry (None: unknown), which `is_seen` by the camera
    itself or told by the autopilot."""

    reach: float
    elapsed_s: float
    by: Doubles | None = None
    is_seen: bool = False

    def to_fresh_ground(self, spacing: float) -> float:
        """Return which share of the ground in the picture is new, as far as that is seen: 0 to 1."""
        return min(1.0, float(np.hypot(*self.by)) / spacing) if self.is_seen and self.by is not None else 1.0


def moved(
    elapsed_s: float | None, speed_max: float, velocity: tuple[float, float] | None = None, is_seen: bool = False
) -> Moved:
    """Return the motion in `elapsed_s` seconds, one second if they are unknown (None) or the clock was set back.
    `speed_max` is the highest speed, in units of the map a second, and `velocity` (east, north) that of odometry (None:
    unknown), which is not used without a time or if it is too high to be true; for `is_seen` see `Moved`."""
    if elapsed_s is None or not elapsed_s > 0:
        return Moved(reach=speed_max, elapsed_s=1.0)
    elapsed_s, by = min(elapsed_s, _LONGEST_S), None
    if velocity is not None and math.hypot(*velocity) <= 2 * speed_max:  # no NaN, and possible if twice the truth
        by = elapsed_s * np.asarray(velocity, float)
    return Moved(reach=speed_max * elapsed_s, elapsed_s=elapsed_s, by=by, is_seen=is_seen)
