"""The motion that the camera sees, in the navigator: it carries the position where no place is accepted."""

import numpy as np
import pytest
from simulated_flight import SimFlight, norms

from edgevpr.mavlink.channel import Channel
from edgevpr.runtime.flight.navigator import Navigator

WIND = (5.0, -3.0)
GAP_S = 60


def make_air(channel, **how):
    ours = Navigator(1.0, 1.0)
    ours.handle_channel(channel)
    return SimFlight(ours, wind=WIND, gusts=0.2, fix_sd_m=1.5, other_sd_m=0.5, bias=(0.1, 0.0), **how)


def fly_no_gps(air, seconds):
    """Fly with GPS for a minute, then so many seconds without."""
    air.fly(60)
    air.lose_gps()
    return air.fly(seconds)


def measure_error_m(air):
    """Metres (2,) by which our position is wrong now, and what it says of itself."""
    here = air.navigator._navigation.estimate_state(air.t_s)
    return air.measure_error(here.position.lat_deg, here.position.lon_deg), here.accuracy_m


def measure_offsets_m(air, seconds):
    """Metres by which we are off the aircraft, and off where matches put it, once these have been 80 m off so long."""
    air.map_off = np.array([80.0, 0.0])
    led_m, _ = measure_error_m(air.fly(seconds))
    return np.hypot(*led_m), np.hypot(*(led_m - air.map_off))


def fly_across_gap(air, seconds=GAP_S):
    """Fly without GPS over the map, then off it. Returns the errors and the accuracies told, once a second."""
    fly_no_gps(air, 60)
    air.matches = False
    found = [measure_error_m(air.fly(1)) for _ in range(seconds)]
    return [error for error, _ in found], np.array([said for _, said in found])


@pytest.mark.parametrize(
    ("channel", "stretch", "turn"),
    [
        (Channel.COMMAND, 1.0, 0.0),
        (Channel.GPS_INPUT, 1.05, 0.0),
        (Channel.COMMAND, 1.0, 0.06),
        (Channel.GPS_INPUT, 1.0, 0.06),
    ],
)
def test_odometry_bridges_a_minute_off_the_map_to_three_per_cent_of_the_distance(channel, stretch, turn):
    air = make_air(channel, stride_sd_m=0.2)
    air.stretch, air.turn = stretch, turn
    errors_m, said_m = fly_across_gap(air)
    way_m = air.speed_m_s * GAP_S
    assert norms(errors_m).max() <= 0.03 * way_m
    assert (np.abs(errors_m) < 2 * said_m[:, None]).mean() >= 0.9
    assert said_m[-1] < 0.04 * way_m


@pytest.mark.parametrize("turns_compass", [True, False], ids=["compass", "camera"])
@pytest.mark.parametrize(("channel", "gap_s"), [(Channel.GPS_INPUT, 60), (Channel.SENSOR, 30)])
def test_odometry_bridges_a_gap_if_matches_show_a_large_rotation(channel, gap_s, turns_compass):
    air = make_air(channel, stride_sd_m=0.2)
    air.turn, air.shows_turn, air.turns_compass = -0.3, True, turns_compass
    errors_m, _ = fly_across_gap(air, gap_s)
    assert norms(errors_m).max() < 8.0


def test_gap_without_odometry_is_not_bridged():
    errors_m, said_m = fly_across_gap(make_air(Channel.COMMAND))
    assert norms(errors_m).max() > 30.0
    assert said_m[-1] > 30.0


def test_odometry_holds_the_position_in_a_hover():
    air = make_air(Channel.GPS_INPUT, stride_sd_m=0.2, speed_m_s=0.0)
    errors_m, said_m = fly_across_gap(air, seconds=120)
    assert norms(errors_m).max() < 4.0
    assert said_m[-1] < 4.0
    _, state = air.states[-1]
    assert np.hypot(*state.velocity_m_s[:2]) < 0.5


def test_odometry_keeps_the_autopilot_accurate_across_the_gap():
    air = make_air(Channel.COMMAND, stride_sd_m=0.2)
    fly_across_gap(air)
    assert len(air.between) > 15
    assert norms([error for _, error in air.between[-15:]]).max() < 25.0
    assert norms(air.errors_m[-30:]).max() < 35.0


def test_odometry_that_contradicts_the_path_is_rejected():
    air = make_air(Channel.GPS_INPUT, stride_sd_m=0.2)
    fly_no_gps(air, 30)
    before_m, _ = measure_error_m(air)
    air.matches, air.stretch = False, 5.0
    air.fly(1)
    air.stretch = 1.0
    after_m, _ = measure_error_m(air)
    assert np.hypot(*(after_m - before_m)) < 2.0


@pytest.mark.parametrize("channel", [Channel.COMMAND, Channel.GPS_INPUT])
def test_matches_need_four_to_overrule_a_tracked_path_over_repetitive_ground(channel):
    air = fly_no_gps(make_air(channel, stride_sd_m=0.2), 30)
    assert measure_offsets_m(air, 3)[0] < 8.0, "three that agree with each other are not believed"
    assert measure_offsets_m(air, 3)[1] < 8.0, "matches win in the end"


def test_two_fixes_overrule_the_path_without_odometry():
    assert measure_offsets_m(fly_no_gps(make_air(Channel.COMMAND), 30), 3)[1] < 15.0


def test_matches_overrule_the_path_of_a_slow_copter_over_the_same_places():
    air = make_air(Channel.GPS_INPUT, stride_sd_m=0.2, speed_m_s=7.0)
    air.places = lambda step: tuple(range(step // 150, step // 150 + 12))  # those of 36 s
    assert measure_offsets_m(fly_no_gps(air, 30), 15)[1] < 8.0


RARE = {"every_s": 10.0, "stride_s": 2.0, "stride_sd_m": 0.2}


def test_odometry_frames_hold_the_position_between_queries_ten_seconds_apart():
    def find_largest_m(**how):
        return norms(fly_no_gps(make_air(Channel.COMMAND, **RARE | how), 60).errors_m[-59:]).max()

    assert find_largest_m() < 20.0
    assert find_largest_m(stride_s=None) > 40.0


@pytest.mark.parametrize("channel", [Channel.COMMAND, Channel.GPS_INPUT])
def test_matches_need_two_to_overrule_a_tracked_path_if_rare(channel):
    assert measure_offsets_m(fly_no_gps(make_air(channel, **RARE), 60), 25)[1] < 15.0


def fly_with_failing_compass(shows_turn, seed):
    """Errors of an autopilot whose compass turns by 9 degrees in 3 s, when GPS is lost and there is a new wind."""
    how = {"fix_sd_m": 0.6, "other_sd_m": 0.5, "stride_sd_m": 0.3, "speed_m_s": 20.0, "seed": seed}
    air = SimFlight(Navigator(1.0, 1.0), wind=WIND, **how)
    air.shows_turn = shows_turn
    fly_no_gps(air, 0)
    air.errors_m.clear()
    for turn in (0.05, 0.1, 0.15):
        air.turn = turn
        air.fly(1)
    return norms(air.fly(60).errors_m).max()


def test_compass_error_after_gps_loss_is_estimated_from_the_rotation_of_matches():
    assert max(fly_with_failing_compass(True, seed) for seed in (3, 5)) < 7.0
    assert max(fly_with_failing_compass(False, seed) for seed in (3, 5)) > 10.0, "by strides that lead astray"
