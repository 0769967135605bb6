"""The watch over GPS, match by match: what contradicts GPS, and how many such matches prove it wrong."""

from dataclasses import replace

import pytest
from fakes import FakeClock, FakeLink, format_note, make_output, make_receiver, make_vehicle
from simulated_flight import HOME, make_match

from edgevpr.core.geodesy import offset_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Position
from edgevpr.frames.level import View
from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.receivers import RECEIVER_LAG_S
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.recognise.perspective import AttitudeError

BEGIN_S = 1000.0
EXACT = 0.6, 0.8  # standard deviations of match and receiver: together 1 m
USUAL = 3.0, 4.0


class GpsHover:
    """A watch over GPS of an aircraft that stands, with the standard deviations of matches and receiver."""

    def __init__(self, sd_m=EXACT, map_sd_m=0.0):
        self.link, self.navigator, self.sd_m = FakeLink(FakeClock()), Navigator(map_sd_m, 1.0), sd_m
        autopilot = make_output(self.link, self.navigator, FakeClock())
        self.watch = GpsWatch(map_sd_m, Notifier(FlightLog(None), self.link), autopilot)

    def match(self, off_m, after_s, places, *, lean=None, view=None, vehicle=None, **said):
        """Watch a match that is so far east of GPS, and return whether GPS is wrong."""
        t_s = BEGIN_S + after_s
        vehicle = vehicle or make_vehicle(*HOME, t_s, gps=make_receiver(HOME, self.sd_m[1], t_s), **said)
        position = Position(*offset_position(*HOME, off_m, 0.0))
        self.watch.update(make_match(position, t_s, vehicle, self.sd_m[0], places, view, lean))
        return self.watch.is_wrong

    def matches(self, *offsets_m, begin_s=0):
        """Watch a match a second, each of another place."""
        return [self.match(off_m, second, (second,)) for second, off_m in enumerate(offsets_m, begin_s)][-1]

    def distances_m(self):
        return [each.value for each in self.link.sent if getattr(each, "name", "") == "vpr_gps_m"]


@pytest.mark.parametrize(("sd_m", "map_sd_m", "limit_m"), [(EXACT, 0.0, 15.0), (USUAL, 0.0, 20.0), (USUAL, 12.0, 52.0)])
def test_match_contradicts_gps_beyond_four_standard_deviations(sd_m, map_sd_m, limit_m):
    assert not GpsHover(sd_m, map_sd_m).matches(*[limit_m - 0.1] * 3)
    assert GpsHover(sd_m, map_sd_m).matches(*[limit_m + 0.1] * 3)
    assert not GpsHover(sd_m, map_sd_m).matches(*[limit_m + 0.1] * 2)


# After 60 matches at 0 m and 60 at 6 m, of which the last 60 count, the mean is 3.81 m.
@pytest.mark.parametrize(
    ("sd_m", "before_m", "limit_m"),
    [(EXACT, [4] * 10, 11.0), (EXACT, [0] * 9, 15.0), (USUAL, [0] * 10, 17.5), (EXACT, [0] * 60 + [6] * 60, 10.81)],
)
def test_match_contradicts_gps_that_has_moved_relative_to_earlier_matches(sd_m, before_m, limit_m):
    seconds = len(before_m)
    for beyond_m, is_wrong in ((-0.02, False), (0.02, True)):
        watched = GpsHover(sd_m)
        watched.matches(*before_m)
        assert watched.matches(*[limit_m + beyond_m] * 3, begin_s=seconds) is is_wrong


def test_reset_forgets_how_matches_differed_from_gps():
    watched = GpsHover()
    watched.matches(*[0.0] * 10)
    watched.watch.reset()
    assert not watched.matches(*[-7.1] * 3, begin_s=10), "no offset is usual yet"
    watched = GpsHover()
    watched.matches(100.0, 100.0)
    watched.watch.reset()
    assert not watched.matches(100.0, 100.0, begin_s=2)
    watched.watch.reset()
    watched.matches(*[0.0] * 9, begin_s=4)
    assert not watched.matches(*[7.1] * 3, begin_s=13)


@pytest.mark.parametrize(
    ("matches", "is_wrong"),
    [
        ([(100, 0, (1,)), (100, 15, (2,)), (100, 30.0, (3,))], True),
        ([(100, 0, (1,)), (100, 15, (2,)), (100, 30.1, (3,))], False),
        # After 2 s the offset may have changed by 44.72 m.
        ([(100, 0, (1,)), (100, 1, (2,)), (144.6, 3, (3,))], True),
        ([(100, 0, (1,)), (100, 1, (2,)), (144.8, 3, (3,))], False),
        ([(100, 0, (1,)), (100, 1, (2,)), (0, 2, (3,)), (100, 3, (4,))], False),
        # Of a place that another one was of, it says nothing new, unless the aircraft hovers where it agreed before.
        ([(100, second, (1,)) for second in range(20)], False),
        ([(100, 0, (1, 2)), (100, 1, (1,)), (100, 2, (2,))], False),
        ([(100, 0, (1,)), (100, 1, (1, 2)), (100, 2, (1, 2, 3))], True),
        ([(0, 0, (1, 2)), (100, 1, (1,)), (100, 2, (1,)), (100, 3, (1,))], True),
        # A jammer that comes and goes: five within 20 s.
        ([((100, 0)[number % 2], 2.5 * number, (number,)) for number in range(9)], True),
        ([((100, 0)[number % 2], 2.52 * number, (number,)) for number in range(9)], False),
        ([((100, 0)[number % 2], 2.5 * number, (number % 2,)) for number in range(9)], False),
    ],
)
def test_gps_watch_requires_enough_matches_to_call_gps_wrong(matches, is_wrong):
    watched = GpsHover(USUAL)
    assert [watched.match(*match) for match in matches] == [False] * (len(matches) - 1) + [is_wrong]


def test_gps_watch_trusts_gps_again_after_three_agreeing_matches():
    watched = GpsHover()
    watched.matches(*[100.0] * 3)
    assert watched.matches(0.0, 0.0, begin_s=3)
    assert not watched.matches(0.0, begin_s=5)
    jammed = GpsHover()
    assert jammed.matches(*[100.0, 0.0] * 4, 100.0)
    assert jammed.matches(0.0, 0.0, 0.0, begin_s=9)
    assert jammed.match(0.0, 20.0, (20,)), "five contradicted it within 20 s"
    assert not jammed.match(0.0, 20.1, (21,))


@pytest.mark.parametrize(("agreeing", "trusts_gps"), [(2, True), (3, False)])
def test_gps_watch_trusts_gps_over_a_map_that_never_agreed(agreeing, trusts_gps):
    watched = GpsHover()
    assert watched.matches(*[0.0] * agreeing, *[100.0] * 3)
    assert watched.navigator.trusts_gps() is trusts_gps


def test_gps_watch_reports_again_once_the_distance_has_doubled():
    watched = GpsHover()
    watched.matches(100.0, 100.0, 100.0, 199.0, 201.0, 202.0, *[0.0] * 25)
    notes = [(Severity.WARNING, format_note(ReasonCode.GPS_DIFFERS, distance_m=off_m)) for off_m in (100, 201)]
    assert watched.link.texts() == [*notes, (Severity.INFO, format_note(ReasonCode.GPS_AGREES))]
    assert watched.distances_m()[:5] == pytest.approx([100.0, 100.0, 100.0, 199.0, 201.0], abs=0.01)


@pytest.mark.parametrize(
    ("lean", "height_m", "is_wrong"),
    [
        (AttitudeError((3.0, 4.0), 0.5), 10.0, False),  # at least 45 m
        (AttitudeError((3.0, 4.0), 4.5), 10.0, True),
        (AttitudeError((0.0, 0.0), 1.0), 40.0, True),
        (AttitudeError((40.0, 0.0), 0.0), None, True),
        (None, 40.0, True),
    ],
)
def test_match_may_differ_from_gps_by_its_attitude_error(lean, height_m, is_wrong):
    watched = GpsHover()
    for second in range(3):
        found = watched.match(60.0, second, (second,), lean=lean, height_m=height_m)
    assert found is is_wrong


def test_match_is_compared_with_the_receiver_position_at_its_time():
    velocity_m_s = 25.0, 0.0
    watched, where = GpsHover(), offset_position(*HOME, -25.0 * (0.8 + RECEIVER_LAG_S), 0.0)
    receiver = make_receiver(where, 1.0, BEGIN_S - 0.8, velocity_m_s=(0.0, 9.0))
    for velocity, off_m in ((velocity_m_s, 0.0), (None, 22.5)):
        watched.match(0.0, 0.0, (1,), vehicle=make_vehicle(*HOME, BEGIN_S, gps=receiver, velocity_m_s=velocity))
        assert watched.distances_m()[-1] == pytest.approx(off_m, abs=0.01)


def test_gps_watch_skips_what_cannot_be_compared():
    watched = GpsHover()
    for vehicle in (make_vehicle(*HOME, BEGIN_S, has_gps=False), make_vehicle(*HOME, BEGIN_S - 1.1)):
        watched.match(0.0, 0.0, (1,), vehicle=vehicle)
    watched.match(0.0, 0.0, (1,), view=View(reason=Reason(ReasonCode.TILTED, {"tilt_deg": 40.0})))
    here = make_match(Position(*HOME), BEGIN_S, make_vehicle(*HOME, BEGIN_S), 1.0, (1,))
    watched.watch.update(replace(here, vehicle=None))
    watched.watch.update(replace(here, located=None))
    assert watched.distances_m() == []
