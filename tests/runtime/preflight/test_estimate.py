"""What is said before take-off: the figures by hand, the notes that must not be missing."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from example_costs import REGIONS, make_accuracy
from example_costs import VECTOR as ONE_CORE_VECTOR

from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board, load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.preflight import choose
from edgevpr.runtime.preflight.estimate import compute_counted_costs, estimate_flight
from edgevpr.runtime.preflight.trial import Trial

VECTOR = replace(ONE_CORE_VECTOR, encode=StageCost(0.05, 0.1), match_per_place=StageCost(0.001, 0.002))
COSTS = {"regions": REGIONS, "vector": VECTOR}
PLAN = choose.FlightPlan(
    places=100, rate_hz=1.0, flight_min=20.0, pack=parse_pack("4S5200"), regulator_efficiency=0.85, budget_mb=256
)
PI = load_board("rpi-4b")
COUNTED = replace(REGIONS, candidates=40, scan_per_place=StageCost(1e-6, 1e-6))


@pytest.fixture(autouse=True)
def accuracies(monkeypatch):
    recalls = {"regions": 0.9, "vector": 0.5, "cohog": 0.9, "hog": 0.4, "hog 1bit": 0.2}
    table = {label: make_accuracy(recall) for label, recall in recalls.items()}
    monkeypatch.setattr(choose, "_read_accuracies", lambda: {"forward": table, "nadir": {}})
    return table


@pytest.fixture
def on_this_board(monkeypatch):
    """The estimate is made on the board itself."""
    monkeypatch.setattr(Board, "is_this_machine", lambda board: True)


def estimate(costs, plan=PLAN, board=PI):
    trials = [Trial(label=label, name=label.split()[0], settings={}, costs=each) for label, each in costs.items()]
    return estimate_flight(board, trials, plan)


@pytest.mark.usefixtures("on_this_board")
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


@pytest.mark.usefixtures("on_this_board")
def test_estimate_uses_no_rate_beyond_reach():
    fast = estimate(COSTS, replace(PLAN, rate_hz=50.0)).techniques[0]
    reached = estimate(COSTS, replace(PLAN, rate_hz=2.0)).techniques[0]
    assert fast.option.misfit
    assert fast.flight_mah == pytest.approx(reached.flight_mah)


@pytest.mark.parametrize(
    ("board", "times", "recommended", "notes"),
    [
        ("rpi-4b", "counted", "cohog", ("1741 million", "Raspberry Pi 4B")),
        ("rpi-zero-2w", "counted", "cohog", ("838 million", "The costs", "The power")),
        ("odroid-xu4", "unknown", None, ("cohog, vector", "8.5 W")),
        ("thesis-xeon", "unknown", None, ("run `edgevpr profile` on the board", "The power")),
    ],
)
def test_estimate_of_another_board_uses_counted_instructions_and_reports_it(board, times, recommended, notes):
    estimated = estimate({"cohog": REGIONS, "vector": VECTOR}, board=load_board(board))
    assert (estimated.times, estimated.recommended) == (times, recommended)
    assert [row.option.label for row in estimated.techniques] == ["cohog"] * (times == "counted")
    assert estimated.unknown == (("vector",) if times == "counted" else ("cohog", "vector"))
    assert all(part in note for part, note in zip(notes, estimated.notes, strict=True))


@pytest.mark.usefixtures("on_this_board")
def test_estimate_on_the_board_itself_notes_unverified_power_alone():
    estimated = estimate(COSTS, board=load_board("rpi-zero-2w"))
    assert (estimated.times, estimated.unknown) == ("measured", ())
    (note,) = estimated.notes
    assert "Raspberry Pi Zero 2 W" in note


@pytest.mark.usefixtures("on_this_board")
def test_estimate_recommends_the_most_accurate_that_fits_with_the_reason():
    forms = {"cohog": COSTS["regions"], "hog": COSTS["vector"], "hog 1bit": COSTS["vector"]}
    estimated = estimate(forms, board=PI)
    assert estimated.recommended == "cohog"
    assert estimated.reason.startswith("cohog: ")
    assert "recall@1 0.90 on 2 image sets" in estimated.reason
    assert estimate({"netvlad": VECTOR}).recommended is None


def count_costs(name, board=PI, **parameters):
    trial = Trial(label=name, name=name, settings={}, costs=COUNTED, parameters=parameters)
    return compute_counted_costs(trial, board)


def test_compute_counted_costs_scales_instructions_but_not_memory():
    there = count_costs("cohog", camera="nadir")
    parts, rate_hz = read_instructions(), 1e6 * PI.benchmark_score.arm64_mips
    assert there.encode.wall_s == pytest.approx(parts["down: encode a frame"] / rate_hz, rel=1e-6)
    query_s = there.encode.wall_s + replace(there, candidates=30).match(10_000).wall_s
    landmarks = parts["flight: landmarks of a frame"] + 2 * parts["flight: odometry since the last frame"]
    assert query_s == pytest.approx((parts["down: a query"] + landmarks) / rate_hz, rel=1e-3)
    assert (there.ram_bytes_per_place, there.process_mb) == (1_000, 90.0)


def test_compute_counted_costs_is_none_for_other_techniques_settings_and_processors():
    assert count_costs("cohog") == count_costs("cohog", camera="forward", w1=512, gt=0.4)
    assert count_costs("cohog", w1=256) is None
    assert count_costs("cohog", matching="thesis") is None
    assert count_costs("hog") is None
    assert count_costs("cohog", load_board("odroid-xu4")) is None


def read_instructions():
    results = Path(__file__).parents[3] / "benchmarks" / "results" / "arm64.json"
    return {row["part"]: row["instructions"] for row in json.loads(results.read_text())["parts"]}
