"""Estimates the offset between the clocks of a downward camera and a track from the camera's pictures.

Two consecutive pictures that overlap show how the aircraft moved between them, in the frame of the first. Three show
how this motion changed: length ratio and turn angle, in which mounting, heading and footprint cancel out. The track
yields the same quantities for any three times; the best offset makes both agree. A straight flight yields no estimate.
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
_MAX_OFFSET_S = 180.0  # a larger offset means that the clock was set wrong, not that it drifted
_STEP_S = 0.25
_MAX_CHANGE = 1.0  # a larger difference is due to an error in the pictures or in the track
# The cost ratio is 0.83 on aerial_caliterra, and at least 0.95 for pictures of one flight on the track of another.
_MIN_TURNS = 4
_MIN_TURN_RAD = 0.3
_MIN_RIVAL_OFFSET_S = 4.0
_MAX_COST_RATIO = 0.9
Move = tuple[complex, complex]  # shift, and logarithm of scale and turn, as in `mapmaking.refine.Tie`


def estimate_clock_offset_s(track: Track, times_s: Sequence[float], paths: Iterable[Path]) -> float | None:
    """Estimate the offset that converts `times_s`, the times of the pictures `paths`, to track times: at most three
    minutes. None if the pictures do not determine it."""
    indices, changes = _find_changes(paths)
    if len(indices) < _MIN_TURNS:
        return None
    offsets_s = np.arange(-_MAX_OFFSET_S, _MAX_OFFSET_S + _STEP_S, _STEP_S)
    places = _interpolate_track(track, np.array(times_s) + offsets_s[:, None])
    costs, turn_counts = np.array([_compute_cost(points, indices, changes) for points in places]).T
    best = int(np.argmin(costs))
    is_distant = abs(offsets_s - offsets_s[best]) > _MIN_RIVAL_OFFSET_S
    if turn_counts[best] < _MIN_TURNS or costs[best] > _MAX_COST_RATIO * costs[is_distant].min():
        return None
    return float(offsets_s[best])


def _compute_cost(points: Complexes, indices: Ints, changes: Complexes) -> tuple[float, float]:
    """Return the mean difference between measured and expected changes of motion, 0..1, and the number of turns that
    agree, if the pictures were taken at `points`, complex (N,). `indices`, int (C,): first picture of each change."""
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = np.log((points[indices + 2] - points[indices + 1]) / (points[indices + 1] - points[indices]))
        error = changes - expected
    error = np.hypot(error.real, (error.imag + np.pi) % (2 * np.pi) - np.pi)
    is_known = np.isfinite(error)
    return (
        float(np.where(is_known, np.minimum(error, _MAX_CHANGE), _MAX_CHANGE).mean()),
        float(np.count_nonzero(is_known & (abs(expected.imag) > _MIN_TURN_RAD) & (error < _MAX_CHANGE / 2))),
    )


def _interpolate_track(track: Track, t_s: Doubles) -> Complexes:
    """Interpolate the track at `t_s`: east + i north in metres, complex of the same shape; NaN outside and in gaps."""
    track_s = np.array(track.t_s)
    lat_deg, lon_deg = np.array([(tag.position.lat_deg, tag.position.lon_deg) for tag in track.tags if tag.position]).T
    east_m, north_m = project_to_metres(lat_deg, lon_deg)
    upper = np.clip(np.searchsorted(track_s, t_s), 1, max(len(track_s) - 1, 1))
    is_known = (t_s >= track_s[0]) & (t_s <= track_s[-1]) & (track_s[upper] - track_s[upper - 1] <= MAX_GAP_S)
    return np.where(is_known, np.interp(t_s, track_s, east_m + 1j * north_m), np.nan)


def _find_changes(paths: Iterable[Path]) -> tuple[Ints, Complexes]:
    """Return, for every three consecutive pictures that overlap, the index of the first and the logarithm of the
    complex factor by which the motion changes. The turn converts the second motion to the frame of the first."""
    moves = [_measure_move(first, second) for first, second in pairwise(_describe_landmarks(paths))]
    changes: dict[int, complex] = {}
    for index, (first, second) in enumerate(pairwise(moves)):
        if first and second and first[0] and second[0]:
            (shift, log_turn_scale), (next_shift, _) = first, second
            changes[index] = np.log(next_shift / shift) + log_turn_scale
    return np.array(list(changes), int), np.array(list(changes.values()), complex)


def _describe_landmarks(paths: Iterable[Path]) -> Iterator[Landmarks | None]:
    for path in paths:
        try:
            yield detect_landmarks(read_image(path, upright=False), None, _MAX_LANDMARKS)
        except ImageError:
            yield None


def _measure_move(first: Landmarks | None, second: Landmarks | None) -> Move | None:
    """Return how the picture's middle moves and turns from picture `first` to `second`, in the frame of `first`."""
    match = measure_agreement(second, first) if first is not None and second is not None else None
    if match is None or match.inliers < MIN_PROVEN_INLIERS or match.shift_share is None or match.rotation_deg is None:
        return None
    return Overlay(match.shift_share, match.rotation_deg, match.scale).relative_pose
