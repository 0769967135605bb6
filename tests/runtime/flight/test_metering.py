"""What a flight says of its own cost: by the closed form, by the process's own clock, and with the board's heat."""

import random
from dataclasses import asdict
from itertools import chain, repeat
from types import SimpleNamespace

import pytest
from fakes import FakeSource
from flights import make_flight_meter, select
from pictures import draw_texture

from edgevpr.power.thermal import ThermalState

pytestmark = pytest.mark.slow

PICTURE = draw_texture(1, 240, 320)


def test_used_mah_of_a_flight_equals_the_closed_form(make_flight, clock):
    """Five minutes on a Pi 4B (2.29 W idle, 4.53 W more at full load, four cores) with stages of all lengths."""
    script, spent = random.Random(5), []

    def work():
        wall_s, cores = script.uniform(0.001, 0.6), script.uniform(0, 2)
        spent.append(wall_s * cores)
        clock.work(wall_s, cores)

    flight = make_flight(**{"board": "rpi-4b", "source.rate_hz": 0.5, "match.candidates": 1})
    technique = flight.recogniser.technique
    encode, scan = technique.encode, technique.score_places
    technique.encode = lambda *seen: (work(), encode(*seen))[1]
    technique.score_places = lambda *asked: (work(), scan(*asked))[1]
    begin_s = clock.now_s
    lines = flight.fly(FakeSource([PICTURE] * 150, clock, work=work))
    totals, elapsed_s = flight.end, clock.now_s - begin_s
    assert elapsed_s > 290
    mah = 1000 / (14.8 * 0.85 * 3600)  # of a joule, with the pack of the configuration
    busy_j = 4.53 / 4 * sum(spent)
    assert len(spent) == 3 * 150
    assert totals["used_mah"] == pytest.approx(mah * (2.29 * elapsed_s + busy_j), rel=1e-6)
    assert totals["marginal_mah"] == pytest.approx(mah * busy_j, rel=1e-6), "nothing else was done"
    # The queries' own charge is idle power while they last and what they add; reading the picture stands beside it.
    queries = select(lines, "query")
    assert len(queries) == 150
    in_queries_mah = sum(line["costs"]["marginal_mah"] for line in queries)
    reading_mah = mah * 4.53 / 4 * sum(line["reading"]["cpu_s"] for line in queries)
    assert in_queries_mah + reading_mah == pytest.approx(totals["marginal_mah"], rel=1e-5), "the log has six digits"
    assert sum(line["costs"]["used_mah"] for line in queries) < totals["used_mah"]
    assert queries[-1]["totals"]["used_mah"] == pytest.approx(totals["used_mah"], rel=1e-6)


def test_throttling_is_logged_and_announced_and_marks_the_figures(make_flight, clock, link):
    cool = ThermalState(temperature_c=61.0, frequency_mhz=1800.0, throttled=False, why="")
    hot = ThermalState(temperature_c=84.0, frequency_mhz=600.0, throttled=True, why="throttled now", under_voltage=True)
    flight = make_flight("hog")
    watch = SimpleNamespace(read=chain([cool] * 3, repeat(hot)).__next__, close=lambda: None)
    meter = make_flight_meter(flight, watch=watch)
    boards = [line["board"] for line in select(flight.fly(FakeSource([PICTURE] * 6, clock), meter), "query")]
    assert (boards[0], boards[-1]) == (asdict(cool), asdict(hot))
    told = [each.temperature_core[0] for each in link.sent if each.get_type() == "ONBOARD_COMPUTER_STATUS"]
    assert told[0] == 61
    assert told[-1] == 84
