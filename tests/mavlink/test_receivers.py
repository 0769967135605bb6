"""The autopilot's GPS receivers: what their reports say, which one is taken, and since when it is steady."""

import math

import pytest

from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Receiver
from edgevpr.mavlink.receivers import Receivers, extrapolate
from edgevpr.mavlink.wire import mavlink

HOME = 50.0, 8.0
BEGIN_S = 100.0
UNKNOWN_SPEED = 655.35
UNKNOWN_ACCURACY_M = (2**32 - 1) / 1000


def make_report(t_s, north_m=0.0, *, speed_m_s=10.0, course_deg=0.0, fix_type=3, h_acc_m=0.5, stamp_s=None):
    lat_deg, lon_deg = offset_position(*HOME, 0.0, north_m)
    stamp_us = round(1e6 * (t_s if stamp_s is None else stamp_s))
    where = round(lat_deg * 1e7), round(lon_deg * 1e7), 300_000
    fields = 100, 100, round(100 * speed_m_s), round(100 * course_deg), 10
    return mavlink.MAVLink_gps_raw_int_message(stamp_us, fix_type, *where, *fields, h_acc=round(1000 * h_acc_m))


def receive(*reports):
    """Receivers with reports (time, and what else they say)."""
    receivers = Receivers()
    for t_s, fields in reports:
        receivers.handle(make_report(t_s, **fields), t_s, t_s)
    return receivers


def test_best_receiver_has_position_velocity_and_altitude_of_its_newest_report():
    flown = [(BEGIN_S + 0.2 * number, {"north_m": 2.0 * number}) for number in range(15)]
    receivers = receive(*flown, (BEGIN_S + 3.0, {"north_m": 30.0, "speed_m_s": 20.0, "course_deg": 30.0}))
    best = receivers.choose_best(BEGIN_S + 5.5)
    assert (best.sd_m, best.t_s, best.alt_m, best.steady_for_s) == (0.5, BEGIN_S + 3.0, 300.0, 3.0)
    assert (best.lat_deg, best.lon_deg) == pytest.approx(offset_position(*HOME, 0.0, 30.0), abs=1e-7)
    assert best.velocity_m_s == pytest.approx((10.0, 10.0 * math.sqrt(3)))
    assert receivers.choose_best(BEGIN_S + 5.6) is None, "it has fallen silent"
    assert receivers.choose_best(BEGIN_S + 3.0, own="GPS_RAW_INT") is None, "edgevpr plays it"


@pytest.mark.parametrize(
    ("second_m", "estimate_m", "chosen_m"), [(8.0, 0.0, 8.0), (80.0, 1.0, 0.0), (80.0, 78.0, 80.0), (80.0, None, 80.0)]
)
def test_best_of_receivers_that_contradict_each_other_is_that_which_the_autopilot_uses(second_m, estimate_m, chosen_m):
    receivers = receive((BEGIN_S, {}))
    lat_deg, lon_deg = offset_position(*HOME, 0.0, second_m)
    position = round(lat_deg * 1e7), round(lon_deg * 1e7), 300_000
    fields = 3, *position, 100, 100, 0, 0, 10, 0, 0
    second = mavlink.MAVLink_gps2_raw_message(round(BEGIN_S * 1e6), *fields, h_acc=400)  # more accurate
    receivers.handle(second, BEGIN_S, BEGIN_S)
    estimate_deg = None if estimate_m is None else offset_position(*HOME, 0.0, estimate_m)
    best = receivers.choose_best(BEGIN_S + 1.0, estimate_deg=estimate_deg)
    assert (best.lat_deg, best.lon_deg) == pytest.approx(offset_position(*HOME, 0.0, chosen_m), abs=1e-7)


@pytest.mark.parametrize(
    ("after_s", "fields", "is_steady"),
    [
        (1.0, {"north_m": 17.9}, True),
        (1.0, {"north_m": 18.1}, False),  # a jump
        (1.0, {"north_m": 2.1}, True),
        (1.0, {"north_m": 1.9}, False),
        (1.0, {"north_m": 22.9, "speed_m_s": 20.0}, True),  # it has become faster
        (1.0, {"north_m": 23.1, "speed_m_s": 20.0}, False),
        (1.5, {"north_m": 15.0}, True),
        (1.6, {"north_m": 16.0}, False),  # a gap
        (1.0, {"north_m": 10.0, "h_acc_m": 15.0}, True),
        (1.0, {"north_m": 10.0, "h_acc_m": 15.1}, False),
        (1.0, {"north_m": 500.0, "speed_m_s": UNKNOWN_SPEED}, True),  # nothing to hold it against
    ],
)
def test_receiver_is_steady_without_a_jump_a_gap_or_poor_accuracy(after_s, fields, is_steady):
    best = receive((BEGIN_S, {}), (BEGIN_S + after_s, fields)).choose_best(BEGIN_S + after_s)
    assert best.steady_for_s == pytest.approx(after_s if is_steady else 0.0)


def test_receiver_without_a_new_fix_is_gone():
    frozen = receive((BEGIN_S, {}), (BEGIN_S + 2.6, {"stamp_s": BEGIN_S}))
    assert frozen.choose_best(BEGIN_S + 2.6) is None, "its position is reported again, with the stamp of before"
    assert receive((BEGIN_S, {}), (BEGIN_S + 1.0, {"fix_type": 2})).choose_best(BEGIN_S + 1.0) is None
    without_stamps = receive((BEGIN_S, {"stamp_s": 0.0}), (BEGIN_S + 1.0, {"stamp_s": 0.0}))
    assert without_stamps.choose_best(BEGIN_S + 1.0).t_s == BEGIN_S + 1.0


def test_receiver_whose_reports_stop_is_silent_unless_it_repeated_an_old_fix():
    fresh = receive((BEGIN_S, {}), (BEGIN_S + 0.6, {"stamp_s": BEGIN_S}))
    assert not fresh.is_silent(BEGIN_S + 2.5)
    assert fresh.is_silent(BEGIN_S + 2.6)
    assert not fresh.is_silent(BEGIN_S + 2.6, own="GPS_RAW_INT")
    lost = receive((BEGIN_S, {}), (BEGIN_S + 0.8, {"stamp_s": BEGIN_S}))
    assert lost.choose_best(BEGIN_S + 1.0).age_at_report_s == pytest.approx(0.8)
    assert not lost.is_silent(BEGIN_S + 60.0)
    assert not receive((BEGIN_S, {}), (BEGIN_S + 1.0, {"fix_type": 2})).is_silent(BEGIN_S + 60.0)


def test_receiver_without_speed_or_accuracy_gets_typical_ones():
    assert receive((BEGIN_S, {"speed_m_s": UNKNOWN_SPEED})).choose_best(BEGIN_S).velocity_m_s is None
    for accuracy_m in (0.0, UNKNOWN_ACCURACY_M):
        assert receive((BEGIN_S, {"h_acc_m": accuracy_m})).choose_best(BEGIN_S).sd_m == 5.0


@pytest.mark.parametrize(
    ("own", "other", "expected_m"),
    [((3.0, -4.0), None, (3.3, -4.4)), ((3.0, -4.0), (20.0, 0.0), (22.0, 0.0)), (None, None, (0.0, 0.0))],
)
def test_extrapolate_moves_a_report_by_its_age_and_lag(own, other, expected_m):
    receiver = Receiver(lat_deg=HOME[0], lon_deg=HOME[1], sd_m=1.0, t_s=BEGIN_S, velocity_m_s=own)
    assert offset_m(*HOME, *extrapolate(receiver, BEGIN_S + 1.0, other)) == pytest.approx(expected_m, abs=1e-3)
