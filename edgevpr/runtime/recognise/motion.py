"""Motion between two queries: what is known of it beforehand.

Odometry may stop, jump or be wrong by a factor of two. So it is never the only way in which the aircraft can have
moved: beside it stand going on as before, and anywhere within reach.
"""

import math
from dataclasses import dataclass

import numpy as np

_OF_LENGTH_SD = 0.15  # of the length of a displacement by odometry that can be believed

_LONGEST_S = 3600.0  # after which an aircraft may be anywhere


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Knowledge of how an aircraft has moved since the query before. `reach` is how far it can have moved, in the unit
    of the map (metres, or places), and `elapsed_s` the time it had. `by` (2,) is the displacement by odometry, with its
    `covariance` (2, 2); None: there is none."""

    reach: float
    elapsed_s: float
    by: np.ndarray | None = None
    covariance: np.ndarray | None = None


def moved(
    elapsed_s: float | None, usual_s: float, speed_max: float, velocity: tuple[float, float] | None = None
) -> Moved:
    """Return what is known of the motion in `elapsed_s` seconds (None: unknown), usually `usual_s`.

    `speed_max` is the highest speed, in units of the map a second, and `velocity` (east, north) that of odometry (None:
    unknown). A clock that has gone back, or stood still, says nothing of the time; then odometry says nothing of the
    way.
    """
    if elapsed_s is None or not elapsed_s > 0:
        return Moved(reach=speed_max * usual_s, elapsed_s=usual_s)
    elapsed_s = min(elapsed_s, _LONGEST_S)
    reach = speed_max * elapsed_s
    if velocity is None or not math.hypot(*velocity) <= 2 * speed_max:  # NaN, or too fast even if it is twice the truth
        return Moved(reach=reach, elapsed_s=elapsed_s)
    by = elapsed_s * np.asarray(velocity, float)
    return Moved(reach=reach, elapsed_s=elapsed_s, by=by, covariance=(_OF_LENGTH_SD**2 * by @ by) * np.eye(2))
