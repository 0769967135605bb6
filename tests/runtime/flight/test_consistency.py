"""A fix that contradicts the autopilot's own position is held back until a second, independent one says the same."""

import math
from dataclasses import replace

import numpy as np
import pytest
from air import match_at
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import STEP_DEG, Flight, of_kind
from pictures import textured

from edgevpr.core.geodesy import distance_m, offset_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Position
from edgevpr.frames.level import View
from edgevpr.runtime.flight.consistency import ComparedFix, Consistency
from edgevpr.runtime.flight.measurements import FrameMeasurement, PositionedMatch
from edgevpr.runtime.flight.navigator import Navigator

HOME = 50.0, 8.0
START_S = 1000.0


class Aircraft:
    """An aircraft that flies north, and loses GPS as the test begins. Its autopilot reckons without an error."""

    def __init__(self, speed_m_s=15.0, has_gps=False):
        self.navigator = Navigator(1.0, 1.0)
        self.speed_m_s, self.has_gps = speed_m_s, has_gps
        self.t_s = START_S - 5.0
        self.go_on(START_S, has_gps=True)

    def go_on(self, t_s, **said):
        said = {"has_gps": self.has_gps, "position_sd_m": 2.0} | said
        while self.t_s < t_s:
            self.t_s = round(self.t_s + 0.2, 3)
            here = offset_position(*HOME, 0.0, self.speed_m_s * (self.t_s - START_S))
            velocity = (0.0, self.speed_m_s)
            self.vehicle = vehicle_at(*here, self.t_s, velocity_m_s=velocity, roll_deg=0.0, pitch_deg=0.0, **said)
            self.navigator.handle_vehicle(self.vehicle)

    def report(self, off_m, after_s=0.0, *, places=(1,), fix_sd_m=8.0, heard=True, turned_deg=None):
        """The advice on a match `after_s` seconds after the loss of GPS, `off_m` (east, north) off the aircraft."""
        if heard:
            self.go_on(START_S + after_s)
        here = offset_position(self.vehicle.lat_deg, self.vehicle.lon_deg, *off_m)
        view = View(up_deg=0.0)
        event = match_at(Position(*here), START_S + after_s, self.vehicle, fix_sd_m, places, view)
        event = replace(event, located=replace(event.located, heading_deg=turned_deg))
        return self.navigator.advise(event, START_S + after_s)

    def held(self, *fixes):
        """Tell which fixes (off_m, after_s, places) are held back, in turn."""
        return [self.report(off_m, after_s, places=places).is_held for off_m, after_s, places in fixes]


def every_second(offsets_m):
    """Fixes of different places, one a second."""
    return [(off_m, t_s, (t_s,)) for t_s, off_m in enumerate(offsets_m, 1)]


AT = (0, 0)
FAR = (500, 0)
ELSEWHERE = (-700, 0)


@pytest.mark.parametrize(
    ("fixes", "held"),
    [
        (every_second([(10, 20), (-15, 0), AT]), "..."),
        (every_second([(500, 0), (-500, 0), (500, 200)]), "hhh"),
        (every_second([AT, AT, AT, FAR, AT, AT]), "...h.."),
        (every_second([FAR, FAR, FAR, ELSEWHERE, FAR, FAR]), "h..h.."),
        (every_second([FAR, AT, FAR]), "h.h"),
        ([(FAR, 1, (1, 2)), (FAR, 2, (2, 3))], "hh"),  # they share a place
        ([(FAR, 1, (1, 2)), (FAR, 2, (3, 4))], "h."),
        ([(FAR, 1, ()), (FAR, 2, ())], "hh"),  # by the best place
        (
            [((200 + 20 * t_s, 0), t_s, (t_s, t_s + 1)) for t_s in range(1, 9)],
            "hhhhhh..",
        ),  # every second one shares none
        ([((200 + 20 * t_s, 0), t_s, (1, 2)) for t_s in range(1, 12)], "h" * 11),
        ([((300, 0), 60.0, (1,))], "."),  # nobody has corrected the path for so long
    ],
)
def test_consistency_holds_back_until_an_independent_fix_agrees(fixes, held):
    assert Aircraft().held(*fixes) == [each == "h" for each in held]


def test_one_that_contradicts_is_held_back_and_says_by_how_much():
    advice = Aircraft().report((300, -400), 1.0)
    assert advice.fix is None
    assert not Aircraft().report((500, 0), 1.0, fix_sd_m=150.0).is_held, "an inexact one has room"
    assert advice.why.code is ReasonCode.HELD_OFF_PATH
    assert advice.why.parameters["off_m"] == pytest.approx(500.0, abs=0.5)


def test_a_second_one_of_another_place_that_says_the_same_is_sent_and_so_are_those_after_it():
    aircraft = Aircraft()
    advices = [aircraft.report((500, 5 * t_s), t_s, places=(t_s,)) for t_s in range(1, 7)]
    assert [advice.is_held for advice in advices] == [True] + [False] * 5
    sent = advices[1].fix
    assert distance_m(sent.lat_deg, sent.lon_deg, *offset_position(*HOME, 500, 10 + 15 * 2)) < 8, (
        "and not between the two"
    )


def test_the_same_place_again_is_no_second_one_until_the_aircraft_has_moved_on():
    hovering, creeping = Aircraft(speed_m_s=0.0), Aircraft(speed_m_s=12.0)
    same = [((500, 0), t_s, (1,)) for t_s in range(1, 13)]
    assert hovering.held(*same[:6]) == [True] * 6
    found = creeping.held(*same)
    assert found[:3] == [True] * 3
    assert not found[-1]
    stuck = Aircraft()
    assert stuck.held(*[((500, -15 * t_s), t_s, (1,)) for t_s in range(1, 8)]) == [True] * 7, "it says nothing new"


def test_a_picture_that_is_suddenly_turned_against_the_compass_is_held_back_until_others_say_the_same():
    aircraft = Aircraft()
    told = [aircraft.report((0, 0), t_s, places=(t_s,), turned_deg=3.0) for t_s in range(1, 4)]
    assert [advice.is_held for advice in told] == [False] * 3
    alone = aircraft.report((0, 0), 4, places=(4,), turned_deg=180.0)
    assert alone.why.code is ReasonCode.HELD_TURNED
    assert not aircraft.report((0, 0), 5, places=(5,), turned_deg=3.0).is_held
    broken = [aircraft.report((0, 0), t_s, places=(t_s,), turned_deg=100.0).is_held for t_s in range(6, 12)]
    assert broken == [True, True, True, False, False, False], "a compass that has gone wrong"


def test_a_compass_that_was_wrong_from_the_start_is_none_of_its_business():
    aircraft = Aircraft()
    told = [aircraft.report((0, 0), t_s, places=(t_s,), turned_deg=140.0).is_held for t_s in range(1, 6)]
    assert told == [False] * 5


def test_against_gps_no_fix_is_believed():
    aircraft = Aircraft(has_gps=True)
    advices = [aircraft.report((500, 0), t_s, places=(t_s,)) for t_s in range(1, 5)]
    assert all(advice.is_held for advice in advices)
    assert advices[0].why.code is ReasonCode.HELD_OFF_GPS
    assert advices[0].why.parameters["off_m"] == pytest.approx(500.0, abs=0.5)


def fly(recording, tmp_path, pictures, off_deg=0.05, has_gps=False, **settings):
    """A flight past the places, one a second, with an autopilot that is `off_deg` of longitude off; its lines, link."""
    clock = FakeClock()

    def vehicle():
        north = 50 + STEP_DEG * (clock.now_s - 1000.0)
        said = {"has_gps": has_gps, "position_sd_m": 20.0, "velocity_m_s": (0.0, STEP_DEG * 111_195)}
        return vehicle_at(north, 8.0 + off_deg, clock.now_s, **said)

    link = FakeLink(clock, vehicle=vehicle)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0} | settings)
    lines = flight.fly(FakeSource([textured(number, 240, 320) for number in pictures], clock))
    return of_kind(lines, "query"), link


def test_in_flight_a_fix_held_back_is_in_the_log_and_the_ground_is_told_once(recording, tmp_path):
    queries, link = fly(recording, tmp_path, (0, 20, 2, 3, 4))
    assert all(line["accepted"] for line in queries), "held back or not, the match stays accepted"
    assert [line["fix"]["sent"] for line in queries] == [False, False, False, True, True]
    assert queries[0]["fix"]["why"]["code"] == "HELD_OFF_PATH"
    assert queries[0]["fix"]["why"]["parameters"]["off_m"] == pytest.approx(3574.0, abs=0.5)
    assert link.stats().fixes_sent == 2
    assert link.texts() == [
        (4, "edgevpr: fix held back, contradicts autopilot"),
        (6, "edgevpr: fixes agree again"),
    ]
    assert sum(each.name == "vpr_place" for each in link.sent if each.get_type() == "NAMED_VALUE_INT") == 5


def compared(off_m, t_s, place=1, *, path_m=0.0, expected_m=0.0, turn_deg=None):
    """A fix off to the east, whose covariance is 5.5 m2 and that of its prediction 30.5 m2: together 6 m."""
    frame = FrameMeasurement(t_s=float(t_s), sd_m=0.0)
    said = {"position": Position(*HOME), "accuracy_m": 1.0, "places": (place,), "turn_deg": turn_deg}
    path, off, expected = (np.array([each, 0.0]) for each in (path_m, off_m, expected_m))
    seen = PositionedMatch(frame=frame, covariance_m2=5.5 * np.eye(2), **said)
    return ComparedFix(seen=seen, path_m=path, off_m=off, expected_m=expected, covariance_m2=30.5 * np.eye(2))


VERDICTS = {"believed": (False, False), "against": (True, False), "lost": (True, True)}


@pytest.mark.parametrize(
    ("fixes", "is_followed", "last"),
    [
        ([(24.0, 0)], False, "believed"),
        ([(24.1, 0)], False, None),
        # Two that agree: after 2 s they differ by 6 m, with the drift that is allowed for.
        ([(100, 0, 1), (112.0, 2, 2)], False, "against"),
        ([(100, 0, 1), (112.1, 2, 2)], False, None),
        ([(100, 0, 1), (100, 30.0, 2)], False, "against"),
        ([(100, 0, 1), (100, 30.1, 2)], False, None),
        # Where the camera has followed the path it takes four, after 24 s within 2 * 12.45 m.
        ([(100, 8 * number, number) for number in range(3)], True, None),
        ([(100, 0, 0), (100, 8, 1), (100, 16, 2), (124.8, 24, 3)], True, "against"),
        ([(100, 0, 0), (100, 8, 1), (100, 16, 2), (125.0, 24, 3)], True, None),
        # The same place is another one if the aircraft has flown on by more than 24 m.
        ([(100, 0), (100, 2, 1, {"path_m": 24.0})], False, None),
        ([(100, 0), (100, 2, 1, {"path_m": 24.1})], False, "against"),
        ([(100, 0, 1, {"expected_m": 3.0}), (110, 2, 1, {"path_m": 13.9, "expected_m": 13.1})], False, None),
        ([(100, 0, 1, {"expected_m": 3.0}), (110, 2, 1, {"path_m": 14.1, "expected_m": 13.1})], False, "against"),
        # Four of different places that an aircraft of 30 m/s can have flown through within 10 s: the path is lost.
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.0, 10.0, 4)], False, "lost"),
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.1, 10.0, 4)], False, None),
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.0, 10.1, 4)], False, None),
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.0, 10.0, 3)], False, None),
        ([(100, 0, 1), (100, 0, 2), (190, 3, 3), (280, 6, 4)], True, None),
    ],
)
def test_consistency_believes_what_others_prove_within_limits(fixes, is_followed, last):
    judge = Consistency()
    *before, verdict = [
        judge.judge(compared(*each[:3], **dict(*each[3:])), has_gps=False, is_followed=is_followed) for each in fixes
    ]
    assert all(other.why for other in before)
    assert (verdict.why is None) is (last is not None)
    assert (verdict.is_against, verdict.is_lost) == VERDICTS.get(last, (False, False))


@pytest.mark.parametrize(("is_followed", "good_for_s"), [(True, 2.5), (False, 30.0)])
def test_consistency_is_in_doubt_until_another_should_have_agreed(is_followed, good_for_s):
    judge = Consistency()
    assert not judge.is_contradicted(0.0, is_followed)
    for t_s in range(8):
        why = judge.judge(compared(-100, t_s), has_gps=False, is_followed=is_followed).why
        assert why == Reason(ReasonCode.HELD_OFF_PATH, {"off_m": 100.0, "accuracy_m": math.sqrt(30.5)})
    assert judge.is_contradicted(7 + good_for_s, is_followed)
    assert not judge.is_contradicted(7.1 + good_for_s, is_followed), "no other has agreed"
    assert judge.judge(compared(0.0, 9), has_gps=False, is_followed=is_followed).why is None
    assert not judge.is_contradicted(9.0, is_followed)


@pytest.mark.parametrize(("before_deg", "turn_deg"), [(100.0, 0.0), (0.0, 100.0)])
def test_consistency_reports_by_how_much_a_picture_is_turned(before_deg, turn_deg):
    judge = Consistency()
    judge.judge(compared(0.0, 0, turn_deg=before_deg), has_gps=True, is_followed=False)
    for has_gps in (True, False):
        why = judge.judge(compared(0.0, 1, turn_deg=turn_deg), has_gps=has_gps, is_followed=False).why
        assert why == Reason(ReasonCode.HELD_TURNED, {"turn_deg": turn_deg})
