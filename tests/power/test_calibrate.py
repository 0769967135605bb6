"""The straight line through measured power, on made-up samples and on a machine that is made of files."""

import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from edgevpr.power import busy
from edgevpr.power.calibrate import LOADS, calibrate, fit_power
from edgevpr.power.powermeter import Meter, MeterError
from edgevpr.power.sensors import find_meters

CURRENT = "sys/class/hwmon/hwmon0/curr1_input"


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
    ("samples", "sentence"),
    [
        ([], "measured at 0 different loads; a line needs 3"),
        ([(0.5, 4.0)] * 5, "measured at 1 different loads"),
        ([(0.0, 2.0), (0.02, 2.1), (0.9, 6.0), (0.92, 6.1)], "measured at 2 different loads"),
        ([(0.2, 0.5), (0.6, 3.0), (1.0, 5.5)], "would be -0.75 W at idle, which cannot be"),
        ([(0.0, 5.0), (0.5, 4.0), (1.0, 3.0)], r"does not follow the load \(-2 W"),
        ([(0.0, 5.0), (0.5, 5.0), (1.0, 5.0)], "does not follow the load"),
        ([(0.0, 5.0), (0.3, 4.0), (0.6, 6.0), (1.0, 5.1)], r"does not follow the load \(0.644 W .*, R2 0.11\)"),
        ([(0.0, 2.0), (0.5, float("nan")), (1.0, 3.0)], "is not a number"),
    ],
)
def test_figures_that_no_board_can_have_are_one_sentence(samples, sentence):
    with pytest.raises(MeterError, match=sentence):
        fit_power(samples)


class Board:
    """A machine of files: its load, its power (2 W + 3 W U over an INA219 at 5 V) and its ticks follow a fake clock."""

    def __init__(self, tree, clock):
        self._tree, self.clock, self.share, self.ticks = tree, clock, 0.0, [0.0, 0.0]
        self.root = tree({"sys/class/hwmon/hwmon0/name": "ina219", "sys/class/hwmon/hwmon0/in1_input": "5000"})
        self.sleep(0.0)

    def sleep(self, seconds):
        self.clock.sleep(seconds)
        # Another program takes 0.04 of the machine all the time.
        self.share_now = min(1.0, self.share + 0.04)
        self.ticks[0] += 400 * seconds * self.share_now
        self.ticks[1] += 400 * seconds * (1 - self.share_now)
        user, idle = self.ticks
        self._tree(
            {
                "proc/stat": f"cpu  {user:.0f} 0 0 {idle:.0f} 0 0 0 0 0 0\ncpu0 1 2 3\n",
                CURRENT: f"{(2.0 + 3.0 * self.share_now) / 5 * 1000:.6f}\n",
            }
        )

    @contextmanager
    def load(self, share):
        self.share = share
        yield
        self.share = 0.0


def run(board, meter=None):
    (found,) = find_meters(board.root).meters
    return calibrate(
        meter or found, window_s=2, settle_s=1, root=board.root, clock=board.clock, sleep=board.sleep, load=board.load
    )


def test_a_board_is_calibrated_with_what_the_whole_machine_did(tree, clock):
    calibration = run(Board(tree, clock))
    assert (calibration.fit.idle_w, calibration.fit.full_w) == pytest.approx((2.0, 5.0), abs=0.002)
    assert [u for u, _ in calibration.fit.samples] == pytest.approx([0.04, 0.29, 0.54, 0.79, 1.0], abs=0.002)
    assert calibration.source.startswith("straight line through 5 loads measured on this machine with its INA219")
    assert "taken to be wired to the board's input" in calibration.source
    assert not calibration.verified, "nobody has said where this meter is"
    labelled = replace(calibration, meter=replace(calibration.meter, certain=True))
    assert labelled.verified


def test_a_meter_that_goes_while_calibrating_is_one_sentence(tree, clock):
    board = Board(tree, clock)
    (board.root / CURRENT).unlink()
    (meter,) = find_meters(board.root).meters
    clock.at(7.0, (board.root / "sys/class/hwmon/hwmon0/in1_input").unlink)
    with pytest.raises(MeterError, match="failed 3 times in a row"):
        run(board, meter)


def test_a_meter_of_the_cpu_alone_verifies_no_board(clock, tree):
    board = Board(tree, clock)
    meter = Meter(
        kind="rapl",
        title="RAPL (1 CPU package)",
        covers="cpu",
        period_s=1.0,
        look=lambda: (10 * clock() + board.ticks[0] / 40,),
        wraps_j=(1e6,),
    )
    calibration = run(board, meter)
    assert calibration.fit.idle_w == pytest.approx(10, abs=0.05)
    assert not calibration.verified
    assert calibration.source.startswith("CPU only, the rest of the board draws more; ")


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_work_and_rest_are_as_asked_however_long_one_call_takes(share):
    now_s, worked_s, rested_s = [0.0], 0.0, 0.0

    def work():
        now_s[0] += 0.013

    for _ in range(50):
        before_s = now_s[0]
        rest_s = busy.duty(share, work, lambda: now_s[0])
        worked_s, rested_s = worked_s + now_s[0] - before_s, rested_s + rest_s
    assert worked_s / (worked_s + rested_s) == pytest.approx(share, abs=1e-9)


def test_no_load_does_not_work():
    assert busy.duty(0.0, lambda: pytest.fail("it works")) == busy.PERIOD_S


def test_the_real_load_keeps_this_process_busy_and_ends():
    with busy.load(0.5, threads=1):
        before_s, start_s = time.process_time(), time.monotonic()
        time.sleep(0.6)
        share = (time.process_time() - before_s) / (time.monotonic() - start_s)
    # Other programs may take the core away: less than asked is possible, more is not.
    assert 0.02 < share < 0.75
    before_s = time.process_time()
    time.sleep(0.1)
    assert time.process_time() - before_s < 0.05


def test_utilisation_is_the_busy_share_of_all_ticks(tree):
    before = busy.cpu_times(tree({"proc/stat": "cpu  90 0 50 800 50 0 0 10 30 0\ncpu0 1\n"}))
    after = busy.cpu_times(tree({"proc/stat": "cpu  170 5 55 850 100 0 0 20 90 0\ncpu0 1\n"}))
    assert before == (150.0, 1000.0)
    assert busy.utilisation(before, after) == pytest.approx(0.5)
    assert busy.utilisation(after, after) == 0.0
