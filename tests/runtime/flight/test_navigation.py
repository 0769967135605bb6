"""Navigation between fixes: with a true flight beside it, how wrong it is, and whether it knows."""

import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from fakes import make_receiver, make_vehicle
from simulated_flight import HOME, STEP_S, SimFlight, norms

from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Position
from edgevpr.mavlink.receivers import RECEIVER_LAG_S
from edgevpr.runtime.flight import drift
from edgevpr.runtime.flight.drift import DEAD_RECKONING, GRAVITY_M_S2, INERTIAL, DriftFilter
from edgevpr.runtime.flight.measurements import FrameMeasurement, PositionedMatch
from edgevpr.runtime.flight.navigation import Navigation
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.perspective import AttitudeError

STRIDE = partial(OdometryStep, from_s=0.0, to_s=1.0, sd_m=0.2, inliers=100)


def make_fix(position, t_s, fix_sd_m, attitude_error=None, **frame):
    frame = FrameMeasurement(t_s=t_s, **{"sd_m": 0.0} | frame)
    match = {"covariance_m2": fix_sd_m**2 * np.eye(2), "places": (1,), "attitude_error": attitude_error}
    return PositionedMatch(frame=frame, position=position, accuracy_m=fix_sd_m, **match)


class NavigatedFlight(SimFlight):
    """A flight that has lost GPS after `gps_s`. Its matches all correct its navigation, as `look` makes them of the
    time of a frame and of where it was taken (2,); nothing is sent."""

    def __init__(self, gps_s, drift=DEAD_RECKONING, **how):
        self.navigation = Navigation(drift, 1.0)
        navigator = SimpleNamespace(
            handle_vehicle=self.navigation.add_report,
            handle_specific_force=self.handle_specific_force if drift is INERTIAL else lambda *_: None,
            estimate_state=self.navigation.estimate_state,
            make_interim_fix=lambda t_s: None,
        )
        super().__init__(navigator, speed_m_s=12.0, velocity_sd=0.0, **how)
        self.look = lambda t_s, seen_m: (seen_m, {})
        self.fly(gps_s).lose_gps()

    def handle_specific_force(self, t_s, force_m_s2, attitude):
        self.navigation.add_acceleration(t_s, np.array(force_m_s2[1::-1]))

    def match(self, step, vehicle):
        if self.has_gps:
            return
        seen_m, more = self.look(step * STEP_S, self.way[step] + self.rng.normal(0, self.fix_sd_m, 2))
        at = Position(*offset_position(*HOME, *seen_m))
        seen = make_fix(at, step * STEP_S, **{"fix_sd_m": self.fix_sd_m} | more)
        self.navigation.correct_by_fix(self.navigation.predict_fix(seen))

    def errors(self, from_s):
        """Errors of the navigation (N, 2), and what it said they were (N,)."""
        states = [(t_s, state) for t_s, state in self.states if t_s > from_s]
        errors_m = [self.measure_error(state.position.lat_deg, state.position.lon_deg, t_s) for t_s, state in states]
        return np.array(errors_m), np.array([state.accuracy_m for _, state in states])


def test_navigation_attitude_error_in_images_moves_no_fix_of_a_dead_reckoning_autopilot():
    flown, wrong = NavigatedFlight(10, fix_sd_m=0.5), np.array([0.06, 0.0])  # of the height: 3.4 degrees

    def look(t_s, seen_m):
        shown = AttitudeError(tuple(flown.rng.normal(wrong, 0.02)), 0.02)
        return seen_m - 100 * wrong, {"attitude_error": shown, "attitude_gain_s2": 100 / GRAVITY_M_S2}

    flown.look = look
    flown.fly(120)
    errors_m, said_m = flown.errors(10)
    assert np.median(norms(errors_m[200:])) < 1.5
    assert (abs(errors_m) < 2 * said_m[:, None]).mean() > 0.9


@pytest.mark.parametrize("upset", [drift._GPS_LOSS_NOISE_FACTOR, 0.0])
def test_navigation_allows_for_attitude_errors_after_a_new_wind(upset, monkeypatch):
    """4.5 degrees within ten seconds, 100 m high: fixes and strides lead 8 m away, and claim a metre."""
    monkeypatch.setattr(drift, "_GPS_LOSS_NOISE_FACTOR", upset)
    flown, frames = NavigatedFlight(30, wind=(5.0, 0.0), fix_sd_m=0.5), []

    def look(t_s, seen_m):
        seen_m[0] += 8.0 * np.clip((t_s - 30) / 10, 0, 1)
        frames.append((t_s, seen_m))
        stride = None
        if len(frames) > 1:
            (from_s, before), (to_s, now) = frames[-2:]
            stride = OdometryStep(from_s=from_s, to_s=to_s, moved_m=tuple(now - before), sd_m=0.7, inliers=100)
        return seen_m, {"fix_sd_m": 1.0, "attitude_gain_s2": 100 / GRAVITY_M_S2, "sd_m": 1.5, "odometry": stride}

    flown.look = look
    errors_m, said_m = flown.fly(15).errors(30)
    holds = (abs(errors_m) < 2 * said_m[:, None]).mean() >= 0.92
    assert holds == (upset > 0)


def test_navigation_without_tilt_measurements_does_not_learn_attitude_from_fixes():
    flown = NavigatedFlight(10, wind=(5.0, 0.0), fix_sd_m=2.0)
    flown.look = lambda t_s, seen_m: (seen_m, {"attitude_gain_s2": 18.0})
    errors_m, said_m = flown.fly(460).errors(70)
    assert np.median(norms(errors_m)) < 2.5
    assert said_m.max() < 4.0, "and does not grow"
    assert (abs(errors_m) < 2 * said_m[:, None]).mean() > 0.9


class ReceiverOnly:
    """A path of accelerations that stands still, beside a receiver that is `off_m` east of HOME and an estimate of the
    autopilot that is elsewhere, since it is made of our own positions."""

    def __init__(self):
        self.navigation, self.t_s, self.steady_since_s = Navigation(INERTIAL, 1.0), 0.0, 0.0

    def fly(self, seconds, off_m=0.0, has_gps=True, estimate_m=300.0, velocity_m_s=(0.0, 0.0)):
        for _ in range(round(seconds * 10)):
            self.t_s += 0.1
            self.navigation.add_acceleration(self.t_s, np.zeros(2))
            steady_for_s = self.t_s - self.steady_since_s
            where = offset_position(*HOME, off_m - RECEIVER_LAG_S * velocity_m_s[0], 0.0)
            known = {"velocity_m_s": velocity_m_s, "steady_for_s": steady_for_s}
            gps = make_receiver(where, 1.0, self.t_s, **known) if has_gps else None
            estimate = offset_position(*HOME, estimate_m, 0.0)
            known = {"has_gps": has_gps, "gps": gps, "velocity_m_s": (9.0, 0.0), "position_sd_m": 1.0}
            self.navigation.add_report(make_vehicle(*estimate, self.t_s, **known))
        return self

    @property
    def east_m(self):
        here = self.navigation.estimate_state(self.t_s).position
        return float(offset_m(*HOME, here.lat_deg, here.lon_deg)[0])


def test_navigation_by_accelerations_uses_the_receiver_and_never_the_estimate():
    flown = ReceiverOnly().fly(20)
    assert flown.east_m == pytest.approx(0.0, abs=0.5)
    assert flown.navigation.has_gps
    assert ReceiverOnly().fly(5, has_gps=False).navigation.estimate_state(5.0) is None, "its estimate may be ours"


def test_navigation_allows_for_the_lag_of_a_receiver():
    flown = ReceiverOnly()
    for number in range(100):
        flown.fly(0.1, off_m=2.0 * number, velocity_m_s=(20.0, 0.0))
    assert flown.east_m == pytest.approx(2.0 * 99, abs=1.5)


def test_steady_receiver_overrules_our_position_after_two_seconds():
    flown = ReceiverOnly().fly(20)
    flown.steady_since_s = flown.t_s
    flown.fly(1, off_m=150.0)
    assert flown.navigation.is_in_doubt
    assert not flown.navigation.has_gps
    assert flown.east_m == pytest.approx(0.0, abs=1.0), "a jump of a moment moves nothing"
    flown.fly(2, off_m=150.0)
    assert flown.navigation.has_gps
    assert not flown.navigation.is_in_doubt
    assert flown.east_m == pytest.approx(150.0, abs=1.0)


def test_contradicting_receiver_does_not_overrule_recent_matches():
    flown = ReceiverOnly().fly(20)
    for _ in range(5):
        flown.fly(1, off_m=150.0)
        fix = flown.navigation.predict_fix(make_fix(Position(*HOME), flown.t_s, 1.0))
        flown.navigation.correct_by_fix(fix)
    assert not flown.navigation.has_gps
    assert not flown.navigation.is_in_doubt
    assert flown.east_m == pytest.approx(0.0, abs=1.5)


def test_receiver_confirms_a_start_at_a_fix():
    flown = ReceiverOnly().fly(5, has_gps=False)
    flown.navigation.start_at_fix(make_fix(Position(*HOME), flown.t_s, 1.0))
    assert not flown.navigation.is_confirmed
    assert flown.fly(3).navigation.is_confirmed
    assert flown.fly(1, has_gps=False).navigation.is_confirmed


@pytest.mark.parametrize(
    ("log_height", "sd", "least_m", "most_m"), [(0.0, 0.0, 4.0, 8.0), (0.0, 0.3, 25.0, 35.0), (0.3, 0.1, 10.0, 20.0)]
)
def test_odometry_is_scaled_and_claims_the_error_of_terrain(log_height, sd, least_m, most_m):
    """A hundred metres of strides without a match: over flat ground, after a gap, and over ground that fell away."""
    errors = DriftFilter(INERTIAL, 1.0)
    errors.start(1.0, 100.0)
    errors.add_frame(0.0, np.zeros(2), 0.0, 0.2, None, np.zeros(2))
    for number in range(10):
        errors.predict(1.0, np.zeros(2))
        change, change_sd = (0.0, 0.0) if number else (log_height, sd)
        step = STRIDE(moved_m=(10.0, 0.0), log_height=change, log_height_sd=change_sd)
        assert errors.add_frame(0.0, np.zeros(2), 0.0, 0.2, step, np.zeros(2))
    offset_m, _, covariance = errors.estimate_errors(0.0)
    assert offset_m == pytest.approx((100 * math.exp(log_height), 0.0), abs=1.0)
    assert least_m <= math.sqrt(covariance[0, 0]) <= most_m


@pytest.mark.parametrize(("log_height", "turn"), [(0.3, 0.0), (0.0, 0.5)])
def test_known_scale_and_direction_of_odometry_are_applied_in_full(log_height, turn):
    errors = DriftFilter(INERTIAL, 1.0)
    errors.start(1.0, 0.1)
    errors.doubt_heading(turn)
    errors.correct_by_rotation(turn)
    errors.add_frame(0.0, np.zeros(2), 0.0, 0.2, None, np.zeros(2))
    moved_m, way_m = (10 * math.cos(turn), 10 * math.sin(turn)), np.array((10 * math.exp(log_height), 0.0))
    for number in range(20):
        errors.predict(1.0, np.zeros(2))
        height, sd = (0.0, 0.0) if number else (log_height, 0.02)
        step = STRIDE(moved_m=moved_m, log_height=height, log_height_sd=sd)
        assert errors.add_frame(0.0, np.zeros(2), 0.0, 0.2, step, way_m)
    assert np.hypot(*errors.estimate_errors(0.0)[0]) < 0.5


@pytest.mark.parametrize(
    ("moved_m", "gps_s", "turn", "is_used"),
    [(9.0, 0, None, False), (1.0, 0, None, True), (9.0, 3, None, False), (9.0, 20, None, True), (9.0, 0, 0.0, True)],
)
def test_odometry_after_a_large_step_of_the_heading_waits_for_gps_or_a_match(moved_m, gps_s, turn, is_used):
    errors = DriftFilter(INERTIAL, 1.0)
    errors.start(1.0, 0.1)
    errors.doubt_heading(1.5)
    for _ in range(gps_s):
        errors.correct_by_gps(np.zeros(2), 1.0, None, 0.3)
    if turn is not None:
        errors.correct_by_rotation(turn)
    errors.add_frame(0.0, np.zeros(2), 0.0, 0.2, None, np.zeros(2))
    errors.predict(1.0, np.zeros(2))
    step, way_m = STRIDE(moved_m=(moved_m, 0.0)), np.array((moved_m, 0.0))
    assert errors.add_frame(0.0, np.zeros(2), 0.0, 0.2, step, way_m) is is_used


def test_navigation_by_accelerations_alone_starts_at_a_fix():
    flown = NavigatedFlight(0, INERTIAL, fix_sd_m=2.0)
    navigation, match = flown.navigation, make_fix(Position(*HOME), -1.0, 3.0)
    navigation.start_at_fix(match)
    assert navigation.estimate_state(0.0) is None, "it may have accelerated since the frame was taken"
    for t_s in np.arange(-60.0, 0.01, 0.1):  # by an attitude that is wrong by two degrees
        navigation.add_acceleration(t_s, np.array([0.34, 0.0]))
    assert navigation.estimate_state(0.0) is None
    navigation.start_at_fix(match)
    assert navigation.estimate_state(0.0).accuracy_m > 10, "nobody knows how fast it was"
    assert not navigation.is_confirmed
    errors_m, _ = flown.fly(60).errors(40)
    assert norms(errors_m).max() < 6.0
    assert navigation.is_confirmed
