"""Views of a query: its picture as seen from other heights and at other headings, for `cohog`.

A query of a camera that looks straight down is compared with a place under several *hypotheses*: a height ratio (the
camera's height above the ground divided by that when the place was mapped) and a rotation of the camera since then, in
steps of 15 degrees. A view undoes both. Few regions agree by chance more easily than many. Factors, measured with
foreign pictures of the aerial tuning sets, make the fractions of agreeing votes comparable."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Ints, Mask, Singles
from edgevpr.core.contract import Picture
from edgevpr.techniques.layout import ROTATIONS

# Each is about 1.4 times the previous one: the votes of a view still agree if the height is wrong by a factor of 1.2.
HEIGHT_RATIOS = (0.5, 0.7, 1.0, 1.42, 2.0)
QUARTERS = 4
STEPS_PER_QUARTER = ROTATIONS // QUARTERS
_CHANCE_EXPONENT = 0.72  # the fraction that agrees by chance falls with this power of the number of regions
_LARGER_VIEW_FACTORS = {1.42: 0.87, 2.0: 0.8}  # a larger view has more shifts at which votes can agree by chance

# Encodes a square picture, float32 (side, side), with its allowed pixels, bool of the same shape or None, in cells of
# this many pixels. Returns blocks float32 (n, n, 4 bins), and bool (n, n), True for good blocks.
Encode = Callable[[Singles, Mask | None, int], tuple[Singles, Bools]]
Describe = Callable[[Singles], Singles]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRegions:
    """The good regions of a view, to be compared with a place: their `indices` int (G,), row-major on a grid of `side`
    x `side` regions, and their vectors `regions` float32 (G, P), each of length 1. `factor`: the score is the fraction
    of agreeing votes times this factor (see above)."""

    indices: Ints
    regions: Singles
    side: int
    factor: float


def decode_hypothesis(number: int) -> tuple[float, int]:
    """Return the height ratio of the hypothesis `number`, and its rotation in steps of 15 degrees."""
    return HEIGHT_RATIOS[number // ROTATIONS], number % ROTATIONS


def count_cells(cells: int, ratio: float) -> int:
    """Return the number of cells along one side of a view of height ratio `ratio`, for a place with `cells` along one
    side. The two differ by an even number, so that the middle regions of view and place coincide."""
    return cells + 2 * round(cells * (ratio - 1) / 2)


def compute_scale(cells: int, ratio: float) -> float:
    """Return the exact height ratio of a view: its number of cells along one side, an integer, divided by the number
    `cells` of a place."""
    return count_cells(cells, ratio) / cells


class QueryViews:
    """The views of one query, each made on first use. `unchanged` is the unchanged view: its blocks float32 (n, n, 4
    bins), and bool (n, n), True for good blocks. `encode` makes such a pair for another view, with cells of `cell_px`
    pixels. Views rotated by quarter turns reuse the same cells, rotated. `seen` bool (n, n) is True for blocks of the
    unchanged view that have only allowed pixels."""

    def __init__(self, picture: Picture, unchanged: tuple[Singles, Bools], cell_px: int, encode: Encode) -> None:
        self._picture, self._cell_px, self._encode, self.seen = picture, cell_px, encode, picture.seen
        self._side, self._good = len(unchanged[1]), max(int(unchanged[1].sum()), 1)
        self._encoded = {(1.0, 0): unchanged}
        self._scaled: dict[float, tuple[Array, Array]] = {}
        self.structure: Singles | None = None  # of the unchanged view (see `overlay`)
        self._regions: dict[tuple[int, Describe], ViewRegions] = {}
        self.fields: dict[tuple[int, int], Singles] = {}  # layouts by (hypothesis, grid side)

    def discard_other_heights(self, ratio: float) -> None:
        """Discard the views of other height ratios, which take megabytes, except the unchanged one."""
        self._encoded = {key: view for key, view in self._encoded.items() if key[0] == ratio or key == (1.0, 0)}
        self._scaled = {key: picture for key, picture in self._scaled.items() if key == ratio}
        self._regions = {key: view for key, view in self._regions.items() if decode_hypothesis(key[0])[0] == ratio}
        self.fields = {key: field for key, field in self.fields.items() if decode_hypothesis(key[0])[0] == ratio}

    def make_blocks(self, ratio: float, turn: int) -> tuple[Singles, Bools]:
        """Return the view of the height ratio `ratio` and the rotation `turn`, in steps of 15 degrees: its blocks,
        float32 (n, n, 4 bins), and bool (n, n), True for good blocks."""
        quarters, steps = divmod(turn, STEPS_PER_QUARTER)
        if (ratio, steps) not in self._encoded:
            self._encoded[ratio, steps] = self._encode(*self._warp_picture(ratio, steps))
        blocks, good = self._encoded[ratio, steps]
        return rotate_blocks(blocks, -quarters), np.rot90(good, -quarters)

    def make_regions(self, number: int, describe: Describe) -> ViewRegions:
        """Return all good regions of the view of the hypothesis `number`. `describe` converts blocks float32 (G, 4
        bins) to the vectors (G, P) that are compared."""
        if (number, describe) not in self._regions:
            ratio, turn = decode_hypothesis(number)
            blocks, good = self.make_blocks(ratio, turn)
            side = max(count_cells(self._side + 1, ratio) - 1, self._side)  # regions per side, at least a place's
            if ratio > 1:
                area_ratio = compute_scale(self._side + 1, ratio) ** 2  # relative to the place
                factor = area_ratio * _LARGER_VIEW_FACTORS[ratio]  # at most one in `area_ratio` votes can agree
            else:
                factor = 1.0 if ratio == 1 else min(1.0, (int(good.sum()) / self._good) ** _CHANCE_EXPONENT)
            self._regions[number, describe] = ViewRegions(
                indices=np.flatnonzero(np.pad(good, (side - len(good)) // 2)),  # on a grid with the same middle
                regions=describe(blocks[good]),
                side=side,
                factor=factor,
            )
        return self._regions[number, describe]

    @cached_property
    def halved(self) -> tuple[Array, Mask]:
        """The picture with half as many pixels along a side, at least two per cell: grey float32 (side, side), and bool
        (side, side), True for allowed pixels."""
        grey, allowed = self._resize_picture((self._side + 1) * max(2, self._cell_px // 2))
        return grey, allowed.astype(bool)

    def _resize_picture(self, side: int) -> tuple[Array, Array]:
        """Return the picture with `side` pixels along a side: grey float32, and uint8, 1 for allowed pixels."""
        if self._picture.grey is None or self._picture.allowed is None:
            raise ValueError("the query has no picture to rotate")
        grey: Array = self._picture.grey
        allowed: Array = self._picture.allowed.astype(np.uint8)
        if side == len(grey):
            return grey, allowed
        grey = cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA)
        return grey, cv2.resize(allowed, (side, side), interpolation=cv2.INTER_NEAREST)

    def _warp_picture(self, ratio: float, steps: int) -> tuple[Array, Array, int]:
        """Return the picture as seen at the height ratio `ratio`, rotated by `steps` steps of 15 degrees: grey
        float32 (side, side); bool (side, side), True for allowed pixels; and the side of a cell in pixels."""
        cell_px = self._cell_px if ratio <= 1 else max(2, self._cell_px // 2)
        side = count_cells(self._side + 1, ratio) * cell_px
        if ratio not in self._scaled:
            self._scaled[ratio] = self._resize_picture(side)
        grey, allowed = self._scaled[ratio]
        if steps:
            middle = (side - 1) / 2
            matrix = cv2.getRotationMatrix2D((middle, middle), -360 * steps / ROTATIONS, 1)
            grey = cv2.warpAffine(grey, matrix, (side, side), borderMode=cv2.BORDER_REPLICATE)
            allowed = cv2.warpAffine(allowed, matrix, (side, side), flags=cv2.INTER_NEAREST)
        return grey, allowed.astype(bool), cell_px


def rotate_blocks(blocks: Singles, quarters: int) -> Singles:
    """Rotate the blocks (side, side, 4 L) of a picture counter-clockwise by `quarters` quarter turns; the number L of
    orientations must be a multiple of 4. The result equals the blocks of the rotated picture, except for rounding."""
    for _ in range(quarters % QUARTERS):
        cells = blocks.reshape(*blocks.shape[:-1], 4, -1)[..., [1, 3, 0, 2], :]
        oriented = np.roll(cells, -(cells.shape[-1] // QUARTERS), axis=-1)  # orientations turn from x to y (down)
        blocks = np.rot90(oriented.reshape(blocks.shape))
    return np.ascontiguousarray(blocks)
