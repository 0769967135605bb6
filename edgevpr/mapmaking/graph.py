"""The pose graph of a map: solves for the position, direction and footprint of each picture that fit best, by least
squares, to recorded positions and to ties. A tie is the relative pose of two pictures that show the same ground.

A place has two complex unknowns. Its position p is east + i north, in metres. Its *log* l is a complex logarithm that
holds the footprint and the direction: exp(l) = footprint_m exp(-i up), a factor that turns an offset in the picture
(right + i up, in shares of its longest side) into one on the ground. In a tie, `step` is the offset of the middle of
picture `query` from the middle of picture `place`, in picture `place`, and exp(`turn`) is the rotation and scale of
`query` against `place`:

    (p_query - p_place) exp(-l_place) = step        l_query - l_place = turn

Both are holomorphic, so that least squares over complex numbers is exact, with half the unknowns. Steps are compared in
the picture and not on the ground: otherwise a map shrunk to a point would fulfil all ties. Recorded positions fix
position, scale and direction of the whole. Steps, turns and recorded positions are weighted by their standard
deviations ("scatter"), estimated from the residuals; those that contradict the others get little weight (Geman and
McClure 1987).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import SuperLU, splu

from edgevpr.core.arrays import Array, Complexes, Floats
from edgevpr.core.geodesy import fit_similarity
from edgevpr.core.text import show_elapsed

_MAX_ROUNDS = 4  # of estimating the standard deviations
_MIN_SD_CHANGE = 0.05  # relative; a smaller one ends the rounds
_MAX_STEPS = 40  # of Gauss-Newton
_MIN_MOVE = 1e-4  # as a share of a footprint; a smaller one ends the steps
_MAX_LOG_MOVE = 0.5  # largest change of a log in one Gauss-Newton step
# Factor from the given to the real standard deviations of ties: the first estimate, and the least, since ties that
# agree well by chance must not make the others look wrong.
_INITIAL_TIE_FACTOR = 3.0
_MIN_TIE_FACTOR = 0.5
_MIN_RECORDED_SD_M = 0.5
_INITIAL_RECORDED_SD_M = 10.0
_MIN_AGREEMENT = 0.1  # a tie or position with a smaller weight counts as contradicting the others
_MEDIAN_LENGTH = 1.832  # median length of a vector of four standard normal numbers
_DIAGONAL_DAMPING = 1e-6  # added to the diagonal, so that places without ties can be solved


@dataclass(frozen=True, slots=True, kw_only=True)
class Ties:
    """T pairs of pictures of the same ground: `query` and `place`, int (T,), are the numbers of the two pictures.
    `step` and `turn`, complex (T,), are defined in the module's docstring. `step_sd` and `turn_sd`, float (T,), are the
    standard deviations of both along one axis, up to a factor that all share, which `solve_graph` estimates."""

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
    (N,): footprint and direction, see the module.
    `position_var` (m^2) and `log_var`, float (N,): variances of `position` and `log`, summed over both axes.
    `component`, int (N,): number of the group of places, connected by ties, that each place belongs to.
    `recorded_sd_m`: estimated standard deviation of recorded positions along one axis.
    `recorded_agree` (N,), `ties_agree` (T,): bool, False for positions and ties that contradict the others."""

    position: np.ndarray
    log: np.ndarray
    position_var: np.ndarray
    log_var: np.ndarray
    component: np.ndarray
    recorded_sd_m: float
    recorded_agree: np.ndarray
    ties_agree: np.ndarray


@show_elapsed("refining: solving where all pictures lie")
def solve_graph(recorded: np.ndarray, ties: Ties) -> GraphSolution:
    """Solve the pose graph of N places by least squares. `recorded`, complex (N,): the recorded positions, east + i
    north in metres. One standard deviation is estimated for all of them."""
    count = len(recorded)
    _, component = connected_components(_make_tie_matrix(ties, count), directed=False)
    graph = _Graph(recorded, ties, component)
    factor, recorded_sd_m = _INITIAL_TIE_FACTOR, _INITIAL_RECORDED_SD_M
    for _ in range(_MAX_ROUNDS):
        before, sd_m = factor, recorded_sd_m
        normal, agree = graph.optimise(sd_m, factor)
        variance = 2 * _invert_diagonal(normal)  # the weights are of one axis, the variance of both
        if len(ties):
            # Unknowns absorb a part of the residuals: the estimate is corrected by the share of spare observations.
            spare = max(2 * len(ties) - 2 * (count - len(np.unique(component))), 1) / (2 * len(ties))
            median = float(np.median(graph.compute_tie_residuals()))
            factor = max(_MIN_TIE_FACTOR, median / _MEDIAN_LENGTH / np.sqrt(spare))
        off_m = abs(graph.position - recorded)
        # Residual plus the variance of the solution: with few ties, the solution follows every recorded error.
        total_var_m2 = _estimate_sd(off_m) ** 2 + np.median(variance[:count]) / 2
        recorded_sd_m = max(_MIN_RECORDED_SD_M, float(np.sqrt(total_var_m2)))
        if abs(np.log(before / factor)) < _MIN_SD_CHANGE and abs(np.log(sd_m / recorded_sd_m)) < _MIN_SD_CHANGE:
            break
    return GraphSolution(
        position=graph.position,
        log=graph.log,
        position_var=variance[:count],
        log_var=variance[count:],
        component=component,
        recorded_sd_m=recorded_sd_m,
        recorded_agree=_weigh_residuals(off_m / sd_m) >= _MIN_AGREEMENT,
        ties_agree=agree >= _MIN_AGREEMENT,
    )


class _Graph:
    """The least-squares problem of `solve_graph`: N places with T ties, their recorded positions, and the solution so
    far, `position` and `log`, complex (N,) each."""

    def __init__(self, recorded: np.ndarray, ties: Ties, component: np.ndarray) -> None:
        """Make the first solution: place the pictures of each component one after the other along its most exact ties,
        then fit the component as a whole to its recorded positions."""
        self._recorded, self._ties = recorded, ties
        count = len(recorded)
        position, log = np.zeros(count, complex), np.zeros(count, complex)
        tree = minimum_spanning_tree(_make_tie_matrix(ties, count))
        tie_of = {}
        for at in np.argsort(-ties.step_sd, kind="stable").tolist():  # the most exact tie of a pair comes last
            query, place, step, turn = int(ties.query[at]), int(ties.place[at]), ties.step[at], ties.turn[at]
            tie_of[query, place], tie_of[place, query] = (step, turn), (-step * np.exp(-turn), -turn)
        for number in range(component.max(initial=-1) + 1):
            members = np.flatnonzero(component == number)
            order, before = breadth_first_order(tree, members[0], directed=False)
            for at in order[1:].tolist():
                base = int(before[at])
                step, turn = tie_of[at, base]
                position[at], log[at] = position[base] + np.exp(log[base]) * step, log[base] + turn
            scale, offset = _fit_robust_similarity(position[members], recorded[members])
            position[members] = scale * position[members] + offset
            log[members] += np.log(scale)
        self.position, self.log = position, log

    def optimise(self, sd_m: float, factor: float) -> tuple[csc_matrix, np.ndarray]:
        """Solve for positions and logs by Gauss-Newton steps. The standard deviation of recorded positions is `sd_m`,
        and those of the ties are multiplied by `factor`. Returns the normal matrix (2 N, 2 N), and the robust weight of
        each tie, float (T,), 0..1."""
        count, ties = len(self.position), self._ties
        for _ in range(_MAX_STEPS):
            agree = _weigh_residuals(self.compute_tie_residuals() / factor)
            by_step, by_turn = (agree / (factor * sd) ** 2 for sd in (ties.step_sd, ties.turn_sd))
            by_recorded = _weigh_residuals(abs(self.position - self._recorded) / sd_m) / sd_m**2
            jacobian, rest = self._linearise(*map(np.sqrt, (by_step, by_turn, by_recorded)))
            normal = (jacobian.conj().T @ jacobian).tocsc()
            move = _factorise(normal).solve(-(jacobian.conj().T @ rest))
            # A long move is shortened: far from the solution the logs are not linear.
            share = min(1.0, _MAX_LOG_MOVE / max(abs(move[count:]).max(initial=0), 1e-9))
            self.position, self.log = self.position + share * move[:count], self.log + share * move[count:]
            if (abs(move[:count]) < _MIN_MOVE * np.exp(self.log.real)).all():
                break
        return normal, agree

    def compute_tie_residuals(self) -> Floats:
        """Return how far each tie differs from the solution, in standard deviations of the tie: float (T,)."""
        steps, turns = self._compute_residuals()
        off: Floats = np.hypot(abs(steps) / self._ties.step_sd, abs(turns) / self._ties.turn_sd)
        return off

    def _compute_residuals(self) -> tuple[Complexes, Complexes]:
        """Return how much the solution so far differs from the ties: in steps and in turns, complex (T,) each."""
        position, log, ties = self.position, self.log, self._ties
        steps = (position[ties.query] - position[ties.place]) * np.exp(-log[ties.place]) - ties.step
        turns = log[ties.query] - log[ties.place] - ties.turn
        return steps, turns.real + 1j * ((turns.imag + np.pi) % (2 * np.pi) - np.pi)

    def _linearise(
        self, by_step: np.ndarray, by_turn: np.ndarray, by_recorded: np.ndarray
    ) -> tuple[csc_matrix, np.ndarray]:
        """Return the weighted Jacobian (R, 2 N) and the weighted residuals, complex (R,). The R rows are those of the
        steps, the turns and the recorded positions, in this order; the arguments are the weights."""
        count, many, ties = len(self._recorded), len(self._ties), self._ties
        steps, turns = self._compute_residuals()
        unit = np.exp(-self.log[ties.place])
        row, places = np.arange(many), np.arange(count)
        entries = (  # rows, columns and values
            (row, ties.query, by_step * unit),
            (row, ties.place, -by_step * unit),
            (row, count + ties.place, -by_step * (steps + ties.step)),
            (many + row, count + ties.query, by_turn),
            (many + row, count + ties.place, -by_turn),
            (2 * many + places, places, by_recorded),
        )
        rows, columns, values = map(np.concatenate, zip(*entries, strict=True))
        jacobian = coo_matrix((values, (rows, columns)), shape=(2 * many + count, 2 * count)).tocsc()
        from_recorded = by_recorded * (self.position - self._recorded)
        return jacobian, np.concatenate([by_step * steps, by_turn * turns, from_recorded])


def _make_tie_matrix(ties: Ties, count: int) -> csc_matrix:
    return coo_matrix((ties.step_sd, (ties.query, ties.place)), (count, count)).tocsc()


def _fit_robust_similarity(shape: np.ndarray, recorded: np.ndarray) -> tuple[complex, complex]:
    """Return two complex numbers, the factor `scale`, which also rotates, and `offset`, so that scale * `shape` +
    offset fits `recorded`; both are points, complex (N,). Outliers get little weight. For one point, the scale is 1."""
    weight = np.ones(len(shape))
    scale, offset = 1 + 0j, complex(recorded.mean() - shape.mean())
    for _ in range(20):
        fitted, shift = fit_similarity(shape, recorded, weight)
        if abs(fitted) < 1e-6:
            break
        scale, offset = fitted, shift
        off = abs(scale * shape + offset - recorded)
        weight = _weigh_residuals(off / max(_MIN_RECORDED_SD_M, _estimate_sd(off))) + 1e-6
    return scale, offset


def _weigh_residuals(off: np.ndarray) -> np.ndarray:
    """Return the robust weight, 0..1, of residuals `off` in standard deviations: 0.5 for a residual of three."""
    return 1 / (1 + (off / 4.66) ** 2) ** 2


def _estimate_sd(residuals: np.ndarray) -> float:
    """Estimate the standard deviation along one axis of complex residuals from their median, so ignoring outliers."""
    return float(np.median(abs(residuals))) / 1.1774 if len(residuals) else 0.0


def _factorise(normal: csc_matrix) -> SuperLU:
    """Factor a Hermitian positive definite matrix (M, M) as L D L^H, its rows and columns in an order that keeps L
    sparse. The factor `U` is D L^H."""
    filled = normal + _DIAGONAL_DAMPING * identity(normal.shape[0])
    return splu(filled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _invert_diagonal(normal: csc_matrix) -> Floats:
    """Return the diagonal of the inverse of a Hermitian positive definite matrix (M, M), float (M,).

    Only entries of the inverse where L has entries are computed, from the last column to the first (Takahashi, Fagan
    and Chen 1973). A column needs the block of the inverse over its rows. That is a part of the block of the column's
    parent, which is the column with the number of its first row.
    """
    factored = _factorise(normal)
    lower, pivots = factored.L.tocsc(), factored.U.diagonal().real
    lower.sort_indices()
    below = _find_rows_below(lower)
    waiting = np.bincount([rows[0] for rows in below if len(rows)], minlength=len(below))  # children of a column
    blocks: dict[int, Complexes] = {}
    found = np.empty(len(below))
    for column in reversed(range(len(below))):
        rows, given = below[column], slice(lower.indptr[column] + 1, lower.indptr[column + 1])
        block = np.empty((len(rows) + 1, len(rows) + 1), complex)
        block[0, 0] = 1 / pivots[column]
        if len(rows):
            parent = int(rows[0])
            inside = np.searchsorted(np.append(parent, below[parent]), rows)
            block[1:, 1:] = blocks[parent][np.ix_(inside, inside)]
            factors = np.zeros(len(rows), complex)
            factors[np.searchsorted(rows, lower.indices[given])] = lower.data[given]
            block[1:, 0] = -block[1:, 1:] @ factors
            block[0, 1:] = block[1:, 0].conj()
            block[0, 0] -= np.vdot(factors, block[1:, 0])
            waiting[parent] -= 1
            if not waiting[parent]:
                del blocks[parent]
        if waiting[column]:
            blocks[column] = block
        found[column] = block[0, 0].real
    in_order: Floats = found[factored.perm_c]
    return in_order


def _find_rows_below(lower: csc_matrix) -> list[Array]:
    """Return the numbers of the rows below the diagonal where a column of the factor L (M, M) may have entries: M
    arrays, int (R,), ascending. An entry that is zero by chance, and so not stored, counts."""
    starts, ends = lower.indptr[:-1] + 1, lower.indptr[1:]
    below = [lower.indices[start:end] for start, end in zip(starts, ends, strict=True)]
    for rows in below:
        if len(rows):
            below[rows[0]] = np.union1d(below[rows[0]], rows[1:])
    return below
