"""Networks of the gate, each with a card: one predicts the memorability of the parts of a frame (thesis 3.2.1), the
other, an object detector, finds the pixels without movable objects (thesis 3.2.2).

`models/recipes/train_matchability.py` trains a network with another definition of memorability: how likely a crop is to
be found again in another image.

Each family of detectors has a decoder here. Its arguments are the outputs in the card's order and the input's
(height, width) in pixels, and it returns

* `boxes`, float32 (N, 4): left, top, right, bottom as fractions of the input; they may extend beyond it,
* `scores`, float32 (N, C): the score of each class, 0..1."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from edgevpr.core.arrays import Floats, Image, Ints, Mask, Singles
from edgevpr.core.errors import ModelError
from edgevpr.techniques.card import Card, InputRule
from edgevpr.techniques.session import compute_fill_fractions, open_session, prepare_input, run_outputs

CROPS = 5  # along each side: C in the thesis is 5x5
_TEST_SEED = 7
_STRIDES_PX = (8, 16, 32)  # cell sizes of the three YOLOX grids
_MAX_LOG = 20.0  # of the side of a box in cells; a larger one would overflow the exponential

Decoded = tuple[Floats, Floats]


class Memorability:
    """The memorability network described by a card; the constructor runs it once as a test. Raises ModelError for a
    card without memorability, and for an unusable network."""

    def __init__(self, card: Card, threads: int = 1) -> None:
        if card.outputs.memorability is None:
            raise ModelError(f"{card.path} has no `outputs.memorability`: use the card of a network that has it.")
        self.card, self._output = card, card.outputs.memorability
        self._session = open_session(card, threads)
        self._has_batches = type(self._session.get_inputs()[0].shape[0]) is not int
        self.compute_matrix(np.random.default_rng(_TEST_SEED).integers(0, 256, (480, 640, 3), np.uint8))

    def compute_matrix(self, image: Image) -> Singles:
        """Compute the memorability of each crop of uint8 (H, W[, 3]): float32 (5, 5) in 0..1, the M of thesis 3.2.1.

        Raises ModelError for numbers that are not finite, or are outside 0..1."""
        name, crops = self._output, prepare_crops(image, self.card.input)
        batches = [crops] if self._has_batches else np.split(crops, len(crops))
        results = [run_outputs(self.card, self._session, [name], batch)[0] for batch in batches]
        if any(part.size != len(batch) for part, batch in zip(results, batches, strict=True)):
            raise ModelError(f"{self.card.path}: `{name}` must have one number per picture: correct `outputs`.")
        values = np.concatenate([part.ravel() for part in results]).astype(np.float32)
        if values.min() < 0 or values.max() > 1:
            raise ModelError(f"{self.card.path}: `{name}` is {values.max():g} for a picture, but must be from 0 to 1.")
        return values.reshape(CROPS, CROPS)


def prepare_crops(image: Image, rule: InputRule) -> Singles:
    """Cut an image, uint8 (H, W[, 3]) of at least 5x5 pixels, into crops, row by row, and prepare them for a network:
    float32 (25, C, height, width)."""
    rows, columns = (np.array_split(np.arange(side), CROPS) for side in image.shape[:2])
    crops = (image[y[0] : y[-1] + 1, x[0] : x[-1] + 1] for y in rows for x in columns)
    return np.concatenate([prepare_input(crop, rule) for crop in crops])


def interpolate_map(matrix: Singles, size_px: tuple[int, int]) -> Singles:
    """Interpolate the memorability of the crops, float32 (5, 5), bilinearly to float32 `size_px` (height, width)."""
    return np.asarray(cv2.resize(matrix, size_px[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


class Detector:
    """The detector described by a card; the constructor runs it once as a test. Raises ModelError for a card without
    a section `detector`, and for an unusable network."""

    def __init__(self, card: Card, threads: int = 1) -> None:
        if card.detector is None or card.outputs.boxes is None:
            raise ModelError(f"{card.path} is not a detector: use one with a section `detector` (models/README.md).")
        self.card, self._rule, self._outputs = card, card.detector, card.outputs.boxes
        self._session = open_session(card, threads)
        size = card.input.height, card.input.width
        self.is_static(np.random.default_rng(_TEST_SEED).integers(0, 256, (*size, 3), np.uint8))

    def is_static(self, image: Image) -> Mask:
        """Return bool (H, W): True for the pixels of uint8 (H, W[, 3]) outside all boxes of dynamic classes. Raises
        ModelError for numbers that are not finite, and for outputs that do not fit the family."""
        static = np.ones(image.shape[:2], bool)
        for left, top, right, bottom in self._detect_boxes_px(image):
            static[top:bottom, left:right] = False
        return static

    def _detect_boxes_px(self, image: Image) -> Ints:
        """Return the boxes of dynamic classes, int (N, 4): left, top, right, bottom, clipped to the image."""
        rule = self.card.input
        outputs = run_outputs(self.card, self._session, self._outputs, prepare_input(image, rule))
        try:
            boxes, scores = _DECODERS[self._rule.family](outputs, (rule.height, rule.width))
            scores = scores[:, sorted(self._rule.dynamic.values())].max(axis=1)
        except (IndexError, ValueError) as error:
            raise ModelError(
                f"{self.card.path}: the outputs are not those of a `{self._rule.family}` detector with these "
                f"classes ({error}): correct `detector` or `outputs.boxes`."
            ) from error
        boxes = boxes[scores >= self._rule.min_score]
        height, width = image.shape[:2]
        across, down = compute_fill_fractions(image, rule)
        size = np.array([width / across, height / down] * 2)
        top_left, bottom_right = np.floor(boxes[:, :2] * size[:2]), np.ceil(boxes[:, 2:] * size[:2])
        return np.hstack([top_left, bottom_right]).clip(0, [width, height] * 2).astype(int)


def decode_yolox(outputs: Sequence[Floats], size_px: tuple[int, int]) -> Decoded:
    """Decode (1, N, 5 + C), the cells of three grids in turn (Ge et al. 2021, arXiv 2107.08430). Each has the offset of
    the centre in cells, the logarithms of the sides in cells, the score of an object, and the scores of the classes."""
    values = outputs[0][0]
    (height, width), cells, strides = size_px, [], []
    for stride in _STRIDES_PX:
        grid = np.stack(np.meshgrid(np.arange(-(-width // stride)), np.arange(-(-height // stride))), -1)
        cells.append(grid.reshape(-1, 2))
        strides.append(np.full((len(cells[-1]), 1), stride))
    stride_px = np.concatenate(strides).astype(np.float32)
    centre_px = (values[:, :2] + np.concatenate(cells).astype(np.float32)) * stride_px
    side_px = np.exp(np.minimum(values[:, 2:4], _MAX_LOG)) * stride_px
    boxes = np.concatenate([centre_px - side_px / 2, centre_px + side_px / 2], 1) / (width, height, width, height)
    return boxes.astype(np.float32), values[:, 4:5] * values[:, 5:]


def decode_fastestdet(outputs: Sequence[Floats], size_px: tuple[int, int]) -> Decoded:
    """Decode (1, 5 + C, h, w): score of an object, tanh of the centre's offset in cells, logit of the sides as
    fractions of the input, scores of the classes (FastestDet's own code; a score is objectness^0.6 times class^0.4)."""
    values = outputs[0][0]
    rows, columns = values.shape[1:]
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1)
    centre = (cells + np.tanh(np.moveaxis(values[1:3], 0, -1))) / (columns, rows)
    side = 1 / (1 + np.exp(-np.moveaxis(values[3:5], 0, -1)))
    boxes = np.concatenate([centre - side / 2, centre + side / 2], -1, dtype=np.float32).reshape(-1, 4)
    scores = np.clip(values[0], 0, 1) ** 0.6 * np.clip(values[5:], 0, 1) ** 0.4
    return boxes, np.moveaxis(scores, 0, -1).reshape(-1, len(scores))


_DECODERS: dict[str, Callable[[Sequence[Floats], tuple[int, int]], Decoded]] = {
    "yolox": decode_yolox,
    "fastestdet": decode_fastestdet,
}
