"""Solves the pose graph of a map by least squares: fits the position, direction and footprint of each picture to the
recorded positions and the ties. A tie is the relative pose of two pictures that show the same ground.

A place has two complex unknowns. Its position p is east + i north, in metres. Its *log* l is a complex logarithm of
footprint and direction: exp(l) = footprint_m exp(-i up), a factor that converts an offset in the picture (right + i up,
in its longest sides) to one on the ground. In a tie, `step` is the offset of the centre of picture `query` from the
centre of picture `place`, in picture `place`, and exp(`turn`) is the rotation and scale from `place` to `query`:

    (p_query - p_place) exp(-l_place) = step        l_query - l_place = turn

Both are holomorphic, so complex least squares is exact and halves the number of unknowns. Steps are compared in the
picture, not on the ground, because otherwise a map shrunk to a point would satisfy all ties. The recorded positions
determine position, scale and direction of the whole map. Steps, turns and recorded positions are weighted by standard
deviations estimated from the residuals, and outliers are given little weight (Geman and McClure 1987).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import SuperLU, splu

from edgevpr.core.arrays import Array, Complexes, Floats
from edgevpr.core.geodesy import fit_similarity
from edgevpr.core.text import show_elapsed

_MAX_ROUNDS = 4  # estimates of the standard deviations
_MIN_SD_CHANGE = 0.05  # relative; a smaller change ends the rounds
_MAX_STEPS = 40  # Gauss-Newton steps
_MIN_MOVE = 1e-4  # as a fraction of a footprint; smaller moves end the steps
_MAX_LOG_MOVE = 0.5  # maximum change of a log in one Gauss-Newton step
# Ratio of actual to nominal standard deviations of ties: initial estimate, and lower limit, because a few ties that
# agree well by chance must not make the others look wrong.
_INITIAL_TIE_FACTOR = 3.0
_MIN_TIE_FACTOR = 0.5
_MIN_RECORDED_SD_M = 0.5
_INITIAL_RECORDED_SD_M = 10.0
_MIN_AGREEMENT = 0.1  # a tie with a smaller weight contradicts the others
_MEDIAN_LENGTH = 1.832  # median length of a vector of four standard normal numbers
_DIAGONAL_DAMPING = 1e-6  # added to the diagonal, so that places without ties can be solved for


@dataclass(frozen=True, slots=True, kw_only=True)
class Ties:
    """T pairs of pictures of the same ground: `query` and `place`, int (T,), are the indices of the two pictures.
    `step` and `turn`, complex (T,), are defined in the module's docstring. `step_sd` and `turn_sd`, float (T,), are
    their standard deviations along one axis, up to a common factor that `solve_graph` estimates."""

    query: np.ndarray
    place: np.ndarray
    step: np.ndarray
    turn: np.ndarray
    step_sd: np.ndarray
    turn_sd: np.ndarray

    def __len__(self) -> int:
        return len(self.query)


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphSolution:
    """The solved graph of N places with T ties. `position`, complex (N,): east + i north in metres. `log`, complex
    (N,): footprint and direction, as in the module's docstring.
    `position_var` (m^2) and `log_var`, float (N,): variances of `position` and `log`, summed over both axes.
    `component`, int (N,): index of each place's group; the places of a group are connected by ties.
    `recorded_sd_m`: estimated standard deviation of recorded positions along one axis.
    `ties_agree`, bool (T,): False for ties that contradict the others."""

    position: np.ndarray
    log: np.ndarray
    position_var: np.ndarray
    log_var: np.ndarray
    component: np.ndarray
    recorded_sd_m: float
    ties_agree: np.ndarray


@show_elapsed("refining: solving for all positions")
def solve_graph(recorded: np.ndarray, ties: Ties, sd_m: float | None = None) -> GraphSolution:
    """Solve the pose graph of N places by least squares. `recorded`, complex (N,): the recorded positions, east + i
    north in metres, with a common standard deviation `sd_m` along one axis (None: it is estimated)."""
    count = len(recorded)
    _, component = connected_components(_make_tie_matrix(ties, count), directed=False)
    graph = _Graph(recorded, ties, component)
    factor, recorded_sd_m = _INITIAL_TIE_FACTOR, sd_m or _INITIAL_RECORDED_SD_M
    for _ in range(1 if sd_m else _MAX_ROUNDS):
        last_factor, last_sd_m = factor, recorded_sd_m
        normal, weights = graph.optimise(last_sd_m, factor)
        variance = 2 * _invert_diagonal(normal)  # the weights are per axis, the variance is the sum of both axes
        if len(ties):
            # The unknowns absorb part of the residuals: correct the estimate by the fraction of redundant observations.
            redundancy = max(2 * len(ties) - 2 * (count - len(np.unique(component))), 1) / (2 * len(ties))
            median = float(np.median(graph.compute_tie_residuals()))
            factor = max(_MIN_TIE_FACTOR, median / _MEDIAN_LENGTH / np.sqrt(redundancy))
        residual_m = abs(graph.position - recorded)
        # Add the variance of the solution: with few ties, the solution follows every error of a recorded position.
        total_var_m2 = _estimate_sd(residual_m) ** 2 + np.median(variance[:count]) / 2
        recorded_sd_m = max(_MIN_RECORDED_SD_M, float(np.sqrt(total_var_m2)))
        if max(abs(np.log(last_factor / factor)), abs(np.log(last_sd_m / recorded_sd_m))) < _MIN_SD_CHANGE:
            break
    return GraphSolution(
        position=graph.position,
        log=graph.log,
        position_var=variance[:count],
        log_var=variance[count:],
        component=component,
        recorded_sd_m=recorded_sd_m,
        ties_agree=weights >= _MIN_AGREEMENT,
    )


class _Graph:
    """The least-squares problem of `solve_graph`: N places with T ties, their recorded positions, and the current
    solution, `position` and `log`, complex (N,) each."""

    def __init__(self, recorded: np.ndarray, ties: Ties, component: np.ndarray) -> None:
        """Compute the initial solution: chain the pictures of each component along its most accurate ties, then fit the
        whole component to its recorded positions."""
        self._recorded, self._ties = recorded, ties
        count = len(recorded)
        position, log = np.zeros(count, complex), np.zeros(count, complex)
        tree = minimum_spanning_tree(_make_tie_matrix(ties, count))
        tie_by_pair = {}
        for tie in np.argsort(-ties.step_sd, kind="stable").tolist():  # the most accurate tie of a pair comes last
            query, place, step, turn = int(ties.query[tie]), int(ties.place[tie]), ties.step[tie], ties.turn[tie]
            tie_by_pair[query, place], tie_by_pair[place, query] = (step, turn), (-step * np.exp(-turn), -turn)
        for group in range(component.max(initial=-1) + 1):
            members = np.flatnonzero(component == group)
            order, predecessors = breadth_first_order(tree, members[0], directed=False)
            for place in order[1:].tolist():
                base = int(predecessors[place])
                step, turn = tie_by_pair[place, base]
                position[place], log[place] = position[base] + np.exp(log[base]) * step, log[base] + turn
            scale, offset = _fit_robust_similarity(position[members], recorded[members])
            position[members] = scale * position[members] + offset
            log[members] += np.log(scale)
        self.position, self.log = position, log

    def optimise(self, sd_m: float, factor: float) -> tuple[csc_matrix, np.ndarray]:
        """Solve for positions and logs by Gauss-Newton steps. `sd_m` is the standard deviation of recorded positions;
        those of the ties are multiplied by `factor`. Returns the normal matrix (2 N, 2 N) and the robust weight of each
        tie, float (T,), 0..1."""
        count, ties = len(self.position), self._ties
        for _ in range(_MAX_STEPS):
            weights = _weigh_residuals(self.compute_tie_residuals() / factor)
            step_weights, turn_weights = (weights / (factor * sd) ** 2 for sd in (ties.step_sd, ties.turn_sd))
            recorded_weights = _weigh_residuals(abs(self.position - self._recorded) / sd_m) / sd_m**2
            jacobian, residuals = self._linearise(*map(np.sqrt, (step_weights, turn_weights, recorded_weights)))
            normal = (jacobian.conj().T @ jacobian).tocsc()
            move = _factorise(normal).solve(-(jacobian.conj().T @ residuals))
            # Shorten a long move, because the problem is not linear in the logs far from the solution.
            damping = min(1.0, _MAX_LOG_MOVE / max(abs(move[count:]).max(initial=0), 1e-9))
            self.position, self.log = self.position + damping * move[:count], self.log + damping * move[count:]
            if (abs(move[:count]) < _MIN_MOVE * np.exp(self.log.real)).all():
                break
        return normal, weights

    def compute_tie_residuals(self) -> Floats:
        """Return the residual of each tie, in its standard deviations: float (T,)."""
        steps, turns = self._compute_residuals()
        return np.asarray(np.hypot(abs(steps) / self._ties.step_sd, abs(turns) / self._ties.turn_sd))

    def _compute_residuals(self) -> tuple[Complexes, Complexes]:
        """Return the residuals of the ties in step and turn, complex (T,) each."""
        position, log, ties = self.position, self.log, self._ties
        steps = (position[ties.query] - position[ties.place]) * np.exp(-log[ties.place]) - ties.step
        turns = log[ties.query] - log[ties.place] - ties.turn
        return steps, turns.real + 1j * ((turns.imag + np.pi) % (2 * np.pi) - np.pi)

    def _linearise(
        self, step_weights: np.ndarray, turn_weights: np.ndarray, recorded_weights: np.ndarray
    ) -> tuple[csc_matrix, np.ndarray]:
        """Return the weighted Jacobian (R, 2 N) and the weighted residuals, complex (R,). The R rows are the steps, the
        turns and the recorded positions, in this order, multiplied by the given weights."""
        count, tie_count, ties = len(self._recorded), len(self._ties), self._ties
        steps, turns = self._compute_residuals()
        unit = np.exp(-self.log[ties.place])
        row, places = np.arange(tie_count), np.arange(count)
        entries = (  # rows, columns and values
            (row, ties.query, step_weights * unit),
            (row, ties.place, -step_weights * unit),
            (row, count + ties.place, -step_weights * (steps + ties.step)),
            (tie_count + row, count + ties.query, turn_weights),
            (tie_count + row, count + ties.place, -turn_weights),
            (2 * tie_count + places, places, recorded_weights),
        )
        rows, columns, values = map(np.concatenate, zip(*entries, strict=True))
        jacobian = coo_matrix((values, (rows, columns)), shape=(2 * tie_count + count, 2 * count)).tocsc()
        from_recorded = recorded_weights * (self.position - self._recorded)
        return jacobian, np.concatenate([step_weights * steps, turn_weights * turns, from_recorded])


def _make_tie_matrix(ties: Ties, count: int) -> csc_matrix:
    return coo_matrix((ties.step_sd, (ties.query, ties.place)), (count, count)).tocsc()


def _fit_robust_similarity(shape: np.ndarray, recorded: np.ndarray) -> tuple[complex, complex]:
    """Return two complex numbers, `scale` (with rotation) and `offset`, such that scale * `shape` + offset fits
    `recorded`; both are points, complex (N,). Outliers are given little weight. For a single point the scale is 1."""
    weight = np.ones(len(shape))
    scale, offset = 1 + 0j, complex(recorded.mean() - shape.mean())
    for _ in range(20):
        new_scale, new_offset = fit_similarity(shape, recorded, weight)
        if abs(new_scale) < 1e-6:
            break
        scale, offset = new_scale, new_offset
        residuals = abs(scale * shape + offset - recorded)
        weight = _weigh_residuals(residuals / max(_MIN_RECORDED_SD_M, _estimate_sd(residuals))) + 1e-6
    return scale, offset


def _weigh_residuals(residuals: np.ndarray) -> np.ndarray:
    """Return the robust weights, 0..1, of residuals in standard deviations: 0.5 for a residual of three."""
    return 1 / (1 + (residuals / 4.66) ** 2) ** 2


def _estimate_sd(residuals: np.ndarray) -> float:
    """Estimate the standard deviation of complex residuals along one axis from their median, which ignores outliers."""
    return float(np.median(abs(residuals))) / 1.1774 if len(residuals) else 0.0


def _factorise(normal: csc_matrix) -> SuperLU:
    """Factorise a Hermitian positive definite matrix (M, M) as L D L^H, with its rows and columns reordered to keep L
    sparse. The factor `U` is D L^H."""
    damped = normal + _DIAGONAL_DAMPING * identity(normal.shape[0])
    return splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _invert_diagonal(normal: csc_matrix) -> Floats:
    """Return the diagonal of the inverse of a Hermitian positive definite matrix (M, M), float (M,).

    The inverse is computed only where L has entries, from the last column to the first (Takahashi, Fagan and Chen
    1973). A column needs the block of the inverse at its rows, which is part of the block of its parent: the column
    whose index is that of its first row.
    """
    factored = _factorise(normal)
    lower, pivots = factored.L.tocsc(), factored.U.diagonal().real
    lower.sort_indices()
    below = _find_rows_below(lower)
    pending_children = np.bincount([rows[0] for rows in below if len(rows)], minlength=len(below))  # per column
    blocks: dict[int, Complexes] = {}
    diagonal = np.empty(len(below))
    for column in reversed(range(len(below))):
        rows, stored = below[column], slice(lower.indptr[column] + 1, lower.indptr[column + 1])
        block = np.empty((len(rows) + 1, len(rows) + 1), complex)
        block[0, 0] = 1 / pivots[column]
        if len(rows):
            parent = int(rows[0])
            indices = np.searchsorted(np.append(parent, below[parent]), rows)
            block[1:, 1:] = blocks[parent][np.ix_(indices, indices)]
            factors = np.zeros(len(rows), complex)
            factors[np.searchsorted(rows, lower.indices[stored])] = lower.data[stored]
            block[1:, 0] = -block[1:, 1:] @ factors
            block[0, 1:] = block[1:, 0].conj()
            block[0, 0] -= np.vdot(factors, block[1:, 0])
            pending_children[parent] -= 1
            if not pending_children[parent]:
                del blocks[parent]
        if pending_children[column]:
            blocks[column] = block
        diagonal[column] = block[0, 0].real
    return np.asarray(diagonal[factored.perm_c])


def _find_rows_below(lower: csc_matrix) -> list[Array]:
    """Return, for each column of the factor L (M, M), the indices of the rows below the diagonal that may have entries:
    M arrays, int (R,), ascending. They include entries that are zero by chance and therefore not stored."""
    starts, ends = lower.indptr[:-1] + 1, lower.indptr[1:]
    below = [lower.indices[start:end] for start, end in zip(starts, ends, strict=True)]
    for rows in below:
        if len(rows):
            below[rows[0]] = np.union1d(below[rows[0]], rows[1:])
    return below
