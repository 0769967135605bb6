"""The autopilot is asked for another set of sources (42007) where its operator allows it, once."""

import math
from dataclasses import replace

import pytest
from fakes import FakeClock, FakeLink, make_output
from simulated_flight import SimFlight

from edgevpr.core.config import SourceSetsConfig
from edgevpr.mavlink.messages import SET_SOURCE_SET, Health
from edgevpr.power.meter import MachineLoad
from edgevpr.runtime.flight.autopilot import SourceSets
from edgevpr.runtime.flight.navigator import Navigator

pytestmark = pytest.mark.slow

NEVER_S = -math.inf
SETS = {"source_sets.gps": 1, "source_sets.no_gps": 2}
BOTH_SETS = SourceSetsConfig(gps=1, no_gps=2)
LOAD = MachineLoad((0.5,), 1, 2)


class AnsweringFlight(SimFlight):
    """A flight whose autopilot answers at once to what it is asked; `asked` are the times and numbers."""

    def __init__(self, **settings):
        super().__init__(Navigator(1.0, 1.0, is_muted=not settings.get("send_fixes", True)))
        self.clock, self.asked, self.health = FakeClock(0.0), [], Health.ACTIVE
        self.link = FakeLink(self.clock, vehicle=lambda: self.vehicle)
        stats = self.link.stats
        self.link.stats = lambda: replace(stats(), answered_s={SET_SOURCE_SET: self.asked[-1][0]} if self.asked else {})
        self.autopilot = make_output(self.link, self.navigator, self.clock, **settings)
        super().fly(20)

    def fly(self, seconds):
        for _ in range(seconds):
            super().fly(1)
            self.clock.now_s = self.t_s
            self.link.sent.clear()
            self.autopilot.report(self.health, LOAD, None, is_paused=self.health is Health.STANDBY)
            commands = [each for each in self.link.sent if each.get_type() == "COMMAND_LONG"]
            to = {(each.command, each.target_system, each.target_component) for each in commands}
            assert to <= {(SET_SOURCE_SET, 1, 1)}
            self.asked += [(self.t_s, int(each.param1)) for each in commands]
        return self

    def find_gps(self):
        self.has_receiver = self.has_gps = True

    @property
    def numbers(self):
        return [number for _, number in self.asked]


def test_source_sets_request_the_set_without_gps_once_and_the_other_after_three_seconds_of_gps():
    flown = AnsweringFlight(**SETS).fly(5)
    assert flown.numbers == [1], "it starts in flight, where another may be in use"
    lost_s = flown.t_s
    flown.lose_gps()
    assert flown.fly(20).numbers == [1, 2]
    assert flown.asked[1][0] < lost_s + 6
    found_s = flown.t_s
    flown.find_gps()
    assert flown.fly(20).numbers == [1, 2, 1]
    assert 3 <= flown.asked[2][0] - found_s <= 5


def test_source_sets_treat_a_wrong_receiver_as_none():
    flown = AnsweringFlight(**SETS)
    flown.autopilot.compare_gps(100.0, is_wrong=True, have_agreed=True)
    assert flown.fly(3).numbers == [2]
    flown.autopilot.compare_gps(3.0, is_wrong=False, have_agreed=True)
    assert flown.fly(15).numbers == [2, 1]


def test_source_sets_keep_a_receiver_that_is_near_the_map():
    flown = AnsweringFlight(**SETS)
    flown.autopilot.compare_gps(24.0, is_wrong=True, have_agreed=True)
    assert flown.fly(6).numbers == [1]
    flown.autopilot.compare_gps(26.0, is_wrong=True, have_agreed=True)
    assert flown.fly(3).numbers == [1, 2]


def test_source_sets_keep_a_receiver_that_never_agreed_with_the_map():
    flown = AnsweringFlight(**SETS)
    flown.autopilot.compare_gps(100.0, is_wrong=True, have_agreed=False)
    assert flown.fly(3).numbers == []


@pytest.mark.parametrize("given", [{}, {"source_sets.gps": 1}, {"source_sets.no_gps": 2}, SETS | {"send_fixes": False}])
def test_source_sets_request_nothing_without_both_sets_or_in_a_dry_run(given):
    flown = AnsweringFlight(**given)
    flown.lose_gps()
    flown.fly(20).find_gps()
    assert flown.fly(20).numbers == []


def choose(sets, now_s, has_gps, has_own=True, answered_s=NEVER_S, has_receiver=False, is_flying=False):
    state = {"has_gps": has_gps, "has_receiver": has_receiver, "has_own": has_own, "is_flying": is_flying}
    return sets.choose_set(now_s, **state, answered_s=answered_s)


@pytest.mark.parametrize("is_flying", [True, False])
def test_source_sets_request_the_set_with_gps_after_a_start_in_flight(is_flying):
    sets = SourceSets(BOTH_SETS)
    asked = [choose(sets, 0.5 * step, step > 4, False, is_flying=is_flying or step > 1) for step in range(20)]
    assert [0.5 * step for step, number in enumerate(asked) if number] == ([5.5, 7.5, 9.5] if is_flying else [])
    assert set(asked) - {None} == ({1} if is_flying else set())


def test_source_sets_repeat_an_unanswered_request():
    sets = SourceSets(BOTH_SETS)
    asked = [choose(sets, t_s / 2, False, answered_s=5.1 if t_s > 10 else NEVER_S) for t_s in range(30)]
    assert [t_s / 2 for t_s, number in enumerate(asked) if number == 2] == [0, 2, 4]
    assert choose(sets, 40.0, True, answered_s=5.1) == 1, "GPS is good"
    assert choose(sets, 43.0, True, answered_s=5.1) == 1, "that answer was for the other one"


def test_source_sets_request_nothing_without_a_position_of_ours():
    sets = SourceSets(BOTH_SETS)
    assert choose(sets, 0.0, False, has_own=False) is None
    assert choose(sets, 1.0, False) == 2
    assert choose(sets, 2.0, False, answered_s=1.1) is None


def test_source_sets_prefer_a_steady_receiver_that_the_map_contradicts_to_nothing():
    sets = SourceSets(BOTH_SETS)
    assert choose(sets, 0.0, False, has_receiver=True) == 2
    for t_s, has_receiver, number in ((3.0, True, None), (3.1, False, None), (6.1, True, None), (6.2, True, 1)):
        assert choose(sets, t_s, False, has_own=False, answered_s=0.1, has_receiver=has_receiver) == number


def test_source_sets_request_nothing_while_paused():
    flown = AnsweringFlight(**SETS)
    flown.health = Health.STANDBY
    flown.lose_gps()
    assert flown.fly(10).numbers == []
    flown.health = Health.ACTIVE
    assert flown.fly(1).numbers == [2]
