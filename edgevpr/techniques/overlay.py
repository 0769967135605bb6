"""The last step of `cohog`: the query is overlaid on a place according to their match.

If the match is correct, the structures of both pictures coincide, even if the ground has changed. The *structure* of a
picture is the patterns of its regions minus the mean of their surroundings. The *agreement* of two structures is their
correlation divided by its *scatter*, the standard deviation that it has for independent structures. With a forward
camera, it is measured at the voted shift. With a nadir camera, the query's picture is first rotated, scaled and
shifted, and the result is the *prominence*: the agreement minus the highest agreement at other shifts. A road, for
example, agrees nearly as well if shifted along itself."""

import math

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Mask, Singles
from edgevpr.core.contract import FineMatch

_MIN_STRENGTH = 0.02  # length of a region's pattern vector; weaker patterns are noise
_MAX_SHIFT_CELLS = 7  # maximum shift that is compared
_MAX_MATCH_ERROR_CELLS = 2  # maximum error of a match
_PEAK_RADIUS_CELLS = 2
_MIN_SCATTER = 0.3  # relative to the usual scatter; a smaller one, of a small or empty overlap, is raised to it
_TINY = 1e-9


def overlay_query(grey: Array, allowed: Mask, match: FineMatch, cells: int) -> tuple[Array, Mask]:
    """Warp a query's picture and its mask onto the matched place, which has `cells` cells along a side. The picture
    `grey` is float32 (side, side); `allowed`, bool of the same shape, is True for pixels that may be used."""
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
    """Return the structure of a picture, float32 (n, n, P), from the patterns of its regions (n * n, P). Only those
    that are `seen`, bool (n, n), are used. `sd_cells`: standard deviation of the surroundings of a region."""
    weight = seen.astype(np.float32)
    values = patterns.reshape(*seen.shape, -1).astype(np.float32) * weight[..., None]
    mean = _blur_cells(values, sd_cells) / np.maximum(_blur_cells(weight, sd_cells), _TINY)[..., None]
    values -= mean * weight[..., None]
    strength = np.sqrt((values**2).sum(axis=2))
    return np.asarray(values / np.sqrt(np.maximum(strength, _MIN_STRENGTH))[..., None])


def measure_prominence(query: Singles, place: Singles) -> float:
    """Return the prominence of two structures (n, n, P), the query's overlaid on the place: their agreement minus the
    highest at other shifts, in standard deviations of independent structures."""
    border = ((_MAX_SHIFT_CELLS, _MAX_SHIFT_CELLS), (_MAX_SHIFT_CELLS, _MAX_SHIFT_CELLS))
    correlation = cv2.matchTemplate(np.pad(query, (*border, (0, 0))), place, cv2.TM_CCORR)
    query_sq, place_sq, min_scatter_sq = _measure_strengths(query, place)
    scatter_sq = cv2.matchTemplate(np.pad(query_sq, border), place_sq, cv2.TM_CCORR)
    agreement = correlation / np.sqrt(np.maximum(scatter_sq, min_scatter_sq) + _TINY)  # at all shifts
    first, last = _MAX_SHIFT_CELLS - _MAX_MATCH_ERROR_CELLS, _MAX_SHIFT_CELLS + _MAX_MATCH_ERROR_CELLS + 1
    row, column = np.divmod(int(agreement[first:last, first:last].argmax()), last - first)
    y, x = row + first, column + first
    peak = float(agreement[y, x])
    top, left = (max(0, middle - _PEAK_RADIUS_CELLS) for middle in (y, x))
    agreement[top : y + _PEAK_RADIUS_CELLS + 1, left : x + _PEAK_RADIUS_CELLS + 1] = -np.inf
    return peak - float(agreement.max())


def compute_agreement(query: Singles, place: Singles, shift_cells: tuple[float, float]) -> float:
    """Return the agreement of two structures (n, n, P), in standard deviations of independent ones, for the query's
    middle at the shift (dx, dy) from that of the place, or up to two cells away."""
    n = len(place)
    query_sq, place_sq, min_scatter_sq = _measure_strengths(query, place)
    x, y = (min(max(round(cells), _MAX_MATCH_ERROR_CELLS - n), n - _MAX_MATCH_ERROR_CELLS) for cells in shift_cells)
    best = 0.0
    for dy in range(y - _MAX_MATCH_ERROR_CELLS, y + _MAX_MATCH_ERROR_CELLS + 1):
        for dx in range(x - _MAX_MATCH_ERROR_CELLS, x + _MAX_MATCH_ERROR_CELLS + 1):
            in_query = np.s_[max(0, -dy) : n - max(0, dy), max(0, -dx) : n - max(0, dx)]
            in_place = np.s_[max(0, dy) : n + min(0, dy), max(0, dx) : n + min(0, dx)]
            scatter_sq = max(float(np.einsum("ij,ij", query_sq[in_query], place_sq[in_place])), min_scatter_sq)
            correlation = float(np.einsum("ijk,ijk", query[in_query], place[in_place]))
            best = max(best, correlation / math.sqrt(scatter_sq + _TINY))
    return best


def _measure_strengths(query: Singles, place: Singles) -> tuple[Singles, Singles, float]:
    """Return the squared strengths of two structures (squared lengths of their pattern vectors) in each cell, (n, n),
    and the lower limit of the squared scatter."""
    query_sq, place_sq = (query**2).sum(axis=2), (place**2).sum(axis=2)
    min_scatter_sq = _MIN_SCATTER**2 * float(query_sq.sum()) * float(place_sq.sum()) / place_sq.size
    return query_sq, place_sq, min_scatter_sq


def _blur_cells(values: Singles, cells: float) -> Singles:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), cells, borderType=cv2.BORDER_CONSTANT))
