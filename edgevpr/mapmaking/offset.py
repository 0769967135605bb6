"""Finds an offset that all images of a map have from their recorded positions, in the same direction seen from the
aircraft: that of a camera whose tilt or late trigger is not recorded.

Refinement places the images by their overlap. Recorded positions that are all ahead of their images then lie on
opposite sides of them in lines flown in opposite directions, and look like scatter. In a map flown in one direction the
offset cannot be seen."""

from collections.abc import Iterator

import numpy as np

from edgevpr.core.arrays import Bools, Complexes

_MIN_PLACES = 8
_MIN_SHARE = 0.1  # of the longest side: 7 degrees with a typical lens
_MIN_OFFSET_M = 10.0  # GPS drifts by some metres from line to line, and a map may have only two
_MAX_UNEXPLAINED = 0.5  # of the scatter of the recorded positions may remain beside the offset
_MAX_MEAN_DIRECTION = 0.9  # length of the mean of all directions; if longer, an offset looks like a shift of the map
_MIN_STRAIGHTNESS = 0.9  # of the course through three positions


def find_common_offset(recorded: Complexes, centre: Complexes, log: Complexes) -> float:
    """Return the length of the offset of `recorded` positions from the `centre` of their images, both complex (N,)
    metres in flight order, as a fraction of an image's longest side; 0.0 if there is no clear one. `log`, complex (N,),
    is as in `graph.GraphSolution`."""
    footprint_m = np.exp(log.real)
    shares = [
        _fit_offset((recorded - centre)[known], (footprint_m * direction)[known])
        for direction, known in _list_directions(recorded, log)
        if known.sum() >= _MIN_PLACES and abs(direction[known].mean()) <= _MAX_MEAN_DIRECTION
    ]
    return max(shares, default=0.0)


def _list_directions(recorded: Complexes, log: Complexes) -> Iterator[tuple[Complexes, Bools]]:
    """Yield unit vectors that may be fixed to the camera, complex (N,), and where they are known, bool (N,): the right
    side of the images and, because levelled images are north-up, the course from the position before to the next."""
    yield np.exp(1j * log.imag), np.ones(len(log), bool)
    before, after = np.diff(recorded, prepend=np.nan), np.diff(recorded, append=np.nan)
    course, length = before + after, abs(before) + abs(after)
    known: Bools = abs(course) >= _MIN_STRAIGHTNESS * length  # False at turns and at both ends
    known &= length > 0
    yield np.divide(course, abs(course), out=np.zeros_like(course), where=known), known


def _fit_offset(error_m: Complexes, unit_m: Complexes) -> float:
    """Return the length of b in `error_m` = b `unit_m` + c, complex (N,); 0.0 if that explains too little."""
    design = np.column_stack([unit_m, np.ones(len(unit_m))])
    solution, *_ = np.linalg.lstsq(design, error_m, rcond=None)
    unexplained_m = np.median(abs(error_m - design @ solution))
    scatter_m = np.median(abs(error_m - error_m.mean()))
    share = float(abs(solution[0]))
    is_large = share >= _MIN_SHARE and share * np.median(abs(unit_m)) >= _MIN_OFFSET_M
    return share if is_large and unexplained_m <= _MAX_UNEXPLAINED * scatter_m else 0.0
