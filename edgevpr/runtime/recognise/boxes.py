"""Boxes out of a detector's raw outputs. Detectors of one family write them alike; each family has a decoder here.

A decoder takes the outputs in the order of the card and the input's (height, width) in pixels. It returns `boxes`,
float32 (N, 4): left, top, right, bottom as shares of the input, and `scores`, float32 (N, C): of each class, 0..1.
Boxes may overlap each other and reach beyond the input: what is asked of them is which pixels they cover.
"""

from collections.abc import Callable, Sequence

import numpy as np

Decoded = tuple[np.ndarray, np.ndarray]

_YOLOX_STRIDES_PX = (8, 16, 32)
_NANODET_STRIDES_PX = (8, 16, 32)
_LARGEST_LOG = 20.0  # exp of more is no side of a box, and overflows


def yolox(outputs: Sequence[np.ndarray], size_px: tuple[int, int]) -> Decoded:
    """Decode (1, N, 5 + C), the cells of three grids one after the other (Ge et al. 2021, arXiv 2107.08430): centre in
    cells from the cell, logarithm of the sides in cells, score of an object, scores of the classes."""
    values = outputs[0][0]
    cells, stride_px = _grids(size_px, _YOLOX_STRIDES_PX)
    centre_px = (values[:, :2] + cells) * stride_px
    side_px = np.exp(np.minimum(values[:, 2:4], _LARGEST_LOG)) * stride_px
    return _boxes(centre_px - side_px / 2, centre_px + side_px / 2, size_px), values[:, 4:5] * values[:, 5:]


def fastestdet(outputs: Sequence[np.ndarray], size_px: tuple[int, int]) -> Decoded:
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


def nanodet(outputs: Sequence[np.ndarray], size_px: tuple[int, int]) -> Decoded:
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


DECODERS: dict[str, Callable[[Sequence[np.ndarray], tuple[int, int]], Decoded]] = {
    "yolox": yolox,
    "fastestdet": fastestdet,
    "nanodet": nanodet,
}


def _grids(size_px: tuple[int, int], strides_px: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the column and row of every cell of the grids, float32 (N, 2), and its stride, float32 (N, 1)."""
    cells, strides = [], []
    for stride in strides_px:
        rows, columns = (-(-side // stride) for side in size_px)
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
        cells.append(grid)
        strides.append(np.full((len(grid), 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)


def _boxes(least_px: np.ndarray, most_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    height, width = size_px
    return (np.concatenate([least_px, most_px], 1) / (width, height, width, height)).astype(np.float32)
