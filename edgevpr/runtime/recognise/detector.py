"""Staticity: the pixels of a frame that will be there again, by an object detector (thesis 3.2.2).

The detector is a network with a card, whose section `detector` names the dynamic classes. Which pixels their boxes
cover is all that counts, so boxes that overlap are not thinned out.

Detectors of one family write their raw outputs alike; each family has a decoder here. It takes the outputs in the order
of the card and the input's (height, width) in pixels. It returns `boxes`, float32 (N, 4): left, top, right, bottom as
shares of the input, and `scores`, float32 (N, C): of each class, 0..1. Boxes may reach beyond the input.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from edgevpr.core.arrays import Floats, Image, Ints, Mask
from edgevpr.core.errors import ModelError
from edgevpr.techniques.card import Card
from edgevpr.techniques.session import open_session, prepare, run_outputs, shares

_CAR_M = 4.5
_CAR_PX = 24  # on the input of a detector: these small ones find little that is smaller
_LARGEST_M = 25.0  # no lorry or boat that comes and goes is longer
_MOST_TILES = 4  # a side: each tile costs a run
_OVERLAP = 0.1  # of a tile's side, so that what lies across a border is whole in one of them
_CLASS_AXIS = 1
_SEED = 7
_YOLOX_STRIDES_PX = (8, 16, 32)
_NANODET_STRIDES_PX = (8, 16, 32)
_LARGEST_LOG = 20.0  # exp of more is no side of a box, and overflows

Decoded = tuple[Floats, Floats]


class Detector:
    """The detector of a card, which has run successfully. Raises ModelError, one sentence, for a card of no detector
    and for whatever keeps it from flying."""

    def __init__(self, card: Card, threads: int = 1) -> None:
        if card.detector is None or card.outputs.boxes is None:
            raise ModelError(f"{card.path} is of no detector: name one with a section `detector` (models/README.md).")
        self.card, self._rule, self._outputs = card, card.detector, card.outputs.boxes
        self._session = open_session(card, threads)
        size = card.input.height, card.input.width
        self.is_static(np.random.default_rng(_SEED).integers(0, 256, (*size, 3), np.uint8))

    def is_static(self, image: Image, footprint_m: float | None = None) -> Mask:
        """Tell which pixels of uint8 (H, W[, 3]) lie in no box of a dynamic class: bool (H, W).

        `footprint_m` is the width of the ground in the picture, metres (None: unknown). Where it is wide, the picture
        is looked at in tiles, so that a car has enough pixels; and a box too long for anything that moves is passed
        over. Raises ModelError for numbers that are not finite, and for outputs of another form than the family's.
        """
        height, width = image.shape[:2]
        static = np.ones((height, width), bool)
        largest_px = math.inf if footprint_m is None else _LARGEST_M / footprint_m * width
        for top, bottom, left, right in _tiles(height, width, self.tiles(footprint_m)):
            part = static[top:bottom, left:right]
            for x1, y1, x2, y2 in self._boxes_px(image[top:bottom, left:right]):
                if max(x2 - x1, y2 - y1) <= largest_px:
                    part[y1:y2, x1:x2] = False
        return static

    def tiles(self, footprint_m: float | None) -> int:
        """Return in how many tiles a side a picture is looked at whose ground is `footprint_m` wide."""
        if footprint_m is None:
            return 1
        car_px = _CAR_M / footprint_m * self.card.input.width
        return min(_MOST_TILES, max(1, math.ceil(_CAR_PX / car_px)))

    def _boxes_px(self, image: Image) -> Ints:
        """Return the boxes of dynamic classes, int (N, 4): left, top, right, bottom, clipped to the picture."""
        rule = self.card.input
        outputs = run_outputs(self.card, self._session, self._outputs, prepare(image, rule))
        try:
            boxes, scores = _DECODERS[self._rule.family](outputs, (rule.height, rule.width))
            scores = scores[:, sorted(self._rule.dynamic.values())].max(_CLASS_AXIS)
        except (IndexError, ValueError) as error:
            raise ModelError(
                f"{self.card.path}: the outputs are not those of a `{self._rule.family}` detector with these "
                f"classes ({error}): correct `detector` or `outputs.boxes`."
            ) from error
        found = boxes[scores >= self._rule.min_score]
        height, width = image.shape[:2]
        across, down = shares(image, rule)
        size = np.array([width / across, height / down] * 2)
        least, most = np.floor(found[:, :2] * size[:2]), np.ceil(found[:, 2:] * size[:2])
        return np.hstack([least, most]).clip(0, [width, height] * 2).astype(int)


def _tiles(height: int, width: int, count: int) -> list[tuple[int, int, int, int]]:
    downs, acrosses = (_cuts(side, count) for side in (height, width))
    return [(top, bottom, left, right) for top, bottom in downs for left, right in acrosses]


def _cuts(side: int, count: int) -> list[tuple[int, int]]:
    """Cut a side into `count` parts that overlap."""
    part = side / (count - (count - 1) * _OVERLAP)
    starts = [part * (1 - _OVERLAP) * number for number in range(count)]
    return [(round(start), min(side, round(start + part))) for start in starts]


def yolox(outputs: Sequence[Floats], size_px: tuple[int, int]) -> Decoded:
    """Decode (1, N, 5 + C), the cells of three grids one after the other (Ge et al. 2021, arXiv 2107.08430): centre in
    cells from the cell, logarithm of the sides in cells, score of an object, scores of the classes."""
    values = outputs[0][0]
    cells, stride_px = _grids(size_px, _YOLOX_STRIDES_PX)
    centre_px = (values[:, :2] + cells) * stride_px
    side_px = np.exp(np.minimum(values[:, 2:4], _LARGEST_LOG)) * stride_px
    return _boxes(centre_px - side_px / 2, centre_px + side_px / 2, size_px), values[:, 4:5] * values[:, 5:]


def fastestdet(outputs: Sequence[Floats], size_px: tuple[int, int]) -> Decoded:
    """Decode (1, 5 + C, h, w): score of an object, tanh of the centre's offset in cells, logit of the sides as shares
    of the input, scores of the classes (FastestDet's own code; a score is objectness^0.6 times class^0.4)."""
    values = outputs[0][0]
    rows, columns = values.shape[1:]
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1)
    centre = (cells + np.tanh(np.moveaxis(values[1:3], 0, -1))) / (columns, rows)
    side = 1 / (1 + np.exp(-np.moveaxis(values[3:5], 0, -1)))
    boxes = np.concatenate([centre - side / 2, centre + side / 2], -1, dtype=np.float32).reshape(-1, 4)
    scores = np.clip(values[0], 0, 1) ** 0.6 * np.clip(values[5:], 0, 1) ** 0.4
    return boxes, np.moveaxis(scores, 0, -1).reshape(-1, len(scores))


def nanodet(outputs: Sequence[Floats], size_px: tuple[int, int]) -> Decoded:
    """Decode, for the strides 8, 16 and 32, scores (1, N, C), then distances (1, N, 4 x bins): of each side from the
    cell's middle a distribution over whole strides (Li et al. 2020, arXiv 2006.04388)."""
    levels = len(_NANODET_STRIDES_PX)
    scores = np.concatenate([part[0] for part in outputs[:levels]])
    said = np.concatenate([part[0] for part in outputs[levels:]])
    cells, stride_px = _grids(size_px, _NANODET_STRIDES_PX)
    logits = said.reshape(len(said), 4, -1)
    shares = np.exp(logits - logits.max(-1, keepdims=True))
    distance_px = (shares @ np.arange(shares.shape[-1])) / shares.sum(-1) * stride_px
    middle_px = (cells + 0.5) * stride_px
    return _boxes(middle_px - distance_px[:, :2], middle_px + distance_px[:, 2:], size_px), scores


_DECODERS: dict[str, Callable[[Sequence[Floats], tuple[int, int]], Decoded]] = {
    "yolox": yolox,
    "fastestdet": fastestdet,
    "nanodet": nanodet,
}


def _grids(size_px: tuple[int, int], strides_px: Sequence[int]) -> tuple[Floats, Floats]:
    """Return the column and row of every cell of the grids, float32 (N, 2), and its stride, float32 (N, 1)."""
    cells, strides = [], []
    for stride in strides_px:
        rows, columns = (-(-side // stride) for side in size_px)
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
        cells.append(grid)
        strides.append(np.full((len(grid), 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)


def _boxes(least_px: Floats, most_px: Floats, size_px: tuple[int, int]) -> Floats:
    height, width = size_px
    return (np.concatenate([least_px, most_px], 1) / (width, height, width, height)).astype(np.float32)
