"""A fix that contradicts the autopilot's own position is held back until a second, independent one says the same."""

from dataclasses import replace

import numpy as np
import pytest
from air import match_at
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import STEP_DEG, Flight, of_kind
from pictures import textured

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.core.reasons import ReasonCode
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
            here = moved(*HOME, 0.0, self.speed_m_s * (self.t_s - START_S))
            velocity = (0.0, self.speed_m_s)
            self.vehicle = vehicle_at(*here, self.t_s, velocity_m_s=velocity, roll_deg=0.0, pitch_deg=0.0, **said)
            self.navigator.hear_vehicle(self.vehicle)

    def report(self, off_m, after_s=0.0, *, places=(1,), fix_sd_m=8.0, heard=True, turned_deg=None):
        """The advice on a match `after_s` seconds after the loss of GPS, `off_m` (east, north) off the aircraft."""
        if heard:
            self.go_on(START_S + after_s)
        here = moved(self.vehicle.lat_deg, self.vehicle.lon_deg, *off_m)
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


def test_consistency_forgets_what_agreed_long_ago():
    near, late = Aircraft(speed_m_s=1.0), Aircraft(speed_m_s=1.0)
    assert near.held(((900, 0), 1, (1,)), ((900, 0), 28, (2,))) == [True, False]
    assert late.held(((900, 0), 1, (1,)), ((900, 0), 33, (2,))) == [True, True]


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
    assert distance_m(sent.lat_deg, sent.lon_deg, *moved(*HOME, 500, 10 + 15 * 2)) < 8, "and not between the two"


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


def test_matches_win_over_a_path_that_parts_from_them_faster_than_it_drifts():
    aircraft = Aircraft()
    told = [aircraft.report((200 + 20 * t_s, 0), t_s, places=(t_s,), fix_sd_m=1.0) for t_s in range(1, 5)]
    assert [advice.is_held for advice in told] == [True, True, True, False]
    aircraft = Aircraft()
    told = [aircraft.report((200 + 60 * t_s, 0), t_s, places=(t_s,), fix_sd_m=1.0) for t_s in range(1, 9)]
    assert all(advice.is_held for advice in told), "no aircraft of ours flies through these"


def test_against_gps_no_fix_is_believed():
    aircraft = Aircraft(has_gps=True)
    advices = [aircraft.report((500, 0), t_s, places=(t_s,)) for t_s in range(1, 5)]
    assert all(advice.is_held for advice in advices)
    assert advices[0].why.code is ReasonCode.HELD_OFF_GPS
    assert advices[0].why.parameters["off_m"] == pytest.approx(500.0, abs=0.5)


def test_where_the_autopilot_says_nothing_of_its_position_a_fix_is_sent_as_it_is():
    aircraft = Aircraft()
    assert not aircraft.report((500, 0), 2.5, heard=False).is_held, "its last report is too old"
    knows_nothing = Navigator(1.0, 1.0)
    aircraft.navigator = knows_nothing
    assert aircraft.report((500, 0), 3.0, heard=False).fix


def test_an_autopilot_that_has_only_just_appeared_is_sent_nothing_until_it_had_time_to_say_where_it_is():
    aircraft = Aircraft()
    aircraft.navigator.hear_autopilot(START_S + 1.0)
    too_early = aircraft.report((500, 0), 5.9, heard=False)
    assert (too_early.fix, too_early.why.code) == (None, ReasonCode.NO_TELEMETRY)
    assert aircraft.report((500, 0), 6.1, heard=False).fix, "it has none"


def test_an_autopilot_whose_reports_fail_for_seconds_is_sent_nothing():
    aircraft = Aircraft(has_gps=True)
    assert not aircraft.report((0, 0), 2.0, heard=False).fix, "its GPS is still there"
    assert not aircraft.report((0, 0), 4.9, heard=False).fix
    assert aircraft.report((0, 0), 5.1, heard=False).fix


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


def test_while_match_after_match_contradicts_a_path_that_is_followed_it_is_in_doubt():
    judge, here = Consistency(), np.zeros(2)
    for t_s in range(8):
        frame = FrameMeasurement(t_s=float(t_s), sd_m=0.5)
        how = {"position": Position(*HOME), "accuracy_m": 1.0, "covariance_m2": np.eye(2), "places": (1,)}
        fix = ComparedFix(
            seen=PositionedMatch(frame=frame, **how),
            path_m=here,
            off_m=np.array([20.0, 0.0]),
            expected_m=here,
            covariance_m2=np.eye(2),
        )
        assert judge.judge(fix, has_gps=False, is_followed=True).why, "of one place they are one"
    assert judge.is_contradicted(8.0, is_followed=True)
    assert not judge.is_contradicted(11.0, is_followed=True), "no other has agreed"
