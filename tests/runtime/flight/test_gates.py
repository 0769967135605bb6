"""The gates of the navigator: when the position is known, and what is sent of it, on both sides of every limit."""

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from fakes import make_receiver, make_vehicle
from simulated_flight import HOME, make_match

from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import FRAME_TIME_SD_S, Position
from edgevpr.frames.level import LevelledImage, View
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.vehicle import Attitude
from edgevpr.runtime.flight.agewatch import DEAD_RECKONING_ERROR, GPS_ERROR, PX4_INERTIAL_ERROR
from edgevpr.runtime.flight.consistency import PredictedFix
from edgevpr.runtime.flight.drift import DEAD_RECKONING, INERTIAL, INERTIAL_PX4, DriftFilter
from edgevpr.runtime.flight.navigation import Navigation, NavState
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.output import Output
from edgevpr.runtime.recognise.perspective import AttitudeError

NOW_S = 1000.0
NEVER_S = math.inf
INFLATION = math.sqrt(50)


class KnownNavigation:
    """What navigation says of the position: `off_m` (2,) from HOME, so many metres and seconds ago."""

    is_proven = Navigation.is_proven

    def __init__(self, *, off_m=(0.0, 0.0), accuracy_m=2.0, shown_ago_s=0.0, gps_ago_s=NEVER_S, drift_m_s=(0.0, 0.0)):
        self.off_m, self.accuracy_m, self.drift_m_s = off_m, accuracy_m, drift_m_s
        self.last_vision_s = self.last_fix_s = NOW_S - shown_ago_s
        self.last_gps_s, self.has_gps, self.is_in_doubt, self.path_velocity_m_s = NOW_S - gps_ago_s, False, False, None
        self.frames, self.begun, self.contradicts_m, self.is_confirmed = [], [], 0.0, True
        self.is_tracked = lambda t_s: False
        self.add_report = self.add_acceleration = self.correct_by_fix = self.restart_odometry_scale = lambda *_: None

    def estimate_state(self, t_s):
        if self.accuracy_m is None:
            return None
        where = Position(*offset_position(*HOME, *self.off_m))
        motion = {"velocity_m_s": (3.0, 4.0), "speed_accuracy_m_s": 0.5}
        return NavState(t_s=t_s, position=where, accuracy_m=self.accuracy_m, **motion)

    def add_frame(self, frame, is_query):
        self.frames.append((frame, is_query))

    def predict_fix(self, match):
        if self.contradicts_m is None:
            return None
        zero, off_m = np.zeros(2), np.array([self.contradicts_m, 0.0])
        return PredictedFix(match=match, path_point_m=zero, offset_m=off_m, predicted_m=zero, covariance_m2=np.eye(2))

    def start_at_fix(self, *how):
        self.begun.append(how)

    def path_drift_m_s(self):
        return self.drift_m_s


def navigate(channel=Channel.COMMAND, *, reports=None, is_heard=True, map_sd_m=1.0, every_s=1.0, how=None, **known):
    """A navigator that knows its position, beside an autopilot without GPS that `reports`."""
    navigator = Navigator(map_sd_m, every_s, **how or {})
    navigator.handle_channel(channel)
    navigator._navigation = KnownNavigation(**known)
    if is_heard:
        said = {"has_gps": False, "velocity_m_s": (0.0, 0.0)} | (reports or {})
        navigator.handle_vehicle(make_vehicle(*HOME, said.pop("t_received_s", NOW_S), **said))
    return navigator


def fake_match(**changes):
    return replace(make_match(Position(*HOME), NOW_S, None, 1.5, (1,)), **changes)


GPS = {"has_gps": True}


@pytest.mark.parametrize(
    ("channel", "known", "is_known"),
    [
        (Channel.COMMAND, {"accuracy_m": 50.0}, True),
        (Channel.COMMAND, {"accuracy_m": 50.1}, False),
        (Channel.COMMAND, {"shown_ago_s": 60.0}, True),
        (Channel.COMMAND, {"shown_ago_s": 60.1}, False),
        (Channel.COMMAND, {"shown_ago_s": NEVER_S, "gps_ago_s": 60.0}, True),
        (Channel.COMMAND, {"shown_ago_s": NEVER_S, "gps_ago_s": 60.1}, False),
        (Channel.GPS_INPUT, {"accuracy_m": 25.0}, True),
        (Channel.VISION, {"accuracy_m": 25.1}, False),
        (Channel.GPS_INPUT, {"shown_ago_s": 5.0}, True),
        (Channel.GPS_INPUT, {"shown_ago_s": 5.1}, False),
        (Channel.GPS_INPUT, {"shown_ago_s": NEVER_S, "gps_ago_s": 3.0}, True),
        (Channel.GPS_INPUT, {"shown_ago_s": NEVER_S, "gps_ago_s": 3.1}, False),
        (Channel.VISION, {"shown_ago_s": 5.1}, False),
        (Channel.SENSOR, {"shown_ago_s": NEVER_S, "gps_ago_s": 0.0}, False),
    ],
)
def test_position_is_known_well_enough_within_limits(channel, known, is_known):
    assert navigate(channel, **known).knows_position(NOW_S) is is_known


@pytest.mark.parametrize(("accuracy_m", "claimed_m"), [(0.5, 1.0), (2.0, 2.0), (None, None)])
def test_accuracy_is_never_better_than_the_common_error_of_all_fixes(accuracy_m, claimed_m):
    assert navigate(accuracy_m=accuracy_m).accuracy_m(NOW_S) == claimed_m


def receiver(sd_m=1.0, **said):
    return {"has_gps": True, "gps": make_receiver(HOME, sd_m, NOW_S, **said)}


@pytest.mark.parametrize(
    ("channel", "reports", "before", "output"),
    [
        (Channel.SENSOR, receiver(), Output.STARTING, Output.GPS_IN_USE),
        (Channel.SENSOR, {}, Output.STARTING, Output.SENDING),
        (Channel.ODOMETRY, receiver(), Output.STARTING, Output.BESIDE_GPS),
        (Channel.GPS_INPUT, receiver(), Output.STARTING, Output.RESERVE),
        (Channel.GPS_INPUT, receiver() | {"has_gps": False}, Output.STARTING, Output.SENDING),
        (Channel.GPS_INPUT, receiver(15.0), Output.STARTING, Output.RESERVE),
        (Channel.GPS_INPUT, receiver(15.1), Output.STARTING, Output.SENDING),
        (Channel.GPS_INPUT, receiver(steady_for_s=0.5), Output.RESERVE, Output.RESERVE),
        (Channel.GPS_INPUT, receiver(steady_for_s=0.9), Output.SENDING, Output.SENDING),
        (Channel.GPS_INPUT, receiver(steady_for_s=1.0), Output.SENDING, Output.GPS_BACK),
        (Channel.GPS_INPUT, receiver(steady_for_s=2.9), Output.GPS_BACK, Output.GPS_BACK),
        (Channel.GPS_INPUT, receiver(steady_for_s=3.0), Output.GPS_BACK, Output.RESERVE),
    ],
)
def test_output_is_chosen_by_channel_and_receiver(channel, reports, before, output):
    navigator = navigate(channel, reports=reports)
    navigator.output = before
    assert (navigator.estimate_state(NOW_S) is not None) is output.is_sent
    assert navigator.output is output


@pytest.mark.parametrize("channel", [Channel.SENSOR, Channel.VISION, Channel.GPS_INPUT, Channel.ODOMETRY])
def test_px4_gets_no_position_if_images_cannot_show_its_tilt(channel):
    state = navigate(channel, how={"shows_tilt": False}).estimate_state(NOW_S)
    assert (state is None) is (channel in (Channel.SENSOR, Channel.VISION))


def test_navigator_sends_no_unknown_contradicted_or_withdrawn_position():
    unheard, unknown = navigate(Channel.GPS_INPUT, is_heard=False), navigate(Channel.GPS_INPUT, accuracy_m=None)
    for navigator in (unheard, unknown):
        assert (navigator.estimate_state(NOW_S), navigator.output) == (None, Output.STARTING)
    unknown.output = Output.SENDING
    assert (unknown.estimate_state(NOW_S), unknown.output) == (None, Output.UNKNOWN)
    in_doubt, doubted, withdrawn = (navigate(Channel.GPS_INPUT) for _ in range(3))
    in_doubt._navigation.is_in_doubt = True
    doubted.distrust_map(True)
    withdrawn._watch.withdrawn = Output.REFUSED
    for navigator in (in_doubt, doubted):
        assert (navigator.estimate_state(NOW_S), navigator.output) == (None, Output.CONTRADICTS_GPS)
    assert (withdrawn.estimate_state(NOW_S), withdrawn.output) == (None, Output.REFUSED)
    assert navigate(Channel.GPS_INPUT, how={"is_muted": True}).estimate_state(NOW_S) is None


def test_continuous_position_claims_the_accuracy_of_fifty_correlated_ones():
    navigator = navigate(Channel.GPS_INPUT, reports={"sink_m_s": 0.7}, map_sd_m=1.0)
    navigator.handle_specific_force(NOW_S, (0.0, 0.0, -9.8), Attitude(NOW_S, 90.0, -45.0, 180.0))
    state = navigator.estimate_state(NOW_S)
    assert (state.t_mono_s, state.alt_m, state.alt_accuracy_m, state.is_fallback) == (NOW_S, 300.0, 3.0, False)
    assert (state.lat_deg, state.lon_deg) == pytest.approx(HOME)
    assert state.velocity_m_s == (3.0, 4.0, 0.7)
    assert state.attitude == pytest.approx((math.pi / 2, -math.pi / 4, math.pi))
    assert (state.accuracy_m, state.speed_accuracy_m_s) == pytest.approx((2.0 * INFLATION, 0.5 * INFLATION))
    navigator._navigation.off_m = (3.0 + 10.0, 4.0)  # as far as it has flown, and 10 m of which 2 m are made up
    assert navigator.estimate_state(NOW_S + 1.0).accuracy_m == pytest.approx(math.hypot(2.0, 8.0) * INFLATION, rel=1e-4)
    bare = navigate(Channel.GPS_INPUT).estimate_state(NOW_S)
    assert (bare.attitude, bare.velocity_m_s[2]) == (None, 0.0)


@pytest.mark.parametrize(("sd_m", "alt_m", "sent_m"), [(1.0, 250.0, 250.0), (1.0, None, 300.0), (20.0, 250.0, 300.0)])
def test_fallback_position_has_the_altitude_of_the_receiver(sd_m, alt_m, sent_m):
    state = navigate(Channel.GPS_INPUT, reports=receiver(sd_m, alt_m=alt_m)).estimate_state(NOW_S)
    assert (state.alt_m, state.is_fallback) == (sent_m, sd_m == 1.0)


@pytest.mark.parametrize(
    ("channel", "how", "shown_ago_s", "factor"),
    [
        (Channel.SENSOR, {}, None, INFLATION),
        (Channel.SENSOR, {"is_level": True}, None, 1.0),
        (Channel.GPS_INPUT, {"is_level": True}, None, INFLATION),
        (Channel.SENSOR, {}, 5.0, 1.0),
        (Channel.SENSOR, {}, 5.1, INFLATION),
    ],
)
def test_px4_gets_uninflated_errors_while_images_show_its_attitude(channel, how, shown_ago_s, factor):
    navigator = navigate(channel, how=how)
    if shown_ago_s:
        lean = AttitudeError((0.01, 0.0), 0.01)
        navigator.advise(make_match(Position(*HOME), NOW_S - shown_ago_s, None, 1.5, (1,), lean=lean), NOW_S)
    assert navigator.estimate_state(NOW_S).accuracy_m == pytest.approx(2.0 * factor)


@pytest.mark.parametrize(
    ("channel", "has_gps", "error"),
    [
        (Channel.COMMAND, True, GPS_ERROR),
        (Channel.COMMAND, False, DEAD_RECKONING_ERROR),
        (Channel.SENSOR, True, DEAD_RECKONING_ERROR),
        (Channel.VISION, False, PX4_INERTIAL_ERROR),
    ],
)
def test_age_of_pictures_is_found_by_the_path(channel, has_gps, error):
    navigator, motions = navigate(channel), []
    navigator.age = SimpleNamespace(add_motion=lambda *motion: motions.append(motion))
    vehicle = make_vehicle(*HOME, NOW_S, velocity_m_s=(0.0, 0.0))
    navigator.handle_vehicle(vehicle)
    navigator._navigation.has_gps, navigator._navigation.path_velocity_m_s = has_gps, (1.0, 2.0)
    navigator.handle_vehicle(vehicle)
    assert motions == [(NOW_S, (1.0, 2.0), None, error)]


@pytest.mark.parametrize(
    ("height_m", "median_ratio", "reported_m", "error"),
    [(132, 1.0, 100, 0.32), (112, 1.0, 100, 0), (112, 1.12, 100, 0.12), (137, 1.34, 100, 0.34), (60, 1.0, -5, 0)],
)
def test_heights_of_matches_correct_the_scale_of_odometry(height_m, median_ratio, reported_m, error):
    navigator, filtered = navigate(), DriftFilter(INERTIAL, 1.0)
    navigator._navigation.restart_odometry_scale = filtered.restart_odometry_scale
    navigator.correct_height(median_ratio)
    seen = fake_match(vehicle=make_vehicle(*HOME, NOW_S, height_m=reported_m))
    navigator.advise(replace(seen, located=replace(seen.located, height_m=height_m)), NOW_S)
    assert filtered._x[10] == pytest.approx(error)


def test_frame_claims_the_error_of_its_time():
    navigator = navigate(reports={"velocity_m_s": (30.0, 40.0)})
    navigator.handle_frame(fake_match())
    navigator.handle_frame(fake_match(vehicle=make_vehicle(*HOME, NOW_S)), is_query=False)
    navigator.handle_frame(fake_match())
    navigator.handle_frame(fake_match(frame=None))
    navigator.age.is_unknown = True
    navigator.handle_frame(fake_match())
    frames = navigator._navigation.frames
    assert [frame.sd_m for frame, _ in frames] == pytest.approx([50 * FRAME_TIME_SD_S, 0.0, 50 * FRAME_TIME_SD_S])
    assert [is_query for _, is_query in frames] == [True, False, True]


def test_frame_claims_a_contradiction_of_height_sources_until_a_match_shows_the_height():
    navigator = navigate()
    for jumped_m in (30.0, 50.0):
        event = fake_match(vehicle=make_vehicle(*HOME, NOW_S, height_m=100.0, height_doubt_m=jumped_m))
        navigator.handle_frame(event)
        navigator.handle_vehicle(event.vehicle)
        navigator.correct_height(1.0)
        navigator.handle_frame(event)
    assert [frame.scale_sd for frame, _ in navigator._navigation.frames] == pytest.approx([0.3, 0.0, 0.2, 0.0])


def test_frame_claims_a_step_of_the_height_to_another_source_since_a_match_showed_the_height():
    navigator = navigate()
    for step_m in (-30.0, 10.0, 10.0):
        event = fake_match(vehicle=make_vehicle(*HOME, NOW_S, height_m=100.0, height_step_m=step_m))
        navigator.handle_vehicle(event.vehicle)
        navigator.handle_frame(event)
        navigator.correct_height(1.2)
    assert [frame.scale_sd for frame, _ in navigator._navigation.frames] == pytest.approx([0.3, 0.48, 0.0])


def test_frame_below_the_takeoff_point_has_the_height_that_matches_show():
    navigator = navigate()
    navigator.correct_height(60.0)
    view = LevelledImage(np.zeros((8, 8), np.uint8), None, View(nadir_offset=(0.1, 0.0)))
    reports = {"height_m": -60.0, "roll_deg": 0.0, "pitch_deg": 0.0, "velocity_m_s": (0.0, 0.0)}
    navigator.handle_frame(fake_match(vehicle=make_vehicle(*HOME, NOW_S, **reports), picture=view))
    assert navigator._navigation.frames[0][0].attitude_gain_s2 == pytest.approx(60.0 / 9.81, rel=0.01)


@pytest.mark.parametrize(("contradicts_m", "errors"), [(500.0, []), (0.0, [0.4])])
def test_only_an_accepted_match_corrects_the_scale_of_odometry(contradicts_m, errors):
    navigator, found = navigate(), []
    navigator._navigation.contradicts_m = contradicts_m
    navigator._navigation.restart_odometry_scale = lambda error, tolerance: found.append(error)
    event = fake_match(vehicle=make_vehicle(*HOME, NOW_S, height_m=100.0))
    navigator.advise(replace(event, located=replace(event.located, height_m=140.0)), NOW_S)
    assert found == pytest.approx(errors)


CONTINUOUS = Channel.GPS_INPUT
TILTED = LevelledImage(np.zeros((8, 8), np.uint8), None, View(reason=Reason(ReasonCode.TILTED, {"tilt_deg": 40.0})))


@pytest.mark.parametrize(
    ("channel", "reports", "event", "contradicts_m", "code"),
    [
        (Channel.COMMAND, {}, {"located": None}, 0.0, ReasonCode.PLACE_WITHOUT_POSITION),
        (Channel.COMMAND, {}, {"frame": None}, 0.0, ReasonCode.PLACE_WITHOUT_POSITION),
        (Channel.COMMAND, {}, {"picture": TILTED}, 0.0, ReasonCode.NOT_BELOW_AIRCRAFT),
        (CONTINUOUS, {"t_received_s": NOW_S - 1.1}, {}, 0.0, ReasonCode.NO_TELEMETRY),
        (CONTINUOUS, {"velocity_m_s": None}, {}, 0.0, ReasonCode.NO_TELEMETRY),
        (Channel.COMMAND, {"velocity_m_s": None}, {}, 0.0, ReasonCode.NO_TELEMETRY),
        (CONTINUOUS, {}, {}, None, ReasonCode.CONTINUOUS),
        (Channel.COMMAND, {}, {}, None, ReasonCode.HELD_UNCONFIRMED),
        (Channel.COMMAND, {}, {}, 500.0, ReasonCode.HELD_OFF_PATH),
        (Channel.COMMAND, {}, {}, 0.0, ReasonCode.NOT_BETTER),
        (CONTINUOUS, {}, {}, 0.0, ReasonCode.CONTINUOUS),
    ],
)
def test_match_is_sent_only_if_allowed(channel, reports, event, contradicts_m, code):
    navigator = navigate(channel, reports=reports)
    navigator._navigation.contradicts_m = contradicts_m
    advice = navigator.advise(fake_match(**event), NOW_S)
    assert (advice.why and advice.why.code) is code
    assert advice.is_held is (code in (ReasonCode.HELD_OFF_PATH, ReasonCode.HELD_UNCONFIRMED))
    assert len(navigator._navigation.begun) == (contradicts_m is None)


@pytest.mark.parametrize("has_position", [True, False])
@pytest.mark.parametrize(
    ("matches", "sent"),
    [
        ([(0, 0, 1), (1, 20, 1)], "-+"),
        ([(0, 0, 1), (1, 60, 2), (2, 80, 3)], "--+"),
        ([(0, 0, 1), (10, 60, 1)], "-+"),
        ([(0, 0, 1), (31, 0, 1)], "--"),
        ([(0, 0, 1), (1, 0, 2)], "-+"),
        ([(second, 0, 1) for second in range(5)], "---++"),
    ],
)
def test_match_that_nothing_predicts_is_sent_if_others_confirm_it(has_position, matches, sent):
    """Matches of one place each, so many seconds later and metres away. The autopilot may have a position."""
    navigator = navigate(is_heard=has_position)
    navigator._navigation.contradicts_m = None
    for (later_s, off_m, place), is_sent in zip(matches, sent, strict=True):
        t_s, there = NOW_S + later_s, Position(*offset_position(*HOME, off_m, 0.0))
        if has_position:
            navigator.handle_vehicle(replace(navigator._vehicle, t_received_s=t_s))
        else:
            navigator.handle_no_position(t_s)
        advice = navigator.advise(make_match(there, t_s, None, 1.5, (place,)), t_s)
        expected = Fix(there.lat_deg, there.lon_deg, 1.5, t_s), None
        assert (advice.fix, advice.why) == (expected if is_sent == "+" else (None, Reason(ReasonCode.HELD_UNCONFIRMED)))


def test_match_that_agrees_with_a_rough_prediction_is_sent_if_another_confirms_it():
    navigator = navigate(off_m=(10.0, 0.0))
    navigator._navigation.is_confirmed = False
    assert navigator.advise(fake_match(), NOW_S).why.code is ReasonCode.HELD_UNCONFIRMED
    assert navigator.accuracy_m(NOW_S) is None, "it is not shown either"
    navigator._navigation.is_confirmed = True
    assert navigator.advise(fake_match(), NOW_S).fix


def test_accuracy_of_a_fix_contains_the_error_of_its_time():
    navigator = navigate(reports={"velocity_m_s": (30.0, 40.0)})
    late = replace(fake_match().frame, t_sd_s=math.hypot(FRAME_TIME_SD_S, 0.1))
    navigator.advise(fake_match(frame=late), NOW_S)
    assert navigator.accuracy_m(NOW_S) == pytest.approx(math.hypot(1.0, 5.0))
    unheard = navigate(is_heard=False)
    unheard.handle_no_position(NOW_S)
    hover = [fake_match(frame=replace(late, t_mono_s=NOW_S + second)) for second in range(-3, 1)]
    fixes = [unheard.advise(event, NOW_S).fix for event in hover]
    assert fixes[3].accuracy_m == pytest.approx(1.5 * math.sqrt(2)), "an unknown speed is 15 m/s"


@pytest.mark.parametrize("is_heard", [True, False])
def test_match_that_nothing_judges_is_held_only_if_the_autopilot_reports_no_position(is_heard):
    navigator = navigate(is_heard=is_heard, reports={"t_received_s": NOW_S - 5.0})
    if not is_heard:
        navigator.handle_autopilot(NOW_S - 5.0)
    assert navigator.advise(fake_match(), NOW_S + 0.1).why.code is ReasonCode.NO_TELEMETRY
    navigator.handle_no_position(NOW_S)
    assert navigator.advise(fake_match(), NOW_S).why.code is ReasonCode.NO_TELEMETRY, "in its first five seconds"
    assert navigator.advise(fake_match(), NOW_S + 0.1).why.code is ReasonCode.HELD_UNCONFIRMED
    assert navigator.advise(fake_match(), NOW_S + 5.1).why.code is ReasonCode.NO_TELEMETRY, "its reports have stopped"


def test_match_older_than_the_path_is_not_sent():
    navigator = navigate()
    navigator._navigation.contradicts_m, navigator._navigation.path_velocity_m_s = None, np.zeros(2)
    assert navigator.advise(fake_match(), NOW_S).why.code is ReasonCode.NO_TELEMETRY


def test_fix_is_sent_if_it_improves_the_autopilots_position():
    reports = {"velocity_m_s": (10.0, -4.0), "t_received_s": NOW_S - 0.5}
    same = navigate(reports=reports, off_m=(5.0, -2.0)).advise(fake_match(), NOW_S)
    assert same.why.code is ReasonCode.NOT_BETTER
    assert same.why.parameters == pytest.approx({"distance_m": 0.0, "accuracy_m": 2.0}, abs=0.01)
    assert navigate(accuracy_m=3.0, off_m=(4.23, 0.0)).advise(fake_match(), NOW_S).fix is None
    assert navigate(accuracy_m=3.0, off_m=(4.25, 0.0)).advise(fake_match(), NOW_S).fix
    for every_s, ahead_m in ((1.0, (2.0, -1.5)), (0.2, (0.8, -0.6))):
        fix = navigate(every_s=every_s, off_m=(10.0, 0.0), drift_m_s=(8.0, -6.0)).advise(fake_match(), NOW_S).fix
        assert offset_m(*HOME, fix.lat_deg, fix.lon_deg) == pytest.approx((10.0 + ahead_m[0], ahead_m[1]), abs=0.01)
        assert fix.accuracy_m == pytest.approx(math.hypot(2.0, math.hypot(*ahead_m) / math.sqrt(2)))
        assert fix.t_frame_s == NOW_S


def test_navigator_sends_no_fix_with_gps_or_while_the_map_contradicts_it():
    silent = {"gps_is_silent": True}
    beside, unheard, doubted, unknown = (navigate(off_m=(10.0, 0.0), reports=said) for said in (GPS, silent, {}, {}))
    assert beside.advise(fake_match(), NOW_S).why.code is ReasonCode.HAS_GPS
    assert unheard.advise(fake_match(), NOW_S).why.code is ReasonCode.HAS_GPS
    beside.trust_gps(False)
    assert beside.advise(fake_match(), NOW_S).why.code is ReasonCode.HAS_WRONG_GPS
    doubted.distrust_map(True)
    assert doubted.advise(fake_match(), NOW_S).why.code is ReasonCode.MAP_CONTRADICTS_GPS
    unknown._navigation.accuracy_m = None
    assert unknown.advise(fake_match(), NOW_S).why.code is ReasonCode.NO_TELEMETRY


@pytest.mark.parametrize(
    "change",
    [
        {"how": {"is_muted": True}},
        {"channel": Channel.GPS_INPUT},
        {"is_heard": False},
        {"reports": {"velocity_m_s": None}},
        {"reports": {"t_received_s": NOW_S - 1.1}},
        {"reports": GPS},
        {"reports": {"gps_is_silent": True}},
        {"shown_ago_s": 60.1},
        {"off_m": (1.0, 0.0)},
    ],
    ids=str,
)
def test_fix_between_matches_is_sent_only_to_an_autopilot_that_needs_it(change):
    off = {"off_m": (10.0, 0.0)}
    assert navigate(**off).make_interim_fix(NOW_S)
    assert navigate(**off | change).make_interim_fix(NOW_S) is None


def test_navigator_sends_no_interim_fix_if_matches_contradict_or_age_is_unknown():
    navigator = navigate(off_m=(10.0, 0.0))
    navigator.age.is_unknown = True
    assert navigator.make_interim_fix(NOW_S) is None
    navigator.age.is_unknown, navigator._navigation.contradicts_m = False, 500.0
    assert navigator.advise(fake_match(), NOW_S).is_held
    assert navigator.make_interim_fix(NOW_S) is None


def test_navigation_resets_if_the_error_of_the_path_changes():
    navigator, seen = Navigator(1.0, 1.0), []
    for channel in (Channel.NONE, Channel.COMMAND, Channel.SENSOR, Channel.VISION, Channel.GPS_INPUT, Channel.ODOMETRY):
        navigator.handle_channel(channel)
        seen.append(navigator._navigation)
    assert [one is other for one, other in pairwise(seen)] == [True, False, True, False, True]
    assert [each._drift for each in seen[::2]] == [DEAD_RECKONING, INERTIAL_PX4, INERTIAL]
