"""CompanionWatch: what a pilot learns of the companion's supply and heat, from a tree that stands for /sys."""

from dataclasses import replace
from itertools import pairwise

import pytest
from fakes import FakeSource, format_note
from flights import make_flight_meter, select
from pictures import draw_texture

from edgevpr.cli.top import format_status
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.power.thermal import ThermalState, ThermalWatch
from edgevpr.runtime.flight.companionwatch import CompanionWatch

FINE = ThermalState(temperature_c=60.0, frequency_mhz=1800.0, throttled=False, why="", under_voltage=False, hot=False)
LOW = replace(FINE, why="under-voltage now", under_voltage=True)
UNKNOWN = ThermalState(temperature_c=None, frequency_mhz=None, throttled=None, why="")


@pytest.fixture
def watch_states(notifier, link):
    """Let states be read each second; return (second, severity, text) of all that is sent to the ground station."""

    def watch(states):
        companion, found = CompanionWatch(notifier), []
        for second, state in enumerate(states):
            companion.take(float(second), state)
            found += [(second, *text) for text in link.texts()[len(found) :]]
        return found

    return watch


def test_companion_watch_reports_a_problem_at_its_start_and_end(watch_states):
    assert watch_states([FINE] * 5 + [LOW] * 100 + [FINE] * 100) == [
        (5, Severity.WARNING, format_note(ReasonCode.UNDER_VOLTAGE)),
        (134, Severity.INFO, format_note(ReasonCode.SUPPLY_FINE)),
    ]


@pytest.mark.parametrize("apart", [2, 7, 29, 31, 45])
def test_companion_watch_reports_an_intermittent_problem_at_most_once_in_30_seconds(watch_states, apart):
    found = watch_states(([LOW] + [FINE] * (apart - 1)) * (600 // apart))
    times = [time for time, *_ in found]
    assert all(later - earlier >= 30 for earlier, later in pairwise(times))
    assert len(found) == 1 or apart > 30


def test_companion_watch_ignores_an_unknown_value(watch_states):
    assert watch_states([UNKNOWN] * 100) == []
    assert [severity for _, severity, _ in watch_states([LOW] * 5 + [UNKNOWN] * 100)] == [Severity.WARNING]


def test_companion_watch_reports_under_voltage_everywhere(make_flight, clock, link, tree, caplog):
    root = tree({(firmware := "sys/devices/platform/soc/soc:firmware/get_throttled"): "0\n"})
    flight, statuses = make_flight("hog"), []

    class Status:
        def write(self, status):
            statuses.append(status)
            tree({firmware: {1: "0\n", 2: "0\n", 3: "50005\n"}.get(len(statuses), "50000\n")})

    meter = make_flight_meter(flight, watch=ThermalWatch(root))
    lines = flight.fly(FakeSource([draw_texture(1, 240, 320)] * 45, clock), meter, status=Status())
    notes = [(line["note"]["code"], line["why"]) for line in select(lines, "companion")]
    begun = str(Reason(ReasonCode.UNDER_VOLTAGE))
    signs = "under-voltage, throttled now"
    assert notes[:2] == [("UNDER_VOLTAGE", signs), ("THROTTLED", signs)]
    assert {code for code, _ in notes[2:]} == {"SUPPLY_FINE", "FULL_SPEED"}
    texts = link.texts()
    assert (4, f"edgevpr: {begun}") in texts
    assert (6, format_note(ReasonCode.SUPPLY_FINE)) in texts
    assert [record.levelname for record in caplog.records if record.message == begun] == ["WARNING"]
    assert statuses[2]["under_voltage"] is False
    assert (statuses[3]["under_voltage"], statuses[3]["throttled"]) == (True, True)
    assert "supply      under-voltage" in format_status(statuses[3])
    assert f"remark      {begun}" in format_status(statuses[5]), "it is still shown when it has blinked"
    assert begun not in statuses[-1]["remarks"]
