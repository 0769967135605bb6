"""Staticity: the pixels of a frame that will be there again, by an object detector (thesis 3.2.2).

The detector is a network with a card, whose section `detector` names the dynamic classes. Which pixels their boxes
cover is all that counts, so boxes that overlap are not thinned out.
"""

import math
from typing import Any

import numpy as np

from edgevpr.core.errors import ModelError
from edgevpr.runtime.recognise.boxes import DECODERS
from edgevpr.techniques.card import Card, load_card
from edgevpr.techniques.session import open_session, prepare, run_outputs, shares

_CAR_M = 4.5
_CAR_PX = 24  # on the input of a detector: these small ones find little that is smaller
_LARGEST_M = 25.0  # no lorry or boat that comes and goes is longer
_MOST_TILES = 4  # a side: each tile costs a run
_OVERLAP = 0.1  # of a tile's side, so that what lies across a border is whole in one of them
_CLASS_AXIS = 1
_SEED = 7


class Detector:
    """A detector that has run successfully."""

    def __init__(self, card: Card, session: Any) -> None:
        self.card, self._session = card, session
        self._decode = DECODERS[card.detector.family]
        self._numbers = sorted(card.detector.dynamic.values())

    def is_static(self, image: np.ndarray, footprint_m: float | None = None) -> np.ndarray:
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

    def _boxes_px(self, image: np.ndarray) -> np.ndarray:
        """Return the boxes of dynamic classes, int (N, 4): left, top, right, bottom, clipped to the picture."""
        rule = self.card.input
        outputs = run_outputs(self.card, self._session, self.card.outputs.boxes, prepare(image, rule))
        try:
            boxes, scores = self._decode(outputs, (rule.height, rule.width))
            scores = scores[:, self._numbers].max(_CLASS_AXIS)
        except (IndexError, ValueError) as error:
            raise ModelError(
                f"{self.card.path}: the outputs are not those of a `{self.card.detector.family}` detector with these "
                f"classes ({error}): correct `detector` or `outputs.boxes`."
            ) from error
        found = boxes[scores >= self.card.detector.min_score]
        height, width = image.shape[:2]
        across, down = shares(image, rule)
        size = np.array([width / across, height / down] * 2)
        least, most = np.floor(found[:, :2] * size[:2]), np.ceil(found[:, 2:] * size[:2])
        return np.hstack([least, most]).clip(0, [width, height] * 2).astype(int)


def open_detector(model: str, threads: int = 1) -> Detector:
    """Open the detector of the card `model` as `detector_of` does."""
    return detector_of(load_card(model), threads)


def detector_of(card: Card, threads: int = 1) -> Detector:
    """Open the detector of a card, and run it once. Raises ModelError, one sentence, for a card of no detector and for
    whatever keeps it from flying."""
    if card.detector is None:
        raise ModelError(f"{card.path} is of no detector: name one with a section `detector` (models/README.md).")
    detector = Detector(card, open_session(card, card.outputs.boxes, threads))
    noise = np.random.default_rng(_SEED).integers(0, 256, (card.input.height, card.input.width, 3), np.uint8)
    detector.is_static(noise)
    return detector


def _tiles(height: int, width: int, count: int) -> list[tuple[int, int, int, int]]:
    downs, acrosses = (_cuts(side, count) for side in (height, width))
    return [(top, bottom, left, right) for top, bottom in downs for left, right in acrosses]


def _cuts(side: int, count: int) -> list[tuple[int, int]]:
    """Cut a side into `count` parts that overlap."""
    part = side / (count - (count - 1) * _OVERLAP)
    starts = [part * (1 - _OVERLAP) * number for number in range(count)]
    return [(round(start), min(side, round(start + part))) for start in starts]
