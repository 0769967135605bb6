"""The displacement vote of `cohog`: all regions that show the same place have moved by the same shift.

Every good region of the query has a most similar region in the place, the *reference*. The shift between the two, in
cells, is its vote. If the place is the same, most votes agree on one shift. In an unrelated picture (a test card), all
regions may resemble the same few regions of the place, so the distinct regions among the agreeing votes are counted as
well. Indices of regions are row-major."""

import math
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Ints, Singles
from edgevpr.core.contract import FineMatch, Support
from edgevpr.core.geodesy import fit_similarity
from edgevpr.techniques.views import ViewRegions

_SHIFT_SPREAD_CELLS = 3  # difference in shift between near and far ground, with a forward camera
_RANK_STEP = 4  # only every fourth region is ranked, because ranking is the slowest part
_MIDDLE_SHARE = 0.7  # of the width and height of a picture; the rest is its outer ring
_MIN_PART_REGIONS = 40  # fewer regions of the middle or ring are too few to compare
_CHANCE_BACK = 0.02  # added to both fractions, so that a few regions do not decide their ratio
_REGIONS_PER_PRODUCT = 256  # compared with a place at once, so that their similarities, a megabyte, stay in the cache
_FIT_ROUNDS = 8
_MAX_RESIDUAL_CELLS = 1.5  # maximum distance of an agreeing region from the fit
# Beyond these limits another hypothesis is closer, or the pairs show different places.
_MAX_ROTATION_DEG = 16.0
_MAX_SCALE = 1.6
_MIN_PAIRS = 8
_Grid = tuple[Ints, int]  # row-major indices of regions, and the number of regions along one side


def find_displacement(indices: Ints, nearest: Ints, sides: tuple[int, int], weights: tuple[float, ...]) -> FineMatch:
    """Find the shift on which most regions agree. `indices` and `nearest` are int (G,): the good regions of the query,
    and the most similar region of the reference for each. `sides` are the numbers of regions along one side of the
    query's grid and of the reference's, both even or both odd. A shift is measured between the centres of the grids.

    A vote that is n cells from a shift, along rows or columns, has the weight `weights[n]`; votes further away have
    none. The peak is the shift with the largest sum. The score is its fraction of all votes, 0 without any region."""
    if not len(indices):
        return FineMatch(0.0, shift_cells=(0.0, 0.0), covariance_cells2=(0.0, 0.0, 0.0), coverage=0.0)
    border = len(weights) - 1
    shifts, votes, vote_sums = _count_votes(indices, nearest, sides, weights)
    width = len(votes)
    peak_weights = _make_peak_weights(weights)
    peak_y, peak_x = divmod(int(vote_sums.argmax()), vote_sums.shape[1])
    size = len(peak_weights)
    agreeing = votes[peak_y : peak_y + size, peak_x : peak_x + size] * peak_weights
    count = float(agreeing.sum())
    density_x, density_y = agreeing.sum(axis=0) / count, agreeing.sum(axis=1) / count
    offsets = np.arange(-border, border + 1)
    mean_x, mean_y = float(density_x @ offsets), float(density_y @ offsets)
    # A shift is known to one cell at best: 1/12 is the variance of a uniform distribution over one cell.
    covariance = (
        float(density_x @ (offsets - mean_x) ** 2) + 1 / 12,
        float((offsets - mean_y) @ agreeing @ (offsets - mean_x)) / count,
        float(density_y @ (offsets - mean_y) ** 2) + 1 / 12,
    )
    zero_index = sum(sides) // 2 - 1  # the index of a shift of 0, along one side
    is_near = np.zeros((width, width), bool)
    is_near[peak_y : peak_y + size, peak_x : peak_x + size] = True
    is_matched = np.zeros(sides[1] ** 2, bool)
    is_matched[nearest[is_near.ravel().take(shifts)]] = True
    shift_cells = (peak_x - zero_index + mean_x, peak_y - zero_index + mean_y)
    coverage = np.count_nonzero(is_matched) / len(is_matched)
    return FineMatch(count / len(indices), shift_cells=shift_cells, covariance_cells2=covariance, coverage=coverage)


def compute_vote_fraction(indices: Ints, nearest: Ints, sides: tuple[int, int], weights: tuple[float, ...]) -> float:
    """Return only the score of `find_displacement` for these arguments, in half the time."""
    return float(_count_votes(indices, nearest, sides, weights)[2].max()) / len(indices) if len(indices) else 0.0


def find_most_similar(regions: Singles, reference: Singles) -> Ints:
    """Return the index of the most similar region of a place, among its regions `reference` (N, P), for each of
    `regions` (G, P): int (G,)."""
    nearest = np.empty(len(regions), np.intp)
    for first in range(0, len(regions), _REGIONS_PER_PRODUCT):
        block = slice(first, first + _REGIONS_PER_PRODUCT)
        nearest[block] = (regions[block] @ reference.T).argmax(axis=1)
    return nearest


def match_view(
    view: ViewRegions, reference: Singles, weights: tuple[float, ...], with_support: bool
) -> tuple[FineMatch, Ints]:
    """Match a view of the query with a place, whose regions are `reference` float32 (side * side, P), by vote.
    `weights`: see `find_displacement`; `with_support`: also measure the `support` of the match. Returns the match, and
    the index of the most similar region of the place for each region of the view, int (G,)."""
    nearest = find_most_similar(view.regions, reference)
    match = find_displacement(view.indices, nearest, (view.side, math.isqrt(len(reference))), weights)
    if with_support and len(nearest):
        support = measure_support(view.indices, view.regions, reference, nearest, match.shift_cells)
        match = replace(match, support=support)
    return replace(match, score=min(1.0, match.score * view.factor)), nearest


def measure_support(
    indices: Ints, regions: Singles, reference: Singles, nearest: Ints, shift_cells: tuple[float, float] | None
) -> Support:
    """Measure how well all regions of query and place support the voted shift. `indices` int (G,) and `regions` float32
    (G, P) are the indices and vectors of the query's good regions. `reference` float32 (side * side, P) are all regions
    of the place; `nearest` int (G,) has the most similar of them for each. The grids have the same size."""
    side = math.isqrt(len(reference))
    reverse = (reference @ regions.T).argmax(axis=1)
    query_y, query_x = np.divmod(indices, side)
    shift_x, shift_y = (round(cells) for cells in shift_cells or (0.0, 0.0))
    y, x = np.divmod(np.arange(len(reference)), side)
    distance = np.maximum(abs(x - query_x[reverse] - shift_x), abs(y - query_y[reverse] - shift_y))
    agrees, is_visible = distance <= _SHIFT_SPREAD_CELLS, _is_inside(x - shift_x, y - shift_y, side)
    return Support(
        back=float(agrees.mean()),
        likeness=float(np.einsum("ij,ij->i", regions, reference[nearest]).mean()),
        log_rank=_compute_log_rank(
            regions[::_RANK_STEP], reference, query_x[::_RANK_STEP] + shift_x, query_y[::_RANK_STEP] + shift_y, side
        ),
        surroundings=_compare_surroundings(agrees[is_visible], x[is_visible], y[is_visible], side),
    )


def _is_inside(x: Ints, y: Ints, side: int) -> Bools:
    return np.asarray((x >= 0) & (x < side) & (y >= 0) & (y < side))


def _compare_surroundings(agrees: Bools, x: Ints, y: Ints, side: int) -> float:
    """Return `Support.surroundings`; 1 if ring or middle has too few regions. `x` and `y` are the positions of the
    place's regions that the query shows, int (N,), and `agrees` bool (N,) is True for those counted in `back`."""
    middle = (side - 1) / 2
    is_ring = np.maximum(abs(x - middle), abs(y - middle)) > _MIDDLE_SHARE * side / 2
    if min(np.count_nonzero(is_ring), np.count_nonzero(~is_ring)) < _MIN_PART_REGIONS:
        return 1.0
    return float((agrees[is_ring].mean() + _CHANCE_BACK) / (agrees[~is_ring].mean() + _CHANCE_BACK))


def _compute_log_rank(regions: Singles, reference: Singles, x: Ints, y: Ints, side: int) -> float:
    """Return the mean log rank of the query's `regions` (n, P); the best possible is 0. `x` and `y` are their shifted
    positions in the place. The rank of a region is the number of regions of the place that resemble it more than the
    best of the 3x3 regions around its position does."""
    rows = np.flatnonzero(_is_inside(x, y, side))
    if not len(rows):
        return math.log(len(reference))
    similarities = regions[rows] @ reference.T
    local = np.full(len(rows), -np.inf, np.float32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            neighbours = np.clip(y[rows] + dy, 0, side - 1) * side + np.clip(x[rows] + dx, 0, side - 1)
            np.maximum(local, similarities[np.arange(len(rows)), neighbours], out=local)
    return float(np.log(1 + np.count_nonzero(similarities > local[:, None], axis=1)).mean())


def _count_votes(
    indices: Ints, nearest: Ints, sides: tuple[int, int], weights: tuple[float, ...]
) -> tuple[Ints, Singles, Array]:
    """Count the votes for each shift; for the arguments, see `find_displacement`. Returns the index of the shift that
    each region votes for, int (G,); the number of votes for each shift, on a grid with a border, float32 (n, n); and
    the weighted sum of the votes around each shift, on a grid without this border."""
    # Regions are indexed on a grid as wide as there are shifts, so that the difference of two indices is the index of
    # their shift. A border around the possible shifts leaves room for the square around the peak.
    border = len(weights) - 1
    query_side, reference_side = sides
    width = query_side + reference_side - 1 + 2 * border
    offset = (query_side - 1 + border) * (width + 1)
    shifts = _index_regions(reference_side, width)[nearest] - _index_regions(query_side, width)[indices] + offset
    votes = np.bincount(shifts, minlength=width * width).reshape(width, width).astype(np.float32)
    vote_sums = cv2.filter2D(votes, -1, _make_peak_weights(weights), borderType=cv2.BORDER_CONSTANT)
    return shifts, votes, vote_sums[border : width - border, border : width - border]


@lru_cache
def _index_regions(side: int, width: int) -> Ints:
    """Return the indices of `side` x `side` regions in the corner of a grid of width `width`, int (side * side,)."""
    return np.add.outer(np.arange(side) * width, np.arange(side)).ravel()


@lru_cache
def _make_peak_weights(weights: tuple[float, ...]) -> Singles:
    """Return the weights of the votes for the shifts around a peak, with the peak in the middle: float32 (2 n - 1, 2 n
    - 1) for n `weights`, see `find_displacement`."""
    distance = np.abs(np.arange(1 - len(weights), len(weights)))
    return np.array(weights, np.float32)[np.maximum.outer(distance, distance)]


def fit_alignment(query: _Grid, place: _Grid, match: FineMatch) -> FineMatch:
    """Fit a shift, a rotation and a scale, by least squares, to the regions of the `query` and their most similar
    regions of the `place`: indices of regions, int (G,), and the side of their grid. The fit is repeated, each time
    with the pairs that agree with the previous fit, or at first with the shift of the `match`.

    Returns the match with the refined position and the covariance of the residuals of single regions. Returns the match
    unchanged if fewer than 8 pairs agree, or if the rotation or scale belongs to another hypothesis."""
    points, targets = locate_regions(*query), locate_regions(*place)
    rotation, shift = 1 + 0j, complex(*(match.shift_cells or (0.0, 0.0)))
    for fit_round in range(_FIT_ROUNDS + 1):
        residuals = targets - rotation * points - shift
        is_near = np.maximum(abs(residuals.real), abs(residuals.imag)) <= _MAX_RESIDUAL_CELLS
        if np.count_nonzero(is_near) < _MIN_PAIRS:
            return match
        if fit_round == _FIT_ROUNDS:
            break
        if np.ptp(points[is_near].real) == np.ptp(points[is_near].imag) == 0:
            return match  # a single point has no rotation
        rotation, shift = fit_similarity(points[is_near], targets[is_near])
        if not 1 / _MAX_SCALE < abs(rotation) < _MAX_SCALE:
            return match
        if abs(np.angle(rotation, deg=True)) > _MAX_ROTATION_DEG:
            return match
    x, y = residuals[is_near].real, residuals[is_near].imag
    # A region is matched to one cell at best: 1/12 is the variance of a uniform distribution over one cell.
    covariance = float(x.var()) + 1 / 12, float(np.mean(x * y) - x.mean() * y.mean()), float(y.var()) + 1 / 12
    return replace(
        match,
        shift_cells=(float(shift.real), float(shift.imag)),
        covariance_cells2=covariance,
        rotation_deg=((match.rotation_deg or 0.0) + float(np.angle(rotation, deg=True))) % 360,
        height_ratio=(match.height_ratio or 1.0) * float(abs(rotation)),
    )


def locate_regions(indices: Ints, side: int) -> Array:
    """Return the positions of regions in cells from the middle of their grid: x + iy, y downwards, complex (G,)."""
    y, x = np.divmod(indices, side)
    return x + 1j * y - (1 + 1j) * (side - 1) / 2
