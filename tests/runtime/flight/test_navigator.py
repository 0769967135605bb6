"""What is worth being sent: with a true path beside it, an aircraft that takes what is sent is never worse off."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from fakes import make_vehicle
from simulated_flight import HOME, SimFlight, make_match, norms

from edgevpr.core.geodesy import distance_m, offset_position
from edgevpr.core.types import Position
from edgevpr.frames.level import View
from edgevpr.mavlink.channel import Channel
from edgevpr.runtime.flight import navigator
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.recognise.perspective import AttitudeError

pytestmark = pytest.mark.slow

WIND = 6.0, 0.0
INFLATION = math.sqrt(50)  # by so much more a continuous position says that it is wrong


def lose_gps(navigator=None, **how):
    """A flight that has just lost GPS."""
    air = SimFlight(navigator or Navigator(1.0, how.get("every_s", 1.0)), **how)
    air.fly(30)
    air.lose_gps()
    air.errors_m.clear()
    return air


def use_gps_input(navigator):
    navigator.handle_channel(Channel.GPS_INPUT)
    return navigator


def select_states(air, from_s=0.0):
    return [(t_s, state) for t_s, state in air.states if state and t_s >= from_s]


@pytest.mark.parametrize("begins_anew", [False, True])
def test_fixes_with_a_new_error_are_accepted_after_a_reset(begins_anew):
    air = SimFlight(Navigator(1.0, 1.0))
    air.map_off = air.map_off + np.array((16.0, 0.0))
    air.fly(120)
    air.map_off = air.map_off - np.array((16.0, 0.0))
    if begins_anew:
        air.navigator.reset_navigation()
    air.advices.clear()
    held = [advice.is_held for _, advice in air.fly(30).advices]
    assert len(held) > 25
    assert any(held) == (not begins_anew)


@pytest.mark.parametrize("fix_sd_m", [1.0, 3.0])
def test_navigator_keeps_an_autopilot_that_uses_its_fixes_within_metres_in_wind(fix_sd_m):
    air, alone = lose_gps(wind=WIND, fix_sd_m=fix_sd_m), lose_gps(wind=WIND)
    alone.takes_fixes = False
    errors_m = norms(air.fly(150).errors_m)
    assert norms(alone.fly(150).errors_m).max() > 700
    assert np.median(errors_m) < 2 + fix_sd_m
    assert errors_m.max() < 10 + 3 * fix_sd_m


@pytest.mark.parametrize(("speed_m_s", "seed"), [(15.0, 0), (15.0, 1), (7.0, 2)])
def test_navigator_never_worsens_good_dead_reckoning(speed_m_s, seed):
    """With matches as good as those over a refined map with ArduPilot in its simulator."""
    air = lose_gps(speed_m_s=speed_m_s, fix_sd_m=0.6, said_sd_m=1.1, other_sd_m=0.0, seed=seed).fly(200)
    assert norms(air.errors_m).max() < 3.0, "and alone it is exact"


FLIGHT_SETTINGS = [
    {"wind": WIND, "gusts": 0.5},
    {"wind": WIND, "gusts": 0.5, "fix_sd_m": 8.0},
    {"wind": WIND, "gusts": 0.5, "late_s": 1.5},
]


@pytest.mark.parametrize("how", FLIGHT_SETTINGS)
def test_navigator_claims_match_its_errors(how):
    air, known = lose_gps(**how).fly(10), []
    for _ in range(300):
        air.fly(1)
        here = air.navigator._navigation.estimate_state(air.t_s)
        known.append((*air.measure_error(here.position.lat_deg, here.position.lon_deg), here.accuracy_m))
    known = np.array(known)
    assert (abs(known[:, :2]) < known[:, 2:]).mean() == pytest.approx(0.68, abs=0.1)


@pytest.mark.parametrize("channel", [Channel.SENSOR, Channel.VISION])
def test_navigator_sends_positions_to_px4_only_without_gps(channel):
    navigator = Navigator(1.0, 1.0)
    navigator.handle_channel(channel)
    air = SimFlight(navigator, wind=WIND).fly(30)
    assert not select_states(air)
    air.lose_gps()
    air.fly(150)
    said = select_states(air, from_s=32.0)
    assert len(said) > 0.99 * 10 * 148
    off_m = np.array([air.measure_error(state.lat_deg, state.lon_deg, t_s) for t_s, state in said])
    claimed_m = np.array([state.accuracy_m for _, state in said])
    assert norms(off_m).max() < 10.0, "of matches that are 3 m off"
    assert (abs(off_m) < claimed_m[:, None]).mean() > 0.58
    assert (abs(off_m) < 2 * claimed_m[:, None]).mean() > 0.92


def test_navigator_claims_larger_errors_without_attitude():
    """At 100 m a tilt of 15 degrees is 27 m."""
    level, untold = lose_gps(wind=WIND, fix_sd_m=1.0), lose_gps(wind=WIND, fix_sd_m=1.0, attitude=(None, None))
    told, less = (air.fly(20).sent[-1][1].accuracy_m for air in (level, untold))
    assert told < 5
    assert less > 10


def test_navigator_sends_nothing_during_a_link_outage_and_resumes_after_it():
    air = lose_gps(wind=WIND).fly(60)
    air.is_silent = True
    air.fly(5)
    assert not air.navigator.knows_position(air.t_s)
    air.is_silent = False
    air.errors_m.clear()
    air.fly(60)
    assert max(air.sent[-1][0], air.between[-1][0].t_frame_s) > air.t_s - 5
    assert norms(air.errors_m)[10:].max() < 20


def test_navigator_sends_matches_to_a_restarted_autopilot_and_resumes_with_its_reports():
    air = lose_gps(wind=WIND).fly(60)
    air.knows_nothing = True
    air.off_m = np.array([-400.0, 900.0])  # where it began
    air.fly(3)
    assert not air.navigator.has_gps
    assert not air.navigator.knows_position(air.t_s)
    assert air.sent[-1][0] > air.t_s - 1.5, "what is seen is all that is known"
    air.off_m, air.knows_nothing, air.known = np.array([300.0, 0.0]), False, (1.0, air.t_s)
    air.fly(10)
    assert any(advice.is_held for _, advice in air.advices[-10:]), "one alone is not believed against it"
    air.errors_m.clear()
    air.fly(30)
    assert norms(air.errors_m).max() < 15


def test_navigator_streams_ten_smooth_positions_a_second():
    air = lose_gps(use_gps_input(Navigator(1.0, 1.0)))
    air.fly(20)
    moved_s = air.t_s
    air.map_off = np.array([25.0, 0.0])  # two in a row are believed
    air.fly(30)
    states = select_states(air, moved_s - 5)
    steps_s = np.diff([t_s for t_s, _ in states])
    assert steps_s == pytest.approx(0.1)
    beyond_m = []
    for (_, one), (_, other) in pairwise(states):
        east_m, north_m = np.array(other.velocity_m_s[:2]) * 0.1
        carried = navigator.offset_position(one.lat_deg, one.lon_deg, east_m, north_m)
        beyond_m.append(float(distance_m(*carried, other.lat_deg, other.lon_deg)))
    assert max(beyond_m) < 0.5
    accuracies_m = [state.accuracy_m / INFLATION for _, state in states]
    assert max(accuracies_m) > 10, "while it lies behind it says so"
    last = states[-1][1]
    assert air.measure_error(last.lat_deg, last.lon_deg) == pytest.approx((25.0, 0.0), abs=6.0), "it has followed"
    assert last.accuracy_m / INFLATION < 4


def test_navigator_stream_stays_accurate_and_reports_its_accuracy():
    air = lose_gps(use_gps_input(Navigator(1.0, 1.0)), bias=(0.05, -0.03), fix_sd_m=2.0).fly(200)
    states = select_states(air, 40)
    assert len(states) == pytest.approx(1900, abs=3)
    off_m = np.array([air.measure_error(state.lat_deg, state.lon_deg, t_s) for t_s, state in states])
    said_m = np.array([state.accuracy_m for _, state in states]) / INFLATION
    assert np.median(norms(off_m)) < 2.5
    assert norms(off_m).max() < 8
    assert 0.58 <= (abs(off_m) < said_m[:, None]).mean() <= 0.85
    last = states[-1][1]
    assert last.alt_m == 300.0
    assert last.attitude == (0.0, 0.0, 0.0)
    assert last.velocity_m_s[:2] == pytest.approx(tuple(air.velocity(air.t_s)), abs=1.5)


def test_navigator_sends_the_observed_drift_between_matches():
    how = {"wind": WIND, "every_s": 10.0}
    air, other = lose_gps(**how), lose_gps(**how)
    other.navigator.make_interim_fix = lambda now_s: None
    errors_m, others_m = (norms(each.fly(300).errors_m)[60:] for each in (air, other))
    assert np.median(errors_m) < 12
    assert errors_m.max() < 45
    assert np.median(errors_m) < 0.4 * np.median(others_m)


def test_navigator_claims_match_its_errors_between_matches():
    runs = [lose_gps(wind=WIND, gusts=0.3, every_s=10.0, seed=seed).fly(300) for seed in range(2)]
    sigmas = np.concatenate([off_m / fix.accuracy_m for run in runs for fix, off_m in run.between])
    assert len(sigmas) > 200
    assert 0.58 <= (abs(sigmas) < 1).mean() <= 0.85
    assert (abs(sigmas) < 2).mean() >= 0.9


@pytest.mark.parametrize(
    ("shown_sd", "is_level", "attitude_sd"), [(0.01, False, 0.0087), (0.03, False, 0.027), (0.03, True, 0)]
)
def test_report_accuracy_contains_the_attitude_error_that_images_show(shown_sd, is_level, attitude_sd):
    navigator, rng, height_m = Navigator(1.0, 1.0, is_level=is_level), np.random.default_rng(2), 100.0
    attitude = {"roll_deg": 0.0, "pitch_deg": 0.0, "height_m": height_m, "velocity_m_s": (0.0, 0.0)}
    for t_s in map(float, range(1, 100)):
        vehicle = make_vehicle(*HOME, t_s, has_gps=False, position_sd_m=30.0, **attitude)
        navigator.handle_vehicle(vehicle)
        shown = AttitudeError(tuple(rng.normal(0.0, shown_sd, 2)), 0.024)
        event = make_match(Position(*HOME), t_s, vehicle, 1.0, (1,), View(nadir_offset=(0.01, 0.0)), shown)
        navigator.advise(event, t_s)
    reported = navigator.report_accuracy(event)
    assert reported.accuracy_m == pytest.approx(math.hypot(1.0, height_m * attitude_sd), rel=0.25)
    without_report, unlocated = replace(event, vehicle=None), replace(event, located=None)
    assert navigator.report_accuracy(without_report).accuracy_m == reported.accuracy_m, "by the newest report"
    assert navigator.report_accuracy(unlocated) is unlocated
    assert Navigator(1.0, 1.0).report_accuracy(without_report) is without_report, "there is no report"


@pytest.mark.parametrize("common_tilt_m", [0.0, 12.0])
def test_positions_of_many_matches_claim_a_tilt_common_to_all(common_tilt_m):
    navigator = Navigator(1.0, 1.0)
    for t_s in map(float, range(1, 60)):
        vehicle = make_vehicle(*HOME, t_s, has_gps=False, position_sd_m=30.0, velocity_m_s=(0.0, 0.0))
        navigator.handle_vehicle(vehicle)
        event = make_match(Position(*HOME), t_s, vehicle, 1.0, (1,))
        navigator.advise(replace(event, located=replace(event.located, common_tilt_m=common_tilt_m)), t_s)
    assert max(1.0, common_tilt_m) <= navigator.accuracy_m(t_s) < common_tilt_m + 2.0


@pytest.mark.parametrize(("common_tilt_m", "is_sent"), [(0.0, True), (20.0, True), (80.0, False)])
def test_a_fix_is_sent_only_if_a_tilt_common_to_all_cannot_explain_its_distance(common_tilt_m, is_sent):
    navigator, there = Navigator(1.0, 1.0), Position(*offset_position(*HOME, 60.0, 0.0))
    for t_s in map(float, range(1, 60)):
        vehicle = make_vehicle(*HOME, t_s, has_gps=False, position_sd_m=30.0, velocity_m_s=(0.0, 0.0))
        navigator.handle_vehicle(vehicle)
        event = make_match(there, t_s, vehicle, max(1.0, common_tilt_m), (1,))
        event = replace(event, located=replace(event.located, common_tilt_m=common_tilt_m))
        fix = navigator.advise(event, t_s).fix
    assert bool(fix) == is_sent
    assert bool(navigator.make_interim_fix(t_s + 0.5)) == is_sent
