"""Finds an offset that all images of a map have from their recorded positions, in the same direction seen from the
aircraft: that of a camera whose tilt or late trigger is not recorded.

Refinement places the images by their overlap. Recorded positions that are all ahead of their images then lie on
opposite sides of them in lines flown in opposite directions, and look like scatter. In a map flown in one direction the
offset cannot be seen. Also finds images whose recorded positions are displaced together, as those of one battery."""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import median_filter

from edgevpr.core.arrays import Bools, Complexes
from edgevpr.mapmaking.graph import GraphSolution
from edgevpr.places.mapinfo import find_inconsistent_tags

_MIN_PLACES = 8
_MIN_SHARE = 0.1  # of the longest side: 7 degrees with a typical lens
_MIN_OFFSET_M = 10.0  # GPS drifts by some metres from line to line, and a map may have only two
_MAX_UNEXPLAINED = 0.5  # of the scatter of the recorded positions may remain beside the offset
_MAX_MEAN_DIRECTION = 0.9  # length of the mean of all directions; if longer, an offset looks like a shift of the map
_MIN_STRAIGHTNESS = 0.9  # of the course through three positions
_MIN_RUN = 6  # images; in a shorter run, the recorded positions are outliers
_MIN_DISPLACEMENT_M = 2 * _MIN_OFFSET_M  # from one line to the next, the offset of a camera looks twice as long
_MIN_DISPLACEMENT_RATIO = 2.7  # to the scatter; up to 2.3 on sets whose GPS drifts by 13 m, 2.9 for 24 m beside 5 m


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


def find_displaced_run(recorded: Complexes, solution: GraphSolution) -> tuple[range, complex]:
    """Return the indices of a run of images whose `recorded` positions, complex (N,) metres in flight order, are
    displaced together, and by how much against all others (0: no clear run). `solution`: from the overlap of images."""
    members = np.flatnonzero(solution.component == np.bincount(solution.component).argmax())
    error_m = recorded[members] - solution.position[members]
    explained_m2, run, displacement_m = 0.0, range(0), 0j
    typical_m = median_filter(error_m.real, _MIN_RUN - 1) + 1j * median_filter(error_m.imag, _MIN_RUN - 1)
    error_m = np.where(find_inconsistent_tags(abs(error_m - typical_m)), typical_m, error_m)
    # A displaced run also shifts, turns and scales the solution, so these are fitted together with it.
    basis, _ = np.linalg.qr(np.column_stack([np.ones(len(members)), solution.position[members]]))
    error_m -= basis @ (basis.conj().T @ error_m)
    sums = np.cumsum(np.column_stack([error_m, basis]), axis=0)
    for start in range(_MIN_RUN, len(members) - _MIN_RUN + 1):
        total = sums[start + _MIN_RUN - 1 :] - sums[start - 1]
        redundancy = _MIN_RUN + np.arange(len(total)) - (abs(total[:, 1:]) ** 2).sum(axis=1)
        step_m = total[:, 0] / np.maximum(redundancy, 1.0)
        last = int(abs(total[:, 0] * step_m).argmax())
        if abs(total[last, 0] * step_m[last]) > explained_m2:
            explained_m2 = abs(total[last, 0] * step_m[last])
            displacement_m = complex(step_m[last])
            run = range(members[start], np.append(members, len(recorded))[start + _MIN_RUN + last])
    scatter_m = np.sqrt(max((abs(error_m) ** 2).sum() - explained_m2, 0.0) / len(members))
    is_clear = abs(displacement_m) >= max(_MIN_DISPLACEMENT_M, _MIN_DISPLACEMENT_RATIO * scatter_m)
    return run, displacement_m if is_clear else 0j


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
