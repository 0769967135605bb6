"""The loop through the autopilot: our positions correct its attitude, its attitude levels our pictures, and these give
our next position. It must hold for every accuracy that a configuration can ask for, and with gyros of any quality."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from closed_loop import ClosedLoop

from edgevpr.runtime.flight import drift, navigator

pytestmark = pytest.mark.slow

GOOD_SD = 0.0  # of gyros: a root second; PX4's simulator has the latter
SIM_SD = math.radians(0.57)


def hover(min_accuracy_m, gyro_sd, show_tilt, seconds=80):
    """Return how far a copter is from its target, step by step, while it hovers by our positions alone."""
    flight = ClosedLoop("px4-copter", min_accuracy_m=min_accuracy_m, EKF2_AGP0_CTRL=1).fly(40)
    flight.gyro_sd, flight.show_tilt = gyro_sd, show_tilt
    flown = len(flight.away_m)
    flight.set("SIM_GPS1_ENABLE", 0).fly(seconds)
    sent = [message for _, message in flight.sent if message.get_type() == "GLOBAL_POSITION_SENSOR"]
    assert min(message.eph for message in sent) >= 0.999 * min_accuracy_m
    return np.array(flight.away_m[flown:])


hover_once = cache(hover)


@pytest.mark.parametrize(
    ("min_accuracy_m", "gyro_sd", "show_tilt"),
    [
        (0.1, GOOD_SD, True),
        (20.0, GOOD_SD, True),
        (0.1, GOOD_SD, False),
        (2.0, GOOD_SD, False),
        (0.1, SIM_SD, True),
        (1.0, SIM_SD, True),
    ],
)
def test_loop_is_stable_for_each_claimed_accuracy(min_accuracy_m, gyro_sd, show_tilt):
    away_m = hover_once(min_accuracy_m, gyro_sd, show_tilt)
    room_m = max(3.0, min_accuracy_m) * (2.0 if gyro_sd == SIM_SD else 1.0)
    assert np.median(away_m) < 1.2 * room_m
    assert away_m.max() < 4 * room_m


def test_positions_do_not_end_while_matches_come_whose_times_are_wrong():
    flight = ClosedLoop("px4-copter", EKF2_AGP0_CTRL=0, EKF2_EV_CTRL=1).fly(40)
    flight.time_error_s = 0.3
    flight.set("SIM_GPS1_ENABLE", 0).fly(75)
    assert len(flight.positions_sent(flight.now_s - 5)) > 45


def test_loop_diverges_if_claims_equal_match_accuracy_and_tilt_is_not_measured(monkeypatch):
    """And with gyros that are taken to be as good as they are. This is how a PX4 was lost within a minute."""
    monkeypatch.setattr(navigator, "CORRELATION_FACTOR", 1.0)
    monkeypatch.setattr(navigator, "INERTIAL_PX4", replace(drift.INERTIAL, acceleration_noise=0.02))
    assert hover(0.1, GOOD_SD, show_tilt=False, seconds=400).max() > 20.0


def test_loop_is_tight_if_images_show_the_tilt():
    away_m = {shows: hover_once(0.1, SIM_SD, shows) for shows in (True, False)}
    assert np.median(away_m[True]) < 0.8 * np.median(away_m[False])
