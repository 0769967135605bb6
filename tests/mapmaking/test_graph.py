"""The pose graph: positions, directions and footprints from ties and recorded positions, on flights that are known."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix, identity

from edgevpr.mapmaking.graph import Ties, _invert_diagonal, solve_graph

FOOTPRINT_M = 60.0
SPACING_M = 15.0
STEP_SD = 0.01
TURN_SD = 0.03
RECORDED_SD_M = 8.0


def fly_legs(legs=5, a_leg=12, seed=0):
    """Return positions complex (N,) and logs of pictures along parallel legs, flown to and fro."""
    rng = np.random.default_rng(seed)
    east, north = np.meshgrid(np.arange(a_leg) * SPACING_M, np.arange(legs) * 2 * SPACING_M)
    east[1::2] = east[1::2, ::-1]
    position = (east + 1j * north).ravel()
    up_deg = np.repeat(np.where(np.arange(legs) % 2, 270.0, 90.0), a_leg) + rng.normal(0, 5, legs * a_leg)
    return position, np.log(FOOTPRINT_M * rng.uniform(0.9, 1.1, len(position))) - 1j * np.radians(up_deg)


def make_ties(position, log, seed=0, wrong=0.0, within=0.6):
    """Return noisy ties of all pairs that overlap; a share of them is wrong."""
    rng = np.random.default_rng((seed, 1))
    query, place = np.nonzero(np.tril(abs(position[:, None] - position) < within * FOOTPRINT_M, -1))

    def draw_noise(sd):
        return sd * (rng.normal(size=len(query)) + 1j * rng.normal(size=len(query)))

    step = (position[query] - position[place]) * np.exp(-log[place]) + draw_noise(STEP_SD)
    turn = log[query] - log[place] + draw_noise(TURN_SD)
    lies = rng.random(len(query)) < wrong
    step[lies] = rng.uniform(-0.5, 0.5, lies.sum()) + 1j * rng.uniform(-0.5, 0.5, lies.sum())
    turn[lies] = 1j * rng.uniform(-np.pi, np.pi, lies.sum())
    step_sd, turn_sd = np.full(len(query), STEP_SD), np.full(len(query), TURN_SD)
    return Ties(query=query, place=place, step=step, turn=turn, step_sd=step_sd, turn_sd=turn_sd), lies


def record_positions(position, seed=0):
    rng = np.random.default_rng((seed, 2))
    return position + RECORDED_SD_M * (rng.normal(size=len(position)) + 1j * rng.normal(size=len(position)))


def rms(values):
    return float(np.sqrt(np.mean(abs(values) ** 2) / 2))


def measure_errors(solved, position, log):
    """Errors of positions, m, and of logs; the imaginary part of a log is an angle."""
    turned = solved.log - log
    return solved.position - position, turned.real + 1j * ((turned.imag + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_solve_graph_corrects_noisy_positions_and_lists_wrong_ties(wrong):
    position, log = fly_legs()
    ties, lies = make_ties(position, log, wrong=wrong)
    solved = solve_graph(record_positions(position), ties)
    off_m, turned = measure_errors(solved, position, log)
    assert rms(off_m) < RECORDED_SD_M / 3
    assert rms(off_m - off_m.mean()) < RECORDED_SD_M / 4
    assert rms(turned) < 0.06
    assert not solved.ties_agree[lies].any()
    assert solved.ties_agree[~lies].mean() > 0.97
    assert solved.recorded_sd_m == pytest.approx(RECORDED_SD_M, rel=0.25)


@pytest.mark.slow
def test_solve_graph_covariances_match_the_errors():
    position, log = fly_legs(legs=3, a_leg=8)
    far, turned = [], []
    for seed in range(30):
        ties, _ = make_ties(position, log, seed)
        solved = solve_graph(record_positions(position, seed), ties)
        off_m, off_log = measure_errors(solved, position, log)
        far.append(off_m / np.sqrt(solved.position_var / 2))
        turned.append(off_log / np.sqrt(solved.log_var / 2))
    for each in (far, turned):
        one_axis = np.concatenate([np.real(each).ravel(), np.imag(each).ravel()])
        assert np.mean(abs(one_axis) < 1) == pytest.approx(0.68, abs=0.08)
        assert np.mean(abs(one_axis) < 2) == pytest.approx(0.95, abs=0.03)


def test_variances_equal_those_of_the_full_inverse_even_if_entries_cancel():
    rng = np.random.default_rng(1)
    for _ in range(400):  # with so few different values, entries of the factor are zero by chance in one of 400
        places, ties = int(rng.integers(5, 60)), int(rng.integers(60, 200))
        values, columns = rng.choice([-1, 0, 0, 1, 1j, -1], (2, ties)), rng.integers(0, places, (2, ties))
        rows = np.tile(np.arange(ties), (2, 1))
        jacobian = coo_matrix((values.ravel().astype(complex), (rows.ravel(), columns.ravel())), (ties, places)).tocsc()
        normal = (jacobian.conj().T @ jacobian + identity(places)).tocsc()
        expected = np.linalg.inv(normal.toarray()).diagonal().real
        np.testing.assert_allclose(_invert_diagonal(normal), expected, rtol=1e-4)
