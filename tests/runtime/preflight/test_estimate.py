"""What is said before take-off: the figures by hand, the notes that must not be missing."""

from dataclasses import replace

import pytest
from example_costs import REGIONS, found
from example_costs import VECTOR as ONE_CORE_VECTOR

from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.power.speed import Speed
from edgevpr.runtime.preflight import choose
from edgevpr.runtime.preflight.estimate import FlightPlan
from edgevpr.runtime.preflight.estimate import estimate_flight as estimate_of
from edgevpr.runtime.preflight.scale import SAME_MACHINE
from edgevpr.runtime.preflight.trial import Trial

VECTOR = replace(ONE_CORE_VECTOR, encode=StageCost(0.05, 0.1), match_per_place=StageCost(0.001, 0.002))
COSTS = {"regions": REGIONS, "vector": VECTOR}
PLAN = FlightPlan(
    places=100, rate_hz=1.0, flight_min=20.0, pack=parse_pack("4S5200"), regulator_efficiency=0.85, budget_mb=256
)
PI = load_board("rpi-4b")
SLOWER = Speed(products=0.056, passes=0.2)


@pytest.fixture(autouse=True)
def accuracies(monkeypatch):
    recalls = {"regions": 0.9, "vector": 0.5, "cohog": 0.9, "hog": 0.4, "hog 1bit": 0.2}
    table = {label: found(recall) for label, recall in recalls.items()}
    monkeypatch.setattr(choose, "_read_accuracies", lambda: {"forward": table, "nadir": {}})
    return table


def trials(costs):
    return [Trial(label=label, name=label.split()[0], settings={}, costs=each) for label, each in costs.items()]


def estimate(costs, plan=PLAN, board=PI, ratio=SAME_MACHINE):
    return estimate_of(board, ratio, trials(costs), plan)


def test_estimate_of_a_flight_on_the_board_itself_by_hand():
    regions, vector = estimate(COSTS).techniques
    option, query = regions.option, regions.query
    assert (option.label, option.misfit, vector.option.misfit) == ("regions", None, None)
    assert (option.map_ram_mb, option.map_disk_mb, option.process_ram_mb) == pytest.approx((0.1, 12.4, 90.1))
    assert (query.t_encode_s, query.t_match_s) == pytest.approx((0.1, 0.4))
    assert (query.u_encode, query.u_match) == pytest.approx((0.25, 0.25))  # one of four cores
    assert (vector.query.u_encode, vector.query.u_match) == pytest.approx((0.5, 0.5))
    assert option.reachable_hz == pytest.approx(2.0)
    volt_hours = 14.8 * 0.85 * 3600
    assert query.used_mah == pytest.approx(1000 * (2.29 + 4.53 * 0.25) * 0.5 / volt_hours, abs=1e-9)
    assert query.marginal_mah == pytest.approx(1000 * 4.53 * 0.25 * 0.5 / volt_hours, abs=1e-9)
    # 1200 queries; the board idles from start to end, and the queries come on top.
    marginal_j, idle_j = 1200 * 4.53 * 0.25 * 0.5, 1200 * 2.29
    assert regions.flight_marginal_mah == pytest.approx(1000 * marginal_j / volt_hours, abs=1e-6)
    assert regions.flight_mah == pytest.approx(1000 * (idle_j + marginal_j) / volt_hours, abs=1e-6)
    assert regions.flight_pack_frac == pytest.approx(regions.flight_mah / 5200)


def test_estimate_charges_no_rate_that_is_out_of_reach():
    fast = estimate(COSTS, replace(PLAN, rate_hz=50.0)).techniques[0]
    reached = estimate(COSTS, replace(PLAN, rate_hz=2.0)).techniques[0]
    assert fast.option.misfit
    assert fast.flight_mah == pytest.approx(reached.flight_mah)


@pytest.mark.parametrize(
    ("board", "ratio", "times", "notes"),
    [
        ("rpi-4b", SAME_MACHINE, "measured", ()),
        ("rpi-4b", SLOWER, "scaled", ("0.056 times this machine's speed", "1741 million")),
        ("odroid-xu4", SLOWER, "scaled", ("networks and full comparisons run at 0.0", "8.5 W")),
        ("thesis-xeon", None, "unscaled", ("no published figure", "The power of the thesis's server")),
        ("rpi-zero-2w", SAME_MACHINE, "measured", ("The power of Raspberry Pi Zero 2 W is unverified",)),
    ],
)
def test_estimate_notes_how_far_figures_can_be_trusted(board, ratio, times, notes):
    estimated = estimate(COSTS, PLAN, load_board(board), ratio)
    assert estimated.times == times
    assert all(part in note for part, note in zip(notes, estimated.notes, strict=True))


def test_estimate_recommends_the_most_accurate_that_fits_and_says_why():
    forms = {"cohog": COSTS["regions"], "hog": COSTS["vector"], "hog 1bit": COSTS["vector"]}
    estimated = estimate(forms, board=replace(PI, technique=None))
    assert estimated.recommended == "cohog"
    assert estimated.reason.startswith("cohog: the most accurate that fits: recall@1 0.90 on 2 image sets")
    assert estimate({"netvlad": VECTOR}).recommended is None
