"""What is said before take-off: the figures by hand, the notes that must not be missing, the table."""

import json
from dataclasses import asdict, replace

import pytest

from edgevpr.errors import UsageError
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.choose import TechniqueCosts
from edgevpr.runtime.estimate import FlightPlan, estimate, format_table
from edgevpr.types import StageCost

COSTS = {
    "regions": TechniqueCosts(StageCost(0.1, 0.1), StageCost(0.004, 0.004), 1_000, 124_000, 90.0),
    "vector": TechniqueCosts(StageCost(0.05, 0.1), StageCost(0.001, 0.002), 286_000, 286_000, 90.0),
}
PLAN = FlightPlan(
    100, rate_hz=1.0, flight_min=20.0, pack=parse_pack("4S5200"), regulator_efficiency=0.85, budget_mb=256
)
PI = load_board("rpi-4b")


def test_a_flight_on_the_board_itself_by_hand():
    regions, vector = estimate(PI, PI, COSTS, PLAN).techniques
    assert (regions.technique, regions.fits, vector.fits) == ("regions", True, True)
    assert (regions.map_ram_mb, regions.map_disk_mb, regions.process_ram_mb) == pytest.approx((0.1, 12.4, 90.1))
    assert (regions.t_encode_s, regions.t_match_s) == pytest.approx((0.1, 0.4))
    assert (regions.u_encode, regions.u_match) == pytest.approx((0.25, 0.25))  # one of four cores
    assert (vector.u_encode, vector.u_match) == pytest.approx((0.5, 0.5))
    assert regions.reachable_hz == pytest.approx(2.0)
    volt_hours = 14.8 * 0.85 * 3600
    assert regions.query_mah == pytest.approx(1000 * (2.29 + 4.53 * 0.25) * 0.5 / volt_hours, abs=1e-9)
    assert regions.query_marginal_mah == pytest.approx(1000 * 4.53 * 0.25 * 0.5 / volt_hours, abs=1e-9)
    # 1200 queries; the board idles from start to end, and the queries come on top.
    marginal_j, idle_j = 1200 * 4.53 * 0.25 * 0.5, 1200 * 2.29
    assert regions.flight_marginal_ah == pytest.approx(marginal_j / volt_hours, abs=1e-9)
    assert regions.flight_ah == pytest.approx((idle_j + marginal_j) / volt_hours, abs=1e-9)
    assert regions.flight_pack_frac == pytest.approx(regions.flight_ah / 5.2)


def test_a_rate_out_of_reach_is_not_charged_for():
    fast = estimate(PI, PI, COSTS, replace(PLAN, rate_hz=50.0)).techniques[0]
    reached = estimate(PI, PI, COSTS, replace(PLAN, rate_hz=2.0)).techniques[0]
    assert not fast.fits
    assert fast.flight_ah == pytest.approx(reached.flight_ah)


def test_a_technique_that_does_not_fit_says_why_and_what_would():
    rows = estimate(PI, PI, COSTS, replace(PLAN, places=2000)).techniques
    assert [row.fits for row in rows] == [False, False]
    assert rows[0].shortfalls == ("it reaches 0.12 Hz of 1",)
    assert rows[0].remedies == ("with up to 225 places", "at up to 0.12 Hz")
    assert "its map takes 572.0 MB of RAM and 256.0 are allowed" in rows[1].shortfalls


def test_figures_of_the_machine_itself_are_measured_and_carry_no_note():
    found = estimate(PI, PI, COSTS, PLAN)
    assert (found.times, found.verified, found.notes) == ("measured", True, ())


def test_figures_of_another_board_are_scaled_and_say_so():
    found = estimate(PI, load_board("generic-x86"), COSTS, PLAN)
    assert found.times == "scaled"
    assert found.techniques[0].t_encode_s == pytest.approx(0.1 / 0.38)
    assert len(found.notes) == 1
    assert "scaled from this machine to 0.38 of its speed (unverified; 7-zip" in found.notes[0]
    assert "not measured on this board" in found.notes[0]


def test_figures_for_a_board_of_unknown_speed_are_unscaled_and_say_so():
    found = estimate(load_board("thesis-xeon"), PI, COSTS, PLAN)
    assert found.times == "unscaled"
    assert found.techniques[0].t_encode_s == 0.1
    assert (
        "not measured on this board: the speed of the thesis's server (Xeon Gold 6134) is not known" in found.notes[0]
    )


def test_a_machine_of_unknown_speed_is_named_when_its_times_cannot_be_scaled():
    here = replace(load_board("generic-x86"), title="this machine (Radxa)", relative_speed=None, speed_source="nobody")
    found = estimate(PI, here, COSTS, PLAN)
    assert "the speed of this machine (Radxa) is not known (nobody)" in found.notes[0]


def test_unverified_power_is_said_with_its_source():
    board = load_board("rpi-zero-2w")
    found = estimate(board, board, COSTS, PLAN)
    assert not found.verified
    assert found.notes == (f"The power of Raspberry Pi Zero 2 W is unverified: {board.source}.",)


def test_the_table_has_a_line_for_each_technique_in_columns_and_every_note():
    board = load_board("rpi-zero-2w")
    found = estimate(board, load_board("generic-x86"), COSTS, replace(PLAN, places=1000))
    heading, heads, regions, vector, *rest = format_table(found).splitlines()
    assert heading.startswith("Raspberry Pi Zero 2 W: 1000 places, 1 Hz, 20 min, 4S5200 at 85% regulator efficiency")
    assert heading.endswith("times scaled")
    assert regions.split()[:4] == ["regions", "no", "1000", "1.0"]
    assert heads.index("disk MB") + len("disk MB") == regions.index("124.0") + len("124.0")
    assert len(heads) == len(regions) == len(vector)
    assert rest[0].startswith("regions does not fit: it reaches 0.043 Hz of 1; it would fit with up to 19 ")
    assert tuple(rest[2:]) == found.notes


def test_the_estimate_is_ready_for_json():
    there_and_back = json.loads(json.dumps(asdict(estimate(PI, PI, COSTS, PLAN))))
    assert there_and_back["plan"]["pack"] == {"cells": 4, "capacity_mah": 5200}
    assert there_and_back["techniques"][1]["technique"] == "vector"
    assert there_and_back["techniques"][1]["fits"] is True


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"places": 0}, "The number of places is 0: give a number above 0."),
        ({"places": -5}, "The number of places is -5: give a number above 0."),
        ({"rate_hz": 0.0}, "The rate in Hz is 0: give a number above 0."),
        ({"flight_min": -20.0}, "The length of the flight in minutes is -20: give a number above 0."),
        ({"flight_min": float("nan")}, "The length of the flight in minutes is nan: give a number above 0."),
        ({"budget_mb": float("inf")}, "The budget in MB is inf: give a number above 0."),
    ],
)
def test_a_plan_that_makes_no_sense_is_one_sentence(change, sentence):
    with pytest.raises(UsageError) as raised:
        replace(PLAN, **change)
    assert str(raised.value) == sentence
