"""Motion between two queries: what is known of it beforehand, as a mixture of Gaussian displacements.

Odometry may stop, jump or be wrong by a factor of two. So it is never the only way in which the aircraft can have
moved: beside it stand going on as before, and anywhere within reach.
"""

import math
from dataclasses import dataclass

import numpy as np

_OF_LENGTH_SD = 0.15  # of the length of a displacement by odometry that can be believed
_LEAST_REACH = 1.0  # spacings of the map


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Knowledge of how an aircraft has moved since the query before. `reach` is how far it can have moved, in the unit
    of the map (metres, or places). `elapsed_s` is the time since then (1.0 where it is unknown), by which a velocity
    goes on. `by` (2,) is the displacement by odometry, with `covariance` (2, 2); None: there is none."""

    reach: float
    elapsed_s: float = 1.0
    by: np.ndarray | None = None
    covariance: np.ndarray | None = None


def moved(
    elapsed_s: float | None, speed_max: float, usual_reach: float, velocity: tuple[float, float] | None = None
) -> Moved:
    """Return what is known of the motion in `elapsed_s` seconds (None: unknown).

    `speed_max` is the highest speed, in units of the map a second, and `velocity` (east, north) that of odometry (None:
    unknown). A clock that has gone back or stood still says nothing of the time: the aircraft is then within
    `usual_reach` of where it was.
    """
    if elapsed_s is None or not (math.isfinite(elapsed_s) and elapsed_s > 0 and math.isfinite(speed_max * elapsed_s)):
        return Moved(reach=usual_reach)
    reach = speed_max * elapsed_s
    if velocity is None or not all(map(math.isfinite, velocity)):
        return Moved(reach=reach, elapsed_s=elapsed_s)
    by = elapsed_s * np.asarray(velocity, float)
    length = math.hypot(*by)
    if not length <= 2 * reach:  # faster than it can fly, even where the speed is wrong by a factor of two
        return Moved(reach=reach, elapsed_s=elapsed_s)
    return Moved(reach=reach, elapsed_s=elapsed_s, by=by, covariance=(_OF_LENGTH_SD * length) ** 2 * np.eye(2))
