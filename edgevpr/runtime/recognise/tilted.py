"""Measures the perspective of a query over its place a second time, from the image warped onto the place.

If an image is strongly tilted, few regions agree, because each is seen from a different side. After the image is
warped by their homography, more regions agree and give the tilt more accurately. One more image must be encoded."""

import math

import numpy as np

from edgevpr.core.arrays import Array
from edgevpr.core.contract import FineMatch, Perspective, Technique
from edgevpr.frames.homography import Homography, clip_polygon
from edgevpr.frames.level import LevelledImage

_MAX_SIDE_PX = 512
_MIN_SCALE = 0.1  # of the scale at the centre: pixels nearer to the horizon are masked
# Fraction of the regions that agreed before. In views of 45 degrees 0.8 or more remain, over changed ground too.
_MIN_REGIONS_RATIO = 2 / 3
_UNSHIFTED = FineMatch(1.0, shift_cells=(0.0, 0.0), rotation_deg=0.0, height_ratio=1.0)


def measure_again(picture: LevelledImage, technique: Technique, fine: Array, first: Perspective) -> Perspective | None:
    """Measure the perspective of an image over the place with the fine part `fine` again, starting from the `first`
    one. Return None if that was a coincidence: fewer regions agree now."""
    height, width = picture.image.shape[:2]
    longest, side = max(height, width), min(max(height, width), _MAX_SIDE_PX)
    fraction_from_pixel = np.array([[1, 0, (1 - width) / 2], [0, 1, (1 - height) / 2], [0, 0, longest]]) / longest
    out_from_fraction = np.array([[side, 0, (side - 1) / 2], [0, side, (side - 1) / 2], [0, 0, 1]])
    out_from_pixel = out_from_fraction @ first.over_place @ fraction_from_pixel
    corners = np.array([[0, width - 1, width - 1, 0], [0, 0, height - 1, height - 1], [1] * 4], float)
    corners = clip_polygon(corners, (out_from_pixel @ corners)[2] - _MIN_SCALE)
    scale = math.sqrt(math.prod(first.scales))
    warp = Homography(out_from_pixel, corners, side, longest / (side * scale))
    mask = warp.visible if picture.mask is None else warp.visible & warp.warp_mask(picture.mask)
    warped = technique.encode(warp.warp_image(picture.image), mask)
    second = technique.measure_perspective(warped, fine, _UNSHIFTED)
    if second is None or second.regions < _MIN_REGIONS_RATIO * first.regions:
        return None
    over_place = second.over_place @ first.over_place
    return Perspective(over_place / over_place[2, 2], scale * second.slope_sd, second.regions)
