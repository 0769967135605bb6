"""Estimates how much the height of the ground varies, which shifts positions from tilted images."""

import math

from edgevpr.frames.level import MAX_TILT_UNLEVELLED_DEG, View

# Relative standard deviation of the height, before matches show it. Chosen on the data set tilt_ariel, as was the
# factor: the errors of its positions exceed the variation of its heights by that factor.
UNKNOWN_HEIGHT_SD = 0.13
_SCATTER_FACTOR = 1.5
_UNKNOWN_WEIGHT = 3.0  # weight of UNKNOWN_HEIGHT_SD, in matches
_DECAY = 0.98  # of the weight of earlier matches: the ground changes along the flight
_MIN_TANGENT = math.tan(math.radians(MAX_TILT_UNLEVELLED_DEG))  # the positions from level images contain this error


class Relief:
    """The variation of the height above ground measured by matches, relative to the reported height. A difference that
    all matches have does not count: it is an error of the reported height, and the match corrects it."""

    def __init__(self) -> None:
        self._weight = self._sum = self._sum_of_squares = 0.0
        self._place_id: int | None = None

    @property
    def height_sd(self) -> float:
        """Standard deviation of the height of the ground in view, as a fraction of the height above it."""
        scatter = self._sum_of_squares - self._sum**2 / self._weight if self._weight else 0.0
        total = _UNKNOWN_WEIGHT * UNKNOWN_HEIGHT_SD**2 + _SCATTER_FACTOR**2 * max(0.0, scatter)
        return math.sqrt(total / (_UNKNOWN_WEIGHT + max(0.0, self._weight - 1)))

    def add(self, height_ratio: float, place_id: int) -> None:
        """Add the height of an accepted match, divided by the reported one; ignore a repeat of the previous place."""
        if place_id == self._place_id or height_ratio <= 0:
            return
        self._place_id, ratio = place_id, math.log(height_ratio)
        self._weight = _DECAY * self._weight + 1
        self._sum = _DECAY * self._sum + ratio
        self._sum_of_squares = _DECAY * self._sum_of_squares + ratio**2


def compute_nadir_sd(view: View, height_sd: float = UNKNOWN_HEIGHT_SD) -> float:
    """Return the standard deviation of each component of a view's nadir offset, as a fraction of the longest side.
    `height_sd`: see `Relief.height_sd`."""
    if view.nadir_offset is None or view.focal is None:
        return view.nadir_offset_sd
    length = math.hypot(*view.nadir_offset)
    is_tilted = length > _MIN_TANGENT * view.focal
    return math.hypot(view.nadir_offset_sd, height_sd * length * is_tilted)
