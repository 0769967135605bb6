"""The time at which pictures of a stream were taken, by their timestamps and by when they arrived."""

import math

import numpy as np
import pytest

from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames.age import StampedTime, UnstampedTime

STEP_S = 0.05
START_S = 1000.0


def feed_times(time, taken_s, came_s, *, rate=1.0, sizes=None, stamp_s=100.0):
    """Let pictures arrive that were taken and came at these times; their stamps run `rate` times as fast as the clock.
    Returns ages and standard deviations on arrival, NaN where they are unknown."""
    sizes = np.full(len(taken_s), 9000) if sizes is None else sizes
    ages_s, sds_s = [], []
    for taken, came, size in zip(taken_s, came_s, sizes, strict=True):
        stamp, now = stamp_s + rate * taken, START_S + came
        time.record_arrival(stamp, stamp, now, int(size))
        found = time.estimate(stamp, now)
        ages_s.append(math.nan if found is None else now - found.t_s)
        sds_s.append(math.nan if found is None else found.sd_s)
    return np.array(ages_s), np.array(sds_s)


def feed_delayed(time, delays_s, **more):
    """`feed` with a picture every 50 ms, each delayed by so much."""
    taken_s = STEP_S * np.arange(len(delays_s))
    return feed_times(time, taken_s, taken_s + delays_s, **more)[0]


def draw_sizes(pictures, rng, key_every=10, key_factor=2.2):
    """Bytes of pictures of which each tenth is decoded without others."""
    sizes = 20_000 * (1 + 0.1 * rng.standard_normal(pictures))
    sizes[::key_every] *= key_factor
    return sizes


def simulate_link(taken_s, sizes, bytes_per_s, rng, jitter_s=0.003):
    """Times at which pictures come, one after the other, through a link with the capacity `bytes_per_s(t_s)`."""
    now_s, came_s = 0.0, []
    for taken, size in zip(taken_s, sizes, strict=True):
        now_s = max(now_s, taken)
        now_s += size / bytes_per_s(now_s)
        came_s.append(now_s)
    return np.maximum.accumulate(np.array(came_s) + rng.exponential(jitter_s, len(came_s)))


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "s"), [(0.48, 4), (0.84, 4), (0.98, 1), (0.9999, 1), (1.0001, 1), (1.05, 1), (2, 7)])
@pytest.mark.parametrize("rate_hz", [12, 25])
def test_stamped_time_corrects_timestamps_of_another_rate(rate, s, rate_hz):
    """Three minutes, with jitter; a camera that stamps 25 pictures a second and delivers 12 has the rate 0.48."""
    rng = np.random.default_rng(1)
    taken_s = np.arange(180 * rate_hz) / rate_hz
    sizes = draw_sizes(len(taken_s), rng)
    came_s = np.maximum.accumulate(taken_s + rng.exponential(0.005, len(taken_s)))
    time = StampedTime()
    ages_s, sds_s = feed_times(time, taken_s, came_s, rate=rate, sizes=sizes)
    later = taken_s >= s
    errors_s = (ages_s - (came_s - taken_s))[later]
    assert not np.isnan(ages_s[later]).any()
    assert np.abs(errors_s).max() < 0.15
    assert np.abs(errors_s[-60 * rate_hz :]).max() < 0.03
    assert (np.abs(errors_s) < 3 * sds_s[later]).all()
    assert time.rate == pytest.approx(1 / rate, rel=0.003)
    assert np.isnan(ages_s).mean() < 0.04
    assert np.nanmax(ages_s) < 0.55, "nothing is known of the rate in the first second"


@pytest.mark.parametrize("key_factor", [2.2, 8.0])
@pytest.mark.parametrize(("slow", "lasts_s"), [(0.84, 20), (0.5, 4)])
def test_stamped_time_counts_congestion_as_age_and_not_as_clock_drift(slow, lasts_s, key_factor):
    """A link that carries 0.84 of what is sent makes the delay grow as straightly as stamps that run slow."""
    rng = np.random.default_rng(2)
    taken_s = np.arange(90 * 25) / 25
    sizes = draw_sizes(len(taken_s), rng, key_factor=key_factor)
    usual_bytes_s = 25 * sizes.mean()
    came_s = simulate_link(taken_s, sizes, lambda t_s: (slow if 30 <= t_s < 30 + lasts_s else 3) * usual_bytes_s, rng)
    time = StampedTime()
    ages_s, _ = feed_times(time, taken_s, came_s, sizes=sizes)
    is_known = ~np.isnan(ages_s)
    assert (came_s - taken_s).max() > 2
    assert np.abs(ages_s - (came_s - taken_s))[is_known].max() < 0.05
    assert is_known.mean() > 0.95
    assert time.rate == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_stamped_time_does_not_take_changing_congestion_for_clock_drift(seed):
    """Capacities of 0.3 to 1.3 of what is sent, each for some seconds, and pictures that are nearly all of one size."""
    rng = np.random.default_rng(seed)
    taken_s = np.arange(90 * 25) / 25
    sizes = draw_sizes(len(taken_s), rng, key_every=25, key_factor=1.0 + seed)
    capacities = 25 * sizes.mean() * np.where(np.arange(1000) < 2, 3, rng.uniform(0.3, 1.3, 1000))
    came_s = simulate_link(taken_s, sizes, lambda t_s: capacities[int(t_s / 4)], rng)
    ages_s, _ = feed_times(StampedTime(), taken_s, came_s, sizes=sizes)
    assert np.nanmin(ages_s - (came_s - taken_s)) > -0.1, "none is said to be younger than it is"


def test_stamped_time_is_unknown_if_congestion_and_clock_drift_look_alike():
    """Pictures of equal size come at equal intervals, 0.4 s a second too late."""
    ages_s = feed_delayed(StampedTime(), 0.02 * np.arange(1200))
    assert np.nanmax(ages_s) < 0.5
    assert np.isnan(ages_s[40:]).all()


def test_stamped_time_follows_a_camera_whose_clock_rate_becomes_correct():
    rng = np.random.default_rng(3)
    taken_s = np.cumsum(np.r_[np.full(12 * 30, 1 / 12), np.full(25 * 60, 1 / 25)])
    sizes = draw_sizes(len(taken_s), rng)
    time, ages_s = StampedTime(), []
    came_s = np.maximum.accumulate(taken_s + rng.exponential(0.005, len(taken_s)))
    for number, came in enumerate(came_s):
        time.record_arrival(number / 25, number / 25, came, int(sizes[number]))
        found = time.estimate(number / 25, came)
        ages_s.append(math.nan if found is None else came - found.t_s)
    assert np.nanmax(ages_s[60:]) < 0.2
    assert np.isnan(ages_s[60:]).mean() < 0.05


def test_stamped_time_counts_delay_beyond_the_minimum_as_age():
    delays_s = np.where((np.arange(100) >= 60) & (np.arange(100) < 70), 0.8, 0.0)
    assert feed_delayed(StampedTime(), delays_s)[3:] == pytest.approx(delays_s[3:], abs=0.001)


def test_images_buffered_before_opening_have_no_time():
    """Forty pictures are there at once, the last of them new; then one comes every 50 ms."""
    ages_s = feed_delayed(StampedTime(), np.maximum(0.0, 2.0 - np.arange(80) * STEP_S))
    assert np.isnan(ages_s[:40]).all()
    assert ages_s[50:] == pytest.approx(np.zeros(30), abs=0.001)


def test_stamped_time_is_never_after_arrival():
    time = StampedTime()
    feed_delayed(time, np.zeros(20))
    assert time.estimate(500.0, START_S + 1).t_s == START_S + 1


def test_stamped_time_counts_a_fluctuating_delay_as_age_while_it_lasts():
    """A network that is jammed for a minute, after ten pictures in time."""
    delays_s = np.where(np.arange(1200) < 10, 0.0, np.random.default_rng(1).uniform(2.0, 2.5, 1200))
    ages_s = feed_delayed(StampedTime(), delays_s)
    is_known = ~np.isnan(ages_s)
    assert ages_s[is_known] == pytest.approx(delays_s[is_known], abs=0.02)
    assert is_known.mean() > 0.9


def test_stamped_time_resets_ten_seconds_after_a_pause_missing_in_the_timestamps():
    ages_s = feed_delayed(StampedTime(), np.where(np.arange(400) >= 100, 1.5, 0.0))
    assert ages_s[100] == pytest.approx(1.5, abs=0.01)
    assert np.isnan(ages_s[160:200]).all(), "it may have paused, or all of them may be held up"
    assert ages_s[310:] == pytest.approx(np.zeros(90), abs=0.001)


@pytest.mark.parametrize("stamp_s", [0.0, 5000.0])
def test_stamped_time_follows_a_restarted_sender(stamp_s):
    time = StampedTime()
    feed_delayed(time, np.zeros(40))
    ages_s = feed_delayed(time, np.full(40, 10.0), stamp_s=stamp_s)
    assert np.isnan(ages_s[0])
    assert ages_s[5:] == pytest.approx(np.zeros(35), abs=0.001)


def test_stamped_time_does_not_restart_at_images_out_of_order():
    time, order = StampedTime(), [0, 3, 1, 2, 6, 4, 5, 9, 7, 8, 12, 10, 11]
    for turn, number in enumerate(order):
        now = START_S + turn * STEP_S
        time.record_arrival(number * STEP_S, (turn - 1) * STEP_S, now)
    assert time.estimate(11 * STEP_S, now) is not None


@pytest.mark.parametrize(("rate", "least_sd_s"), [(1.0, FRAME_TIME_SD_S), (0.48, 0.5)])
def test_age_is_less_certain_with_counted_timestamps(rate, least_sd_s):
    """A second in which nothing comes is the age of its picture by a clock; but a camera may have waited with it."""
    rng = np.random.default_rng(4)
    taken_s = np.arange(20 * 25) / 25
    came_s = taken_s + rng.uniform(0, 0.002, len(taken_s))
    came_s[-1] += 1.0
    ages_s, sds_s = feed_times(StampedTime(), taken_s, came_s, rate=rate, sizes=draw_sizes(len(taken_s), rng))
    assert ages_s[-1] == pytest.approx(1.0, abs=0.02)
    assert sds_s[-1] == pytest.approx(least_sd_s, rel=0.05)
    assert sds_s[-2] == pytest.approx(FRAME_TIME_SD_S, rel=0.05)


def test_unstamped_time_ages_a_buffered_image_by_the_last_wait():
    time = UnstampedTime(opened_s=10.0)
    assert time.estimate(request_s=10.5, t_mono_s=10.5001).t_s == 10.0
    assert time.estimate(request_s=10.5, t_mono_s=10.6).t_s == 10.5, "it was waited for since then"
    waited = time.estimate(request_s=13.0, t_mono_s=13.0005)
    assert waited.t_s == 10.5, "it may have come at any moment since"
    assert waited.sd_s == pytest.approx(2.5 / math.sqrt(3), rel=0.01)


def test_unstamped_time_trusts_an_image_that_is_on_time_but_not_a_late_one():
    time = UnstampedTime(opened_s=0.0)
    taken = [time.estimate(0.2 * number, 0.2 * number + 0.19) for number in range(20)]
    taken_s = [each.t_s for each in taken]
    assert taken_s[:9] == pytest.approx([0.2 * number for number in range(9)]), "what is usual is not known yet"
    assert taken_s[9:] == pytest.approx([0.2 * number + 0.19 for number in range(9, 20)])
    assert [each.sd_s for each in taken[9:]] == [FRAME_TIME_SD_S] * 11
    assert time.estimate(4.0, 6.0).t_s == 4.0
    assert time.estimate(6.0, 6.0005).t_s == 4.0, "it was held up with it"
    assert time.estimate(6.1, 6.25).t_s == 6.25
