"""The query as if its camera had been tilted: does it then agree better with its place?

Of a picture that is tilted by far, or of changed ground, too few regions agree to measure a tilt. So the picture is
laid over the place as its match says, levelled from a few supposed tilts, and compared again. It costs a few queries'
time, and is done where nobody reports a tilt and the pictures do not show that there is none.
"""

import math
from dataclasses import replace

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Doubles
from edgevpr.core.contract import FineMatch, Technique
from edgevpr.frames.homography import Homography, cut_polygon
from edgevpr.frames.level import Levelled
from edgevpr.runtime.recognise.perspective import ShownTilt

_SUPPOSED_TILT_DEG = 40.0
# Any tilt that is nearer to it than to none: too little is known to refuse a match, and enough for what it may claim.
SUPPOSED_TILT = ShownTilt(math.tan(math.radians(_SUPPOSED_TILT_DEG)), math.tan(math.radians(_SUPPOSED_TILT_DEG)) / 2)
_DIRECTIONS = 6
# A match of a tilted picture is one of its near part: its middle shows more ground than the match says.
_SCALES = (1.25, 1.5)
_MAX_SIDE_PX = 512
_MIN_DOWN = 0.1  # as in `frames.level`


def agrees_better_tilted(picture: Levelled, focal: float, technique: Technique, fine: Array, match: FineMatch) -> bool:
    """Tell whether a picture agrees better with the place of its `match`, whose fine part is `fine`, if it was taken by
    a camera that is tilted by 40 degrees to some side. `focal`: its focal length, in shares of its longest side."""
    straight = _score(picture, focal, technique, fine, match, np.eye(3))
    farther = [replace(match, height_ratio=scale * (match.height_ratio or 1.0)) for scale in _SCALES]
    towards = 2 * math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    turns = np.radians(_SUPPOSED_TILT_DEG) * np.column_stack([-np.sin(towards), np.cos(towards), np.zeros(_DIRECTIONS)])
    return any(
        _score(picture, focal, technique, fine, supposed, cv2.Rodrigues(turn)[0]) > straight
        for supposed in farther
        for turn in turns
    )


def _score(
    picture: Levelled, focal: float, technique: Technique, fine: Array, match: FineMatch, level_from_lens: Doubles
) -> float:
    """Return how well a picture agrees, levelled by a rotation (3, 3) and laid over the place as its match says."""
    height, width = picture.image.shape[:2]
    side = min(max(height, width), _MAX_SIDE_PX)
    focal_px = focal * max(height, width)
    lens_from_pixel = np.linalg.inv([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    # The middle stays in the middle, and shows as much ground as before.
    middle, steep = level_from_lens[:, 2] / level_from_lens[2, 2], float(level_from_lens[2, 2])
    out_px = focal * side * steep**1.5
    level = np.array([[out_px, 0, -out_px * middle[0]], [0, out_px, -out_px * middle[1]], [0, 0, 1]]) @ level_from_lens
    turn_scale = (match.height_ratio or 1.0) * np.exp(1j * np.radians(match.rotation_deg or 0.0))
    right, down = np.array(match.shift_cells or (0.0, 0.0)) * side / (technique.spec.cells or 1) + (side - 1) / 2
    over_place = [[turn_scale.real, -turn_scale.imag, right], [turn_scale.imag, turn_scale.real, down], [0, 0, 1]]
    corners = np.array([[0, width - 1, width - 1, 0], [0, 0, height - 1, height - 1], [1] * 4], float)
    corners = cut_polygon(corners, (level_from_lens @ lens_from_pixel @ corners)[2] - _MIN_DOWN)
    warp = Homography(over_place @ level @ lens_from_pixel, corners, side, focal_px / (out_px * abs(turn_scale)))
    mask = warp.shown if picture.mask is None else warp.shown & warp.overlay(picture.mask)
    return technique.match_at_rest(technique.encode(warp.picture(picture.image), mask), fine).score
