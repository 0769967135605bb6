"""The estimate as a person reads it."""

from dataclasses import replace

import pytest
from example_costs import REGIONS
from example_costs import VECTOR as ONE_CORE_VECTOR

from edgevpr import techniques
from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.preflight.estimate import FlightPlan, estimate
from edgevpr.runtime.preflight.estimate_text import format_table
from edgevpr.runtime.preflight.trial import Trial

ZERO, HERE = load_board("rpi-zero-2w"), load_board("generic-x86")
PLAN = FlightPlan(
    places=1000, rate_hz=1.0, flight_min=20.0, pack=parse_pack("4S5200"), regulator_efficiency=0.85, budget_mb=256
)
VECTOR = replace(ONE_CORE_VECTOR, encode=StageCost(0.05, 0.1), match_per_place=StageCost(0.001, 0.002))


def text(trials, plan=PLAN, board=ZERO, **more):
    return format_table(estimate(board, HERE, trials, plan, **more))


def test_three_tables_have_a_line_for_each_technique_in_columns():
    said = text(
        [
            (Trial(label="regions", name="regions", settings={}, costs=REGIONS), False),
            (Trial(label="vector", name="vector", settings={}, costs=VECTOR), False),
        ]
    )
    heading, _, heads, regions, vector, _, finds, regions_finds, _, _, draws, regions_draws, _, _, *rest = (
        said.splitlines()
    )
    assert heading == (
        "Raspberry Pi Zero 2 W: 1000 places, 1 Hz, 20 min, 4S5200 at 85% regulator efficiency; times measured, scaled"
    )
    assert regions.split()[:4] == ["regions", "no", "1000", "1.0"]
    assert heads.index("disk MB") + len("disk MB") == regions.index("124.0") + len("124.0")
    assert len(heads) == len(regions) == len(vector)
    assert len(draws) == len(regions_draws)
    assert finds.split()[:4] == ["technique", "fits", "recall@1", "accepted"]
    assert regions_finds.split() == ["regions", "no", "?", "?", "?", "never", "measured"]
    assert "lost" not in draws
    doubt, why, *rest = rest
    assert doubt == (
        "regions does not fit: it reaches 0.021 Hz of 1 and a query takes 45.9 s, and no fix of a frame older than 5 s "
        "is ever"
    )
    assert why == "  sent."
    assert "The power of Raspberry Pi Zero 2 W is unverified" in said
    assert rest[-1].startswith("Recommended: None: nothing that was tried fits")


def test_minutes_lost_are_there_when_the_hover_power_is():
    said = text(
        [(Trial(label="regions", name="regions", settings={}, costs=REGIONS), False)], replace(PLAN, hover_w=150.0)
    )
    assert "hovering at 150 W" in said.splitlines()[0]
    assert said.splitlines()[8].split()[-4:] == ["pack", "min", "lost", "marginal"]


def test_what_cannot_be_used_is_a_row_and_a_reason():
    broken = [
        (Trial(label=name, name=name, settings={}, problem="There is no model `calc`."), False)
        for name in ("calc", "alexnet")
    ]
    lines = text([(Trial(label="regions", name="regions", settings={}, costs=REGIONS), False), *broken]).splitlines()
    assert [line.split() for line in lines[4:6]] == [["calc", "n/a"], ["alexnet", "n/a"]]
    assert "calc, alexnet cannot be used: There is no model `calc`." in lines


@pytest.mark.parametrize("places", [10, 1_000_000])
def test_every_technique_and_form_fits_in_120_columns(places):
    offered = [f"{name} {form}".strip() for name in techniques.names() for form in ("", "8bit", "1bit")]
    trials = [
        (Trial(label=label, name=label.split()[0], settings={}, costs=VECTOR, weights="calc: " + 30 * "weights "), True)
        for label in offered
    ]
    said = text(
        trials, replace(PLAN, places=places, hover_w=1234.5), load_board("thesis-xeon"), measured_on="2026-01-01"
    )
    assert all(len(line) <= 120 for line in said.splitlines()[1:])
    assert "times measured on 2026-01-01 here, unscaled" in said.splitlines()[0]


def test_what_was_tried_now_among_stored_figures_is_said():
    said = text(
        [
            (Trial(label="regions", name="regions", settings={}, costs=REGIONS), True),
            (Trial(label="vector", name="vector", settings={}, costs=VECTOR), False),
        ],
        measured_on="2026-01-01",
    )
    assert "Not among the stored figures, and tried now: vector." in said
