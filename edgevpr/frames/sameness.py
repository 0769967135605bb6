"""Detects whether two images show the same unmoved scene, regardless of noise and on-screen clock or display.
(`shot.RepeatDetector` finds exactly equal images before they are fully decoded.)

Coarse copies are compared block by block. The texture of a block determines how much its correlation drops if the
image moves by 1.5 of their pixels in any direction; a block with a smaller drop has not moved. So no threshold
depends on the kind of ground or its contrast. Blocks that cannot show every motion, such as furrows, are not used."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Image, Singles
from edgevpr.core.reasons import Reason, ReasonCode

_SIZE_PX = (128, 96)  # columns and rows of a coarse copy
_BLOCK_PX = 16
_MIN_TEXTURE_LEVELS = 2.5  # standard deviation of a block, grey levels; the noise of a dark image is lower
_MOTION_PX = 1.5
_MIN_LOSS = 0.05  # of correlation due to that motion; a smaller loss may be compression noise
_MAX_READ_COLUMNS = 640  # columns that are averaged; a larger image is subsampled first
_THUMBNAIL_PX = (16, 12)
# Strips: chosen on 14 image sets without one, and on copies with strips of 2 to 20 %.
_STRIP_IMAGES = 9
_MIN_CHANGE_LEVELS = 2.0  # median over an image; one that changes less, as in a hover, is skipped
_MAX_STATIC_LEVELS = 1.0  # change of a pixel of a strip: at most this, or this share of the image's median
_MAX_STATIC_RATIO = 0.25
_MIN_GROUND_RATIO = 0.4  # mean change of a pixel of ground, to the image's median
_MAX_BAR_DIFFERENCE = 2  # columns of the coarse copy: equal bars on opposite edges shift nothing
_MIN_FRACTION = 0.6  # of the pixels of a column: digits change, and some ground does not
BLOCK_COUNT = _SIZE_PX[0] // _BLOCK_PX * (_SIZE_PX[1] // _BLOCK_PX)


@dataclass(frozen=True)
class CoarseImage:
    """A coarse copy of an image: `grey`, uint8 (96, 128)."""

    grey: Image

    @cached_property
    def blocks(self) -> Singles:
        """Blocks, float32 (48, 256), each minus its mean and normalised to length 1; zero if it has no texture."""
        blocks = _cut_blocks(self.grey)
        blocks = blocks - blocks.mean(axis=1, keepdims=True)
        length = np.linalg.norm(blocks, axis=1, keepdims=True)
        has_texture = length >= _MIN_TEXTURE_LEVELS * _BLOCK_PX
        return np.asarray(np.where(has_texture, blocks / np.maximum(length, 1e-6), 0), np.float32)

    @cached_property
    def thumb(self) -> Singles:
        """An even coarser copy, float32 (192,), minus its mean and normalised to length 1."""
        small = cv2.resize(self.grey.astype(np.float32), _THUMBNAIL_PX, interpolation=cv2.INTER_AREA).ravel()
        small -= small.mean()
        return np.asarray(small / max(float(np.linalg.norm(small)), 1e-6), np.float32)

    @cached_property
    def min_loss(self) -> Singles:
        """Loss of correlation of each block, float32 (48,), if the image moves by 1.5 pixels in the least visible
        direction: from the smallest eigenvalue of the block's structure tensor."""
        dx, dy = (_cut_blocks(cv2.Sobel(self.grey, cv2.CV_32F, 1 - axis, axis, ksize=1) / 2) for axis in (0, 1))
        xx, yy, xy = (dx * dx).sum(axis=1), (dy * dy).sum(axis=1), (dx * dy).sum(axis=1)
        eigenvalue = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
        blocks = _cut_blocks(self.grey)
        energy = ((blocks - blocks.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
        return np.asarray(_MOTION_PX**2 * eigenvalue / (2 * np.maximum(energy, 1e-6)), np.float32)

    @cached_property
    def is_textured(self) -> Bools:
        """True for each block whose texture reveals any motion, bool (48,)."""
        return np.asarray(self.blocks.any(axis=1) & (self.min_loss > _MIN_LOSS))

    def find_unmoved_blocks(self, other: "CoarseImage") -> Bools:
        """Return True for each textured block that has not moved in the other image, bool (48,)."""
        loss = 1 - (self.blocks * other.blocks).sum(axis=1)
        return np.asarray(self.is_textured & (loss < self.min_loss))


class StripCheck:
    """Finds a strip along one edge that never changes: its end is straight and stays in place. `report` is called then.
    `offset`: half of its width as a fraction of the longest side: the shift of the optical axis, masked or not."""

    def __init__(self) -> None:
        self.report: Callable[[Reason], None] = lambda reason: logging.getLogger(__name__).warning("%s", reason)
        self.offset = 0.0
        self._last_offset = 0.0  # in the nine images before
        self._greys: list[Singles] = []

    def add(self, image: Image) -> None:
        """Process the next image, uint8 (H, W[, 3])."""
        grey = make_coarse(image[::2, ::2]).grey.astype(np.float32)
        if self._greys and np.median(abs(grey - self._greys[-1])[::4, ::4]) < _MIN_CHANGE_LEVELS:
            return
        self._greys.append(grey)
        if len(self._greys) < _STRIP_IMAGES:
            return
        changes = abs(np.diff(self._greys, axis=0))
        self._greys = [grey]
        mean = changes.mean(axis=0)
        median = float(np.median(mean[::4, ::4]))
        is_ground = mean >= _MIN_GROUND_RATIO * median
        is_static = changes.max(axis=0) <= max(_MAX_STATIC_LEVELS, _MAX_STATIC_RATIO * median)
        columns = np.zeros(2)  # of the strip at the left minus those at the right, and at the top minus the bottom
        for axis, step in (0, 1), (0, -1), (1, 1), (1, -1):
            ground, static = (pixels.mean(axis=axis)[::step] for pixels in (is_ground, is_static))
            end = int(np.argmax(ground >= _MIN_FRACTION))
            columns[axis] += step * end * ((static[:end] < _MIN_FRACTION).sum() <= 1)  # one may be partly ground
        strip_px = np.where(abs(columns) > _MAX_BAR_DIFFERENCE, columns, 0) * image.shape[1::-1] / _SIZE_PX
        offset = float(np.hypot(*strip_px)) / 2 / max(image.shape)
        if offset and not self.offset:
            edge = ("left", "top", "right", "bottom")[int(np.argmax([*strip_px, *-strip_px]))]
            self.report(Reason(ReasonCode.STRIP_FOUND, {"width_px": float(max(abs(strip_px))), "edge": edge}))
        self.offset = max(offset, self._last_offset)
        self._last_offset = offset


def make_coarse(image: Image) -> CoarseImage:
    """Return the coarse copy of an image, uint8 (H, W) grey or (H, W, 3) BGR; of BGR, the green channel is used."""
    step = max(1, image.shape[1] // _MAX_READ_COLUMNS)
    plane = np.ascontiguousarray((image if image.ndim == 2 else image[:, :, 1])[::step, ::step])
    return CoarseImage(np.asarray(cv2.resize(plane, _SIZE_PX, interpolation=cv2.INTER_AREA), np.uint8))


def _cut_blocks(plane: Array) -> Singles:
    """Cut a plane (96, 128) into its blocks, float32 (48, 256)."""
    columns, rows = (px // _BLOCK_PX for px in _SIZE_PX)
    blocks = plane.astype(np.float32).reshape(rows, _BLOCK_PX, columns, _BLOCK_PX)
    return np.asarray(blocks.swapaxes(1, 2).reshape(BLOCK_COUNT, -1))
