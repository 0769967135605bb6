"""Flights that are governed: what a change does, how it is said, and when it is taken back."""

import pytest
from fakes import FakeClock, FakeLink, FakeSource
from flights import Flight, make_flight_meter, select
from pictures import draw_texture

from edgevpr.runtime.flight.metering import FlightMeter, LoadReading
from edgevpr.runtime.recognise.recogniser import Recogniser

pytestmark = pytest.mark.slow

TURN_S = 4.0  # more than the governor's patience: each reading can bring a change
CALM = LoadReading(cpu_share=0.01, late_share=0.0, rss_mb=100.0, temperature_c=40.0, throttled=False)
BUSY = LoadReading(cpu_share=1.0, late_share=0.0, rss_mb=100.0, temperature_c=40.0, throttled=False)


class ScriptedMeter(FlightMeter):
    """A meter that reads what stands in a script, a reading a turn, and calm after its end."""

    def __init__(self, battery, board, clock, machine, *, readings):
        super().__init__(battery, board, clock, machine)
        self._readings, self._begin_s, self._now = readings, clock.mono_s(), clock.mono_s

    def read_load(self):
        turn = round((self._now() - self._begin_s) / TURN_S) - 1
        return self._readings[turn] if turn < len(self._readings) else CALM


def govern(place_map, log, readings, count, fewer_candidates=(), **settings):
    """(changes, all lines, announcements, the flight) of a flight of `count` turns of 4 s."""
    clock = FakeClock()
    flight = Flight(place_map, log, clock, FakeLink(clock, answer=None), **settings)
    source = FakeSource([draw_texture(0, 240, 320)] * count, clock, work=lambda: clock.sleep(TURN_S))
    lines = flight.fly(source, make_flight_meter(flight, ScriptedMeter, readings=readings), fewer_candidates)
    return select(lines, "governor"), lines, flight.link.texts(), flight


def test_governor_change_is_logged_and_announced_once_and_reverted(recording, tmp_path, statuses, caplog):
    script = [BUSY] * 2 + [CALM] * 3
    changes, _, texts, _ = govern(recording / "cohog.gpkg", tmp_path / "log", script, 8, **{"source.rate_hz": 60.0})
    down, back = changes
    asked, half = {"rate_hz": 60.0, "candidates": 42, "form": None}, {"rate_hz": 30.0, "candidates": 42, "form": None}
    assert (down["from"], down["to"], back["from"], back["to"]) == (asked, half, half, asked)
    assert down["why"]["code"] == "CPU_OVER_LIMIT"
    assert down["why"]["parameters"]["cpu_share"] == pytest.approx(1.0, abs=0.005)
    assert [(severity, text.endswith("30 of 60 Hz")) for severity, text in texts] == [(5, True), (6, False)]
    assert [record.levelname for record in caplog.records if "held to" in record.message] == ["WARNING"]
    assert any("30 of 60" in status for status in statuses)
    assert "held to" not in statuses[-1]


def test_governor_lowers_candidates_before_the_rate_in_flight(recording, tmp_path, monkeypatch):
    compared = []
    step = Recogniser.step
    monkeypatch.setattr(
        Recogniser, "step", lambda self, *asked: (compared.append(self.candidates), step(self, *asked))[1]
    )
    place_map, keys = recording / "cohog.gpkg", {"source.rate_hz": 60.0}
    changes, _, texts, _ = govern(place_map, tmp_path / "log", [BUSY] * 99, 12, (20,), **keys)
    assert [line["to"]["candidates"] for line in changes] == [20] * 5
    assert [line["to"]["rate_hz"] for line in changes] == [60.0, 30.0, 15.0, 7.5, 7.5]
    assert set(compared) == {42, 20}
    assert changes[-1]["from"] == changes[-1]["to"]
    assert "over a limit" in texts[-1][1]
