"""Estimates the offset between the clocks of a camera that looks straight down and a track, from the pictures.

Two neighbouring pictures that show the same ground say how the aircraft moved between them, in the frame of the first;
three say how its movement changed: by which factor it became longer, and by which angle it turned. Mounting, heading
and footprint cancel out. The track gives the same for any three times: where both agree, the clock is right. A
straight flight gives no estimate.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Complexes, Doubles, Ints
from edgevpr.core.errors import ImageError
from edgevpr.core.geodesy import project_to_metres
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import MAX_GAP_S, Track
from edgevpr.runtime.recognise.agreement import MIN_PROVEN_INLIERS, Overlay, measure_agreement
from edgevpr.runtime.recognise.landmarks import Landmarks, detect_landmarks

_MAX_LANDMARKS = 500
_MAX_OFFSET_S = 180.0  # clocks further off are set wrong, and do not only drift
_STEP_S = 0.25
_MAX_CHANGE = 1.0  # a movement that differs by more is wrong in the pictures or in the track
# The ratio is 0.83 on aerial_caliterra, and 0.95 or more for pictures of one flight on the track of another.
_MIN_TURNS = 4
_MIN_TURN_RAD = 0.3
_MIN_RIVAL_OFFSET_S = 4.0
_MAX_COST_RATIO = 0.9
Move = tuple[complex, complex]  # step, and logarithm of scale and turn, as those of a tie in `mapmaking.graph`


def estimate_clock_offset_s(track: Track, times_s: Sequence[float], paths: Iterable[Path]) -> float | None:
    """Estimate what is to be added to `times_s`, those of the pictures of `paths` in their order, to get times of the
    track: at most three minutes. None: the pictures do not show it."""
    numbers, changes = _find_changes(paths)
    if len(numbers) < _MIN_TURNS:
        return None
    offsets_s = np.arange(-_MAX_OFFSET_S, _MAX_OFFSET_S + _STEP_S, _STEP_S)
    places = _interpolate_track(track, np.array(times_s) + offsets_s[:, None])
    costs, turning = np.array([_compute_cost(points, numbers, changes) for points in places]).T
    best = int(np.argmin(costs))
    further = abs(offsets_s - offsets_s[best]) > _MIN_RIVAL_OFFSET_S
    if turning[best] < _MIN_TURNS or costs[best] > _MAX_COST_RATIO * costs[further].min():
        return None
    return float(offsets_s[best])


def _compute_cost(points: Complexes, numbers: Ints, changes: Complexes) -> tuple[float, float]:
    """Return by how much the changes of movement differ, 0..1, and how many turns agree, if the pictures were taken at
    `points`, complex (N,). `numbers`, int (C,), are those of the first of three pictures each."""
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = np.log((points[numbers + 2] - points[numbers + 1]) / (points[numbers + 1] - points[numbers]))
        error = changes - expected
    error = np.hypot(error.real, (error.imag + np.pi) % (2 * np.pi) - np.pi)
    is_known = np.isfinite(error)
    return (
        float(np.where(is_known, np.minimum(error, _MAX_CHANGE), _MAX_CHANGE).mean()),
        float(np.count_nonzero(is_known & (abs(expected.imag) > _MIN_TURN_RAD) & (error < _MAX_CHANGE / 2))),
    )


def _interpolate_track(track: Track, t_s: Doubles) -> Complexes:
    """Return where the track is at each of `t_s`, east + i north in metres: complex of its shape, NaN outside the track
    and in its gaps."""
    track_s = np.array(track.t_s)
    lat_deg, lon_deg = np.array([(tag.position.lat_deg, tag.position.lon_deg) for tag in track.tags if tag.position]).T
    east_m, north_m = project_to_metres(lat_deg, lon_deg)
    after = np.clip(np.searchsorted(track_s, t_s), 1, max(len(track_s) - 1, 1))
    is_known = (t_s >= track_s[0]) & (t_s <= track_s[-1]) & (track_s[after] - track_s[after - 1] <= MAX_GAP_S)
    return np.where(is_known, np.interp(t_s, track_s, east_m + 1j * north_m), np.nan)


def _find_changes(paths: Iterable[Path]) -> tuple[Ints, Complexes]:
    """Return, of each three neighbouring pictures that show the same ground, the number of the first, and the logarithm
    of the factor, a complex number, by which the movement changes."""
    moves = [_measure_move(one, other) for one, other in pairwise(_describe_landmarks(paths))]
    changes = {
        number: np.log(second[0] / first[0]) + first[1]
        for number, (first, second) in enumerate(pairwise(moves))
        if first and second and first[0] and second[0]
    }
    return np.array(list(changes), int), np.array(list(changes.values()), complex)


def _describe_landmarks(paths: Iterable[Path]) -> Iterator[Landmarks | None]:
    for path in paths:
        try:
            yield detect_landmarks(read_image(path), None, _MAX_LANDMARKS)
        except ImageError:
            yield None


def _measure_move(one: Landmarks | None, other: Landmarks | None) -> Move | None:
    """Return how the middle moves from picture `one` to the `other`, in the frame of `one`, and how it turns."""
    match = measure_agreement(other, one) if one is not None and other is not None else None
    if match is None or match.inliers < MIN_PROVEN_INLIERS or match.shift_share is None or match.rotation_deg is None:
        return None
    return Overlay(match.shift_share, match.rotation_deg, match.scale).relative_pose
