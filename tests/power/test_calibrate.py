"""The straight line through measured power, on made-up samples and on the real machine; and loads that are held."""

import time

import numpy as np
import pytest

from edgevpr.power import calibrate as calibrating
from edgevpr.power.boards import load_board
from edgevpr.power.calibrate import (
    DUTY_PERIOD_S,
    LOADS,
    Meter,
    MeterError,
    calibrate,
    fit_power,
    hold_load,
    measure_at,
    work_a_period,
)

METER = Meter(title="INA3221 (hwmon1), channel VDD_IN", look=lambda: 4.0)


def test_a_perfect_line_is_found_exactly():
    fit = fit_power([(u, 2.29 + 4.53 * u) for u in LOADS])
    assert (fit.idle_w, fit.span_w, fit.full_w) == pytest.approx((2.29, 4.53, 6.82), abs=1e-12)
    assert fit.residual_w == pytest.approx(0, abs=1e-12)
    assert fit.r2 == pytest.approx(1, abs=1e-12)


def test_noise_shows_as_residual_and_hardly_moves_the_line():
    random = np.random.default_rng(3)
    u = random.uniform(0, 1, 400)
    fit = fit_power(list(zip(u, 2.29 + 4.53 * u + random.normal(0, 0.1, 400), strict=True)))
    assert (fit.idle_w, fit.span_w) == pytest.approx((2.29, 4.53), abs=0.05)
    assert fit.residual_w == pytest.approx(0.1, rel=0.1)
    assert fit.r2 == pytest.approx(1 - 0.01 / (0.01 + 4.53**2 / 12), abs=0.002)


@pytest.mark.parametrize(
    ("samples", "word"),
    [
        ([], "0 different loads"),
        ([(0.5, 4.0)] * 5, "1 different loads"),
        ([(0.0, 2.0), (0.02, 2.1), (0.9, 6.0), (0.91, 6.1)], "2 different loads"),
        ([(0.2, 0.5), (0.6, 3.0), (1.0, 5.5)], "-0.75 W idle"),
        ([(0.0, 5.0), (0.5, 4.0), (1.0, 3.0)], "-2 W more"),
        ([(0.0, 5.0), (0.5, 5.0), (1.0, 5.0)], "of no board"),
        ([(0.0, 5.0), (0.3, 4.0), (0.6, 6.0), (1.0, 5.1)], r"0.644 W .*, R2 0.11"),
    ],
)
def test_figures_that_no_board_can_have_are_one_sentence(samples, word):
    with pytest.raises(MeterError, match=word):
        fit_power(samples)


def test_a_board_gets_the_watts_at_what_the_whole_machine_did(monkeypatch):
    held = []
    # Another program takes 0.04 of the machine all the time.
    shares = {share: min(1.0, share + 0.04) for share in LOADS}
    measured = {share: (there, 2.0 + 3.0 * there) for share, there in shares.items()}
    monkeypatch.setattr(calibrating, "measure_at", lambda meter, share: measured[share])
    fit = calibrate(METER, held.append)
    assert tuple(held) == LOADS
    assert [u for u, _ in fit.samples] == pytest.approx([0.04, 0.29, 0.54, 0.79, 1.0])
    board = fit.applied_to(load_board("rpi-4b"), METER)
    assert (board.idle_w, board.full_w, board.verified) == (pytest.approx(2.0), pytest.approx(5.0), True)
    assert board.source.startswith("straight line through 5 loads measured on this machine with its INA3221 (hwmon1)")
    assert not fit.applied_to(board, Meter(title="INA219", look=METER.look, certain=False)).verified


@pytest.mark.slow
def test_the_load_and_the_watts_of_the_real_machine_are_measured_together():
    share, mean_w = measure_at(METER, 1.0, settle_s=0.1, window_s=0.5)
    assert 0.2 < share <= 1
    assert mean_w == pytest.approx(4.0)


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_work_and_rest_are_as_asked_however_long_one_call_takes(share):
    now_s, worked_s, rested_s = [0.0], 0.0, 0.0

    def work():
        now_s[0] += 0.013

    for _ in range(50):
        before_s = now_s[0]
        rest_s = work_a_period(share, work, lambda: now_s[0])
        worked_s, rested_s = worked_s + now_s[0] - before_s, rested_s + rest_s
    assert worked_s / (worked_s + rested_s) == pytest.approx(share, abs=1e-9)
    assert worked_s >= 50 * share * DUTY_PERIOD_S


@pytest.mark.slow
def test_the_real_load_keeps_this_process_busy_and_ends(monkeypatch):
    monkeypatch.setattr(calibrating.os, "sched_getaffinity", lambda pid: {0})
    with hold_load(0.5):
        before_s, start_s = time.process_time(), time.monotonic()
        time.sleep(0.6)
        share = (time.process_time() - before_s) / (time.monotonic() - start_s)
    # Other programs may take the core away: less than asked is possible, more is not.
    assert 0.02 < share < 0.75
    before_s = time.process_time()
    time.sleep(0.1)
    assert time.process_time() - before_s < 0.05
