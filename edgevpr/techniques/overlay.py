"""The last step of `cohog`: the query is overlaid on a place according to their match.

If the match is correct, the structures of both pictures coincide, even if the ground has changed. The *structure* of a
picture is the patterns of its regions minus the mean of their surroundings. The *agreement* of two structures is their
correlation divided by the scatter of independent ones. With a forward camera, it is measured at the shift of the vote.
With a nadir camera, the query's picture is first rotated, scaled and shifted, and the result is the *prominence*: by
how much the agreement exceeds that at other shifts. A road agrees nearly as well if shifted along itself."""

import math

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Mask, Singles
from edgevpr.core.contract import FineMatch

_MIN_STRENGTH = 0.02  # of a region's patterns; weaker patterns are noise
_MAX_SHIFT_CELLS = 7  # of the shifts that are compared
_MAX_MISS_CELLS = 2  # largest error of a match
_PEAK_RADIUS_CELLS = 2
_MIN_SCATTER = 0.3  # share of the usual scatter; an overlap with less is too small or too empty to count
_TINY = 1e-9


def overlay_query(grey: Array, allowed: Mask, match: FineMatch, cells: int) -> tuple[Array, Mask]:
    """Rotate, scale and shift a query's picture, float32 (side, side), and `allowed`, bool of the same shape, True for
    pixels that may be used, by the query's match with a place. Returns both as overlaid on the place, which has `cells`
    cells along a side."""
    side = len(grey)
    middle = np.full(2, (side - 1) / 2)
    angle = np.deg2rad(match.rotation_deg or 0.0)
    turn = (match.height_ratio or 1.0) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = middle + np.array(match.shift_cells) * (side / cells) - turn @ middle
    matrix = np.column_stack([turn, shift])
    warped: Array = cv2.warpAffine(grey, matrix, (side, side), borderMode=cv2.BORDER_REPLICATE)
    seen: Array = cv2.warpAffine(allowed.astype(np.uint8), matrix, (side, side), flags=cv2.INTER_NEAREST)
    return warped, seen.astype(bool)


def compute_structure(patterns: Array, seen: Bools, sd_cells: float) -> Singles:
    """Return the structure of a picture, float32 (n, n, P), from the patterns of its regions (n * n, P); only those
    that are `seen`, bool (n, n), count. `sd_cells`: standard deviation of the surroundings of a region."""
    weight = seen.astype(np.float32)
    values = patterns.reshape(*seen.shape, -1).astype(np.float32) * weight[..., None]
    mean = _blur_cells(values, sd_cells) / np.maximum(_blur_cells(weight, sd_cells), _TINY)[..., None]
    values -= mean * weight[..., None]
    strength = np.sqrt((values**2).sum(axis=2))
    structure: Singles = values / np.sqrt(np.maximum(strength, _MIN_STRENGTH))[..., None]
    return structure


def measure_prominence(query: Singles, place: Singles) -> float:
    """Return by how much the agreement of two structures (n, n, P), the query's overlaid on the place, exceeds that at
    other shifts, in standard deviations of independent structures."""
    border = ((_MAX_SHIFT_CELLS, _MAX_SHIFT_CELLS), (_MAX_SHIFT_CELLS, _MAX_SHIFT_CELLS))
    common = cv2.matchTemplate(np.pad(query, (*border, (0, 0))), place, cv2.TM_CCORR)
    query_strength, place_strength, min_scatter = _measure_strengths(query, place)
    scatter = cv2.matchTemplate(np.pad(query_strength, border), place_strength, cv2.TM_CCORR)
    agreement = common / np.sqrt(np.maximum(scatter, min_scatter) + _TINY)  # at all shifts of up to `_MAX_SHIFT_CELLS`
    first, last = _MAX_SHIFT_CELLS - _MAX_MISS_CELLS, _MAX_SHIFT_CELLS + _MAX_MISS_CELLS + 1
    at_y, at_x = np.divmod(int(agreement[first:last, first:last].argmax()), last - first)
    y, x = at_y + first, at_x + first
    peak = float(agreement[y, x])
    top, left = (max(0, middle - _PEAK_RADIUS_CELLS) for middle in (y, x))
    agreement[top : y + _PEAK_RADIUS_CELLS + 1, left : x + _PEAK_RADIUS_CELLS + 1] = -np.inf
    return peak - float(agreement.max())


def compute_agreement(query: Singles, place: Singles, shift_cells: tuple[float, float]) -> float:
    """Return the agreement of two structures (n, n, P), in standard deviations of independent ones, with the query's
    middle at the shift (dx, dy) from that of the place, or up to two cells away."""
    n = len(place)
    query_strength, place_strength, min_scatter = _measure_strengths(query, place)
    x, y = (min(max(round(cells), _MAX_MISS_CELLS - n), n - _MAX_MISS_CELLS) for cells in shift_cells)
    best = 0.0
    for dy in range(y - _MAX_MISS_CELLS, y + _MAX_MISS_CELLS + 1):
        for dx in range(x - _MAX_MISS_CELLS, x + _MAX_MISS_CELLS + 1):
            in_query = np.s_[max(0, -dy) : n - max(0, dy), max(0, -dx) : n - max(0, dx)]
            in_place = np.s_[max(0, dy) : n + min(0, dy), max(0, dx) : n + min(0, dx)]
            scatter = max(float(np.einsum("ij,ij", query_strength[in_query], place_strength[in_place])), min_scatter)
            best = max(best, float(np.einsum("ijk,ijk", query[in_query], place[in_place])) / math.sqrt(scatter + _TINY))
    return best


def _measure_strengths(query: Singles, place: Singles) -> tuple[Singles, Singles, float]:
    """Return the squared strengths of two structures in each cell, (n, n), and the minimum scatter for them."""
    query_strength, place_strength = (query**2).sum(axis=2), (place**2).sum(axis=2)
    return (
        query_strength,
        place_strength,
        _MIN_SCATTER**2 * float(query_strength.sum()) * float(place_strength.sum()) / place_strength.size,
    )


def _blur_cells(values: Singles, cells: float) -> Singles:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), cells, borderType=cv2.BORDER_CONSTANT))
