"""GPS receivers by their own messages: what they report, and for how long they are steady."""

import math

import pytest

from edgevpr.core.geodesy import moved
from edgevpr.mavlink.receivers import GPS_GONE_AFTER_S, Receivers
from edgevpr.mavlink.wire import mavlink

HOME = 50.0, 8.0
STEP_S = 0.2


def report(t_s, at_m=(0.0, 0.0), *, speed_m_s=0.0, course_deg=0.0, fix_type=3, h_acc_m=0.5, stamp_s=None):
    lat_deg, lon_deg = moved(*HOME, *at_m)
    stamp_us = round(1e6 * (t_s if stamp_s is None else stamp_s))
    where = round(lat_deg * 1e7), round(lon_deg * 1e7), 300_000
    fields = 100, 100, round(100 * speed_m_s), round(100 * course_deg), 10
    return mavlink.MAVLink_gps_raw_int_message(stamp_us, fix_type, *where, *fields, h_acc=round(1000 * h_acc_m))


def flown(seconds, start_s=100.0, **each):
    """Receivers that have reported a flight to the north at 10 m/s, and when they did so last."""
    receivers, t_s = Receivers(), start_s
    while t_s < start_s + seconds:
        t_s += STEP_S
        receivers.handle(report(t_s, (0.0, 10 * (t_s - start_s)), speed_m_s=10.0, **each), t_s)
    return receivers, t_s


def test_best_receiver_has_position_velocity_and_altitude_of_its_newest_report():
    receivers, t_s = flown(3)
    best = receivers.best(t_s)
    assert (best.sd_m, best.t_s, best.alt_m) == (0.5, t_s, 300.0)
    assert best.velocity_m_s == pytest.approx((0.0, 10.0))
    assert best.steady_for_s == pytest.approx(3 - STEP_S, abs=0.01)


@pytest.mark.parametrize(
    ("after_s", "at_m", "h_acc_m"), [(STEP_S, (30.0, 32.0), 0.5), (STEP_S, (0.0, 32.0), 40.0), (2.0, (0.0, 50.0), 0.5)],
    ids=["jump", "poor accuracy", "gap"],
)  # fmt: skip
def test_receiver_is_not_steady_after_a_jump_a_gap_or_with_poor_accuracy(after_s, at_m, h_acc_m):
    receivers, t_s = flown(3)
    receivers.handle(report(t_s + after_s, at_m, speed_m_s=10.0, h_acc_m=h_acc_m), t_s + after_s)
    assert receivers.best(t_s + after_s).steady_for_s == 0.0


def test_receiver_without_a_new_fix_is_gone():
    receivers, t_s = flown(3)
    frozen = report(t_s, (0.0, 30.0), stamp_s=t_s)
    later_s = t_s + GPS_GONE_AFTER_S + 0.1
    receivers.handle(frozen, later_s)
    assert receivers.best(later_s) is None, "its position is reported again, with the stamp of before"
    receivers, t_s = flown(3)
    receivers.handle(report(t_s, fix_type=1), t_s)
    assert receivers.best(t_s) is None


def test_receiver_that_edgevpr_plays_is_left_out():
    receivers, t_s = flown(3)
    assert receivers.best(t_s, own="GPS_RAW_INT") is None


def test_receiver_that_reports_no_speed_has_no_velocity():
    receivers = Receivers()
    unknown = report(1.0)
    unknown.vel = 2**16 - 1
    receivers.handle(unknown, 1.0)
    assert receivers.best(1.0).velocity_m_s is None
    assert math.isfinite(receivers.best(1.0).sd_m)
