"""When a source counts as lost, damaged or frozen, and is opened anew."""

import pytest

from edgevpr.frames.liveness import Liveness
from edgevpr.frames.shot import Condition, Refusal


def make_liveness(*new_s, opened_s=0.0):
    """That of a source opened at `opened_s`, with new pictures at these times."""
    found = Liveness()
    found.record_opening(opened_s)
    for t_s in new_s:
        assert found.record_picture(t_s) is None
    return found


def measure_fault_s(watched, wanted, start_s=0.0, refusal=None, every_s=0.1):
    """Seconds from `start_s` until a fault is `wanted`, of a source of which every picture is refused so."""
    for step in range(1, 1000):
        if refusal:
            watched.record_refusal(refusal, start_s + step * every_s)
        if (fault := watched.find_fault(start_s + step * every_s)) and wanted(fault):
            return pytest.approx(step * every_s, abs=1.5 * every_s)
    return None


def has_condition(condition):
    return lambda fault: fault.condition is condition


def must_reopen(fault):
    return fault.must_reopen


@pytest.mark.parametrize(
    ("interval_s", "lost_s"), [(0.04, 3.0), (1.0, 3.0), (2.0, 5.0), (5.0, 12.5), (10.0, 25.0), (20.0, 30.0)]
)
def test_source_is_lost_after_three_seconds_or_longer_at_a_low_rate(interval_s, lost_s):
    watched = make_liveness(*(number * interval_s for number in range(8)))
    assert measure_fault_s(watched, has_condition(Condition.LOST), 7 * interval_s) == lost_s
    assert measure_fault_s(watched, must_reopen, 7 * interval_s) == lost_s


LOST = has_condition(Condition.LOST)
DAMAGED = has_condition(Condition.DAMAGED)
LATE = has_condition(Condition.LATE)


@pytest.mark.parametrize(
    ("new_s", "opened_s", "refusal", "wanted", "after_s"),
    [
        ((), None, None, LOST, 12.0),  # the first picture is waited for
        ((1.0,), None, None, LOST, 12.0),  # and the second, of a slow camera
        ((0.0, 0.1, 0.2, 60.0, 60.1), None, None, LOST, 3.0),  # one long pause does not make it slow
        ((0.0, 0.1, 0.2), 20.0, None, LOST, 12.0),  # opened anew, it may wait for a key frame
        ((0.0, 0.1), None, Refusal.DAMAGED, DAMAGED, 3.0),
        ((0.0, 0.1), None, Refusal.DAMAGED, must_reopen, 5.0),
        ((), None, Refusal.DAMAGED, must_reopen, 12.0),  # a key frame may be ten seconds away
        ((0.0, 0.1), None, Refusal.LATE, LATE, 3.0),
        ((0.0, 0.1), None, Refusal.LATE, must_reopen, 30.0),
        ((), None, Refusal.LATE, LATE, 12.0),
    ],
)
def test_source_without_a_usable_picture_has_a_fault_in_time(new_s, opened_s, refusal, wanted, after_s):
    watched = make_liveness(*new_s)
    if opened_s is not None:
        watched.record_opening(opened_s)
    assert measure_fault_s(watched, wanted, opened_s or max(new_s, default=0.0), refusal) == after_s


def test_reopened_source_keeps_its_rate():
    watched = make_liveness(0.0, 0.1, 0.2)
    watched.record_opening(20.0)
    watched.record_picture(25.0)
    assert measure_fault_s(watched, has_condition(Condition.LOST), 25.0) == 3.0
    assert make_liveness(0.0, 5.0).find_fault(10.0) is None


@pytest.mark.parametrize(
    ("repeats", "step_s", "is_frozen"),
    [(5, 0.1, False), (11, 0.1, True), (2, 0.9, False), (3, 0.9, True), (3, 0.2, False)],
)
def test_image_repeated_three_times_over_a_second_is_frozen(repeats, step_s, is_frozen):
    watched = make_liveness(0.0, 0.1)
    for _ in range(repeats):
        watched.record_refusal(Refusal.FROZEN, 0.1)
    fault = watched.find_fault(0.1 + repeats * step_s)
    assert (fault is not None and fault.condition is Condition.FROZEN) == is_frozen


def test_frozen_source_is_reopened_at_growing_intervals_until_images_change():
    watched, waits_s = make_liveness(0.0, 0.1), []
    for _ in range(5):
        watched.record_opening(0.0)
        waits_s.append(measure_fault_s(watched, must_reopen, 0.0, Refusal.FROZEN))
        watched.record_reopening(watched.find_fault(100.0))
    assert waits_s == [5.0, 10.0, 20.0, 30.0, 30.0]
    watched.record_opening(0.0)
    assert watched.record_picture(0.1) is Refusal.FROZEN, "it may be the frozen picture, coded in another way"
    assert watched.record_picture(0.2) is None
    assert measure_fault_s(watched, must_reopen, 0.2, Refusal.FROZEN) == 5.0


def test_new_image_ends_each_fault():
    for refusal in (Refusal.FROZEN, Refusal.DAMAGED, Refusal.PATCHED, Refusal.LATE):
        watched = make_liveness(0.0, 0.1)
        for _ in range(20):
            watched.record_refusal(refusal, 9.9)
        assert watched.find_fault(10.0)
        watched.record_picture(10.1)
        assert watched.find_fault(10.2) is None
