"""Estimates unrecorded headings for a tilted camera from the motion between images.

A tilted camera shows ground far from the aircraft, in its viewing direction, so a place needs the heading. Neighbouring
images are levelled with the known tilt; the same ground then moves between them by a rotation and a shift. The heading
is the course over ground between the two positions minus the direction of the shift."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Doubles
from edgevpr.core.geodesy import fit_similarity, offset_between_m, wrap_deg
from edgevpr.core.types import Frame
from edgevpr.frames.level import MAX_TILT_DEG, MAX_TILT_UNLEVELLED_DEG, Lens, compute_level_rotation
from edgevpr.mapmaking.tilt import FEATURES, Features, detect_features, match_features

_MIN_STEP_M = 3.0  # between two positions; over shorter steps, position errors dominate the course
_MAX_DIFFERENCE_DEG = 20.0  # between the headings from the motion before and after an image; if larger, one is wrong
_MAX_SCALE = 1.2  # of the same ground between two images; if larger, tilt or height has changed


def find_headings(frames: Iterable[Frame], lens: Lens) -> Iterator[Frame]:
    """Yield all frames. A frame that is tilted by 20 to 60 degrees and has no heading is assigned one, if the motion
    from the previous frame or to the next frame determines it."""
    orb = cv2.ORB.create(FEATURES)
    last: tuple[Frame, Features | None, float | None] | None = None
    for frame in frames:
        features = detect_features(orb, frame.image) if lacks_heading(frame, lens) else None
        heading_deg = turn_deg = None
        if last and last[1] and features:
            heading_and_turn = _measure_heading(last[0], last[1], frame, features, lens)
            heading_deg, turn_deg = heading_and_turn or (None, None)
        if last:
            before_deg = None if heading_deg is None or turn_deg is None else heading_deg - turn_deg
            yield _set_heading(last[0], last[2], before_deg)
        last = frame, features, heading_deg
    if last:
        yield _set_heading(last[0], last[2], None)


def lacks_heading(frame: Frame, lens: Lens) -> bool:
    """Return True if a frame is tilted by 20 to 60 degrees and has no heading."""
    tilt_deg = math.degrees(math.acos(min(1.0, float(compute_level_rotation(frame, lens)[2, 2]))))
    return frame.heading_deg is None and MAX_TILT_UNLEVELLED_DEG < tilt_deg <= MAX_TILT_DEG


def _measure_heading(
    first: Frame, start: Features, second: Frame, end: Features, lens: Lens
) -> tuple[float, float] | None:
    """Return the heading of the frame `second`, and the rotation from `first` to `second`, in degrees; None if the two
    were taken too close together or share too little ground."""
    if first.position is None or second.position is None:
        return None
    east_m, north_m = offset_between_m(first.position, second.position)
    pairs = match_features(start, end) if math.hypot(east_m, north_m) >= _MIN_STEP_M else None
    if pairs is None:
        return None
    src, dst = (_project_to_ground(points, frame, lens) for points, frame in zip(pairs, (first, second), strict=True))
    turn_scale, shift = fit_similarity(src, dst)
    if not 1 / _MAX_SCALE < abs(turn_scale) < _MAX_SCALE:
        return None
    # The ground moves opposite to the camera. In the picture, x points right and y points down, towards the tail.
    bearing_deg = math.degrees(math.atan2(-shift.real, shift.imag))
    course_deg = math.degrees(math.atan2(east_m, north_m))
    return course_deg - bearing_deg - lens.up_deg, -math.degrees(math.atan2(turn_scale.imag, turn_scale.real))


def _project_to_ground(points: Doubles, frame: Frame, lens: Lens) -> Array:
    """Project image points (n, 2) to the ground: complex (n,), right + i back of the nadir, in camera heights."""
    focal = 0.5 / math.tan(math.radians(lens.fov_deg) / 2)
    rays = compute_level_rotation(frame, lens) @ np.column_stack([points / focal, np.ones(len(points))]).T
    return np.asarray((rays[0] + 1j * rays[1]) / np.maximum(rays[2], 0.1))


def _set_heading(frame: Frame, before_deg: float | None, after_deg: float | None) -> Frame:
    """Set a frame's heading to the mean of those from the motion before and after it (None: unknown), if they agree."""
    headings_deg = [heading_deg for heading_deg in (before_deg, after_deg) if heading_deg is not None]
    if not headings_deg or abs(wrap_deg(headings_deg[0] - headings_deg[-1])) > _MAX_DIFFERENCE_DEG:
        return frame
    mean_deg = headings_deg[0] + wrap_deg(headings_deg[-1] - headings_deg[0]) / 2
    return replace(frame, heading_deg=float(np.mod(mean_deg, 360)))
