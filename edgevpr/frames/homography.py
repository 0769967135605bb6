"""Warps images by a homography, and clips an image to the part that can be warped."""

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image, Mask
from edgevpr.frames.images import shrink_image

_SUBPIXEL_BITS = 4


class Homography:
    """Warp of an undistorted image to (side, side) pixels by a homography (3, 3), with the interface of `lens.Remap`.
    `corners`: corners of the part of the image that is used, in homogeneous pixels (3, n)."""

    def __init__(self, out_from_pixel: Doubles, corners: Doubles, side: int, shrink: float) -> None:
        self._out_from_pixel, self._side, self._shrink = out_from_pixel, side, shrink
        warped = out_from_pixel @ corners
        points = np.round((warped[:2] / warped[2]).T * 2**_SUBPIXEL_BITS).astype(np.int32)
        visible = cv2.fillConvexPoly(np.zeros((side, side), np.uint8), points, (1,), shift=_SUBPIXEL_BITS)
        self.visible: Mask = visible.view(np.bool_)

    def warp_mask(self, overlay: Mask) -> Mask:
        size = (self._side, self._side)
        pixels = overlay.view(np.uint8)
        return cv2.warpPerspective(pixels, self._out_from_pixel, size, flags=cv2.INTER_NEAREST).view(bool)

    def warp_image(self, image: Image) -> Image:
        shrunk, out_from_pixel = shrink_image(image, self._shrink), self._out_from_pixel
        if shrunk is not image:
            fy, fx = (full / small for full, small in zip(image.shape[:2], shrunk.shape[:2], strict=True))
            out_from_pixel = out_from_pixel @ [[fx, 0, (fx - 1) / 2], [0, fy, (fy - 1) / 2], [0, 0, 1]]
        # Outside the image, where the mask is False, its edge is replicated, so that no false gradient arises.
        return cv2.warpPerspective(  # type: ignore[return-value]  # of the same dtype
            shrunk, out_from_pixel, (self._side, self._side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )


def clip_polygon(corners: Doubles, depth: Doubles) -> Doubles:
    """Clip a convex polygon, homogeneous (3, n), to its part with positive depth, and return the corners of that part.
    `depth` (n,) is the depth of each corner."""
    points = []
    for previous, current in zip(range(-1, len(depth) - 1), range(len(depth)), strict=True):
        if (depth[previous] > 0) != (depth[current] > 0):
            fraction = depth[previous] / (depth[previous] - depth[current])
            points.append(corners[:, previous] + fraction * (corners[:, current] - corners[:, previous]))
        if depth[current] > 0:
            points.append(corners[:, current])
    return np.column_stack(points)
