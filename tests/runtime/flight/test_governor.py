"""The governor with a clock and readings that say what the test wants."""

import itertools
from dataclasses import replace

import pytest

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.power.boards import load_board
from edgevpr.runtime.flight.governor import Change, Governor, Setting, list_settings
from edgevpr.runtime.flight.metering import LoadReading

BOARD = replace(load_board("rpi-4b"), cpu_share=0.5, memory_max_mb=512)
LIMIT_C = 80
REQUESTED = Setting(2.0, 40)


def make_reading(**values):
    usual = {"cpu_share": 0.1, "late_share": 0.0, "rss_mb": 100.0, "temperature_c": None, "throttled": None}
    return LoadReading(**usual | values)


CALM = make_reading(cpu_share=0.05, temperature_c=50.0, throttled=False)
BUSY = make_reading(cpu_share=0.9, temperature_c=50.0, throttled=False)


class Flight:
    """Looks once a second; `reading` says what is measured of a setting at a time."""

    def __init__(self, reading, settings=None):
        self.settings = settings or list_settings(REQUESTED, keeps_rate=False, fewer=(20,))
        self.governor = Governor(BOARD, LIMIT_C, self.settings)
        self.reading, self.now_s = reading, 0.0
        self.changes = []

    def fly(self, seconds):
        """The changes of these seconds."""
        before = len(self.changes)
        for _ in range(seconds):
            self.now_s += 1
            change = self.governor.update(self.now_s, self.reading(self.governor.setting, self.now_s))
            if change:
                self.changes.append((self.now_s, change))
        return [change for _, change in self.changes[before:]]


def load(setting):
    """The load beside that of 2 Hz with 40 candidates: half of a query's time goes to its candidates."""
    return setting.rate_hz / 2 * (1 + setting.candidates / 40) / 2


def test_governor_lowers_candidates_before_the_rate():
    settings = list_settings(Setting(1.0, 40, "float"), keeps_rate=False, fewer=(20,))
    rates_hz = 1.0, 0.5, 0.25, 0.125
    assert settings == (Setting(1.0, 40, "float"), *(Setting(rate_hz, 20, "float") for rate_hz in rates_hz))
    flight = Flight(lambda setting, now_s: BUSY, settings)
    changes = flight.fly(60)
    assert [change.after for change in changes[:-1]] == list(settings[1:])
    assert [change.before for change in changes[:-1]] == list(settings[:-1])
    assert {b - a for (a, _), (b, _) in itertools.pairwise(flight.changes)} == {4.0}, "each step is given time to tell"
    taken = Reason(ReasonCode.CPU_OVER_LIMIT, {"cpu_share": 0.9, "max_share": 0.5})
    assert changes[-1] == Change(settings[-1], settings[-1], taken)


def test_governor_reverts_in_the_opposite_order():
    flight = Flight(lambda setting, now_s: BUSY if now_s <= 60 else CALM)
    flight.fly(60)
    assert flight.governor.setting == Setting(0.25, 20)
    flight.fly(600)
    assert [change.after for _, change in flight.changes if change.is_upward] == [*reversed(flight.settings[:-1])]
    assert flight.governor.setting == REQUESTED


def test_list_settings_keeps_the_rate_of_a_sequence_and_needs_two_stages_for_candidates():
    assert list_settings(REQUESTED, keeps_rate=True, fewer=(20,)) == (REQUESTED, Setting(2.0, 20))
    assert list_settings(REQUESTED, keeps_rate=True) == (REQUESTED,)
    assert list_settings(Setting(2.0, 15), keeps_rate=True, fewer=(20,)) == (Setting(2.0, 15),)
    fewer = list_settings(Setting(2.0, 42), keeps_rate=True, fewer=(50, 42, 20, 10))
    assert [each.candidates for each in fewer] == [42, 20, 10]
    assert [each.rate_hz for each in list_settings(REQUESTED, keeps_rate=False)] == [2.0, 1.0, 0.5, 0.25]


def test_governor_reports_once_what_it_cannot_change():
    flight = Flight(lambda setting, now_s: BUSY, settings=(REQUESTED,))
    (change,) = flight.fly(600)
    assert change.before == change.after == REQUESTED
    flight.reading = lambda setting, now_s: CALM
    assert flight.fly(60) == []
    flight.reading = lambda setting, now_s: BUSY
    assert len(flight.fly(60)) == 1, "a trouble that had gone is said again"


@pytest.mark.parametrize("full_c", [81, 84, 90, 100])
def test_governor_holds_a_slowly_heating_board_below_its_limit(full_c):
    """A first-order board: 90 s to react, `full_c` degrees at the rate asked, 40 idle."""
    hottest_c, temperature_c = [], [40.0]

    def reading(setting, now_s):
        aim_c = 40 + (full_c - 40) * load(setting)
        temperature_c[0] += (aim_c - temperature_c[0]) / 90
        hottest_c.append(temperature_c[0])
        return make_reading(temperature_c=temperature_c[0], throttled=False)

    flight = Flight(reading)
    first = flight.fly(3600)
    assert first
    assert first[0].why.code is ReasonCode.BOARD_HOT
    assert max(hottest_c) < 81.5
    assert len(flight.fly(3600)) <= 13, "one try every ten minutes"


def measure_recovery_s(flight, trouble_s):
    """How long after this long a trouble all is as it was asked."""
    until_s = flight.now_s + trouble_s
    flight.reading = lambda setting, now_s: BUSY if now_s <= until_s else CALM
    flight.fly(trouble_s)
    while flight.governor.setting != REQUESTED:
        flight.fly(1)
    return flight.now_s - until_s


def test_governor_doubles_its_wait_after_failures_and_resets_it_after_a_long_success():
    flight = Flight(lambda setting, now_s: CALM, settings=list_settings(REQUESTED, keeps_rate=False))
    assert [measure_recovery_s(flight, 5) for _ in range(3)] == [7, 13, 25]
    assert measure_recovery_s(flight, 13) == 3 * 49, "one failure, however many steps it takes"
    flight.fly(600)
    assert measure_recovery_s(flight, 5) == 7


def test_governor_trusts_throttling_without_a_temperature():
    flight = Flight(lambda setting, now_s: make_reading())
    assert flight.fly(600) == []
    flight.reading = lambda setting, now_s: make_reading(throttled=True)
    (change,) = flight.fly(10)
    assert (change.after.rate_hz, change.why.code) == (1.0, ReasonCode.BOARD_THROTTLED)


def test_governor_lowers_the_rate_while_other_programs_delay_queries():
    def reading(setting, now_s):
        takes = 0.7 * load(setting)  # of the time; another program doubles it until 100 s
        return make_reading(cpu_share=0.2, late_share=min(1.0, 2 * takes) if now_s < 100 else takes)

    flight = Flight(reading)
    fewer, slower = flight.fly(99)
    assert (fewer.after, slower.after) == (Setting(2.0, 20), Setting(1.0, 20))
    assert slower.why.code is ReasonCode.QUERIES_LATE
    assert [change.after for change in flight.fly(60)] == [Setting(2.0, 20), REQUESTED]


def test_governor_reports_low_memory_once():
    (change,) = Flight(lambda setting, now_s: make_reading(rss_mb=500.0)).fly(600)
    assert change.before == change.after == REQUESTED
    assert change.why.code is ReasonCode.MEMORY_OVER_LIMIT
