"""Mean power with a fake clock: trapezoids, counters that wrap, meters that fail on the way."""

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.power.mean_power import mean_power
from edgevpr.power.powermeter import Meter, MeterError


def watts(clock, power, period_s=0.1):
    """A meter of watts: `power` of seconds since the start; a text instead of a number is a failure."""

    def look():
        value = power(clock() - 1000.0)
        if isinstance(value, str):
            raise MeterError(value)
        return (value,)

    return Meter(kind="ina", title="INA219 (hwmon0)", covers="board", period_s=period_s, look=look)


def joules(clock, power_w, wraps_j, first_j):
    def look():
        passed_s = clock() - 1000.0
        return tuple((first + power_w * passed_s) % wrap for first, wrap in zip(first_j, wraps_j, strict=True))

    return Meter(kind="rapl", title="RAPL", covers="cpu", period_s=1.0, look=look, wraps_j=wraps_j)


def test_a_ramp_is_integrated_exactly(clock):
    found = mean_power(watts(clock, lambda t_s: 2.0 + 0.3 * t_s), 10.0, clock, clock.sleep)
    assert found.mean_w == pytest.approx(3.5, abs=1e-9)
    assert (found.window_s, found.readings, found.skipped) == (pytest.approx(10.0), 101, 0)


def test_readings_that_come_late_weigh_by_their_time(clock):
    """Every second sleep takes three times as long: a plain mean of the readings would be wrong."""
    late = [False]

    def sleep(seconds):
        late[0] = not late[0]
        clock.sleep(seconds * (3 if late[0] else 1))

    found = mean_power(watts(clock, lambda t_s: 10.0 * t_s), 4.0, clock, sleep)
    assert found.mean_w == pytest.approx(10.0 * found.window_s / 2, rel=1e-9)


def test_counters_that_wrap_go_on_each_for_itself(clock):
    # 50 W each: the first wraps after 1 s and every 2 s, the second once after 6 s.
    meter = joules(clock, 50.0, wraps_j=(100.0, 1000.0), first_j=(50.0, 700.0))
    found = mean_power(meter, 10.0, clock, clock.sleep)
    assert found.mean_w == pytest.approx(100.0, abs=1e-9)


def test_a_counter_that_was_reset_is_no_power(clock):
    start_j = [5000.0]
    meter = Meter(
        kind="rapl",
        title="RAPL",
        covers="cpu",
        period_s=1.0,
        look=lambda: (start_j[0] + clock() - 1000.0,),
        wraps_j=(262143.0,),
    )
    clock.at(4.5, lambda: start_j.__setitem__(0, 0.0))
    with pytest.raises(MeterError, match=r"RAPL failed 3 times in a row; the last time: its counter moved by"):
        mean_power(meter, 10.0, clock, clock.sleep)


def test_single_failures_are_left_out_and_counted(clock):
    def power(t_s):
        return "it stutters" if round(t_s * 10) % 7 == 3 else 2.0 + 0.3 * t_s

    found = mean_power(watts(clock, power), 10.0, clock, clock.sleep)
    assert found.mean_w == pytest.approx(3.5, abs=1e-9)
    assert (found.readings, found.skipped) == (101 - 14, 14)


def test_nonsense_between_good_readings_is_left_out(clock):
    found = mean_power(watts(clock, lambda t_s: 5e6 if 2.05 < t_s < 2.15 else 4.0), 5.0, clock, clock.sleep)
    assert (found.mean_w, found.skipped) == (pytest.approx(4.0), 1)


def test_a_meter_that_disappears_midway_is_an_error_and_no_mean(clock):
    meter = watts(clock, lambda t_s: 4.0 if t_s < 6 else "/sys/x cannot be read: the power meter is gone.")
    with pytest.raises(MeterError) as raised:
        mean_power(meter, 10.0, clock, clock.sleep)
    assert str(raised.value) == (
        "INA219 (hwmon0) failed 3 times in a row; the last time: /sys/x cannot be read: the power meter is gone."
    )
    assert clock() < 1000 + 6.5  # it does not go on for the rest of the window


def test_a_meter_that_fails_more_than_it_works_is_an_error(clock):
    meter = watts(clock, lambda t_s: 4.0 if round(t_s * 10) % 3 == 0 else "it stutters")
    with pytest.raises(MeterError, match=r"gave 34 usable readings in 9.9 s and failed 66 times"):
        mean_power(meter, 9.9, clock, clock.sleep)


def test_a_slow_meter_is_still_read_at_both_ends(clock):
    found = mean_power(watts(clock, lambda t_s: t_s, period_s=60.0), 4.0, clock, clock.sleep)
    assert (found.readings, found.mean_w) == (2, pytest.approx(2.0))


@pytest.mark.parametrize("window_s", [0, -1, float("inf"), float("nan")])
def test_a_window_that_is_none_is_refused(clock, window_s):
    with pytest.raises(UsageError, match="give a time above 0"):
        mean_power(watts(clock, lambda t_s: 1.0), window_s, clock, clock.sleep)
