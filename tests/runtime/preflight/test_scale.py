"""Costs of this machine as they would be on another."""

import json
from dataclasses import replace
from pathlib import Path

import example_costs
import pytest
from example_costs import VECTOR

from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.speed import REFERENCE_PASSES_HZ, Speed
from edgevpr.runtime.preflight import scale
from edgevpr.runtime.preflight.scale import SAME_MACHINE, compare_speed, count_work, scale_to_board

REGIONS = replace(example_costs.REGIONS, candidates=40, scan_per_place=StageCost(1e-6, 1e-6))
PI = load_board("rpi-4b")
SLOWER = Speed(products=0.05, passes=0.2)


@pytest.fixture(autouse=True)
def reference(monkeypatch):
    """This machine is as fast as the reference."""
    monkeypatch.setattr(scale, "run_micro_benchmark", lambda: Speed(1.0, 1.0))


def test_on_board_scales_products_and_passes_apart_and_no_memory():
    scaled = scale_to_board(REGIONS, PI, SLOWER)
    assert scaled.encode == StageCost(pytest.approx(0.1 / 0.2), pytest.approx(0.1 / 0.2))
    assert scaled.match_per_place.cpu_s == pytest.approx(0.004 / 0.05), "region against region is a product"
    assert scaled.scan_per_place.wall_s == pytest.approx(1e-6 / 0.2)
    assert (scaled.ram_bytes_per_place, scaled.process_mb) == (1_000, 90.0)


def test_compare_speed_of_an_arm_board_follows_from_the_counted_instructions():
    assert compare_speed(PI).products == PI.benchmark_score.products
    passes_hz = 1e6 * PI.benchmark_score.arm64_mips / counted_parts()["micro-benchmark: a round of passes"]
    assert compare_speed(PI).passes == pytest.approx(passes_hz / REFERENCE_PASSES_HZ, rel=1e-6)
    for name in ("rpi-4b", "rpi-5"):  # whose products Linpack tells
        board = load_board(name)
        alone = replace(board, benchmark_score=replace(board.benchmark_score, products=None))
        assert compare_speed(alone).products == pytest.approx(board.benchmark_score.products, rel=0.3)


def test_compare_speed_measures_this_machine_for_other_boards(monkeypatch):
    ours = compare_speed(PI)
    monkeypatch.setattr(scale, "run_micro_benchmark", lambda: Speed(0.5, 0.25))
    assert compare_speed(PI) == Speed(pytest.approx(ours.products / 0.5), pytest.approx(ours.passes / 0.25))
    assert compare_speed(load_board("odroid-xu4")) == Speed(0.15 * 0.35 / 0.5, 0.35 / 0.25), "of 7-zip alone"
    monkeypatch.setattr(scale, "run_micro_benchmark", None)
    assert compare_speed(load_board("this")) == SAME_MACHINE
    assert compare_speed(load_board("thesis-xeon")) is None, "nobody has measured it"


def test_on_board_takes_counted_instructions_whatever_was_measured_here():
    work = count_work("cohog", {"camera": "nadir"})
    there = scale_to_board(REGIONS, PI, SLOWER, work)
    parts, rate_hz = counted_parts(), 1e6 * PI.benchmark_score.arm64_mips
    assert there.encode.wall_s == pytest.approx(parts["down: encode a frame"] / rate_hz, rel=1e-6)
    query_s = there.encode.wall_s + replace(there, candidates=30).match(10_000).wall_s
    landmarks = parts["flight: landmarks of a frame"] + 2 * parts["flight: the stride since the frame before"]
    assert query_s == pytest.approx((parts["down: a query"] + landmarks) / rate_hz, rel=1e-3)
    assert scale_to_board(REGIONS, PI, SAME_MACHINE, work) == REGIONS
    odroid = load_board("odroid-xu4")
    assert scale_to_board(REGIONS, odroid, SLOWER, work) == scale_to_board(REGIONS, odroid, SLOWER), (
        "which is no aarch64 board"
    )


def test_counted_work_is_known_only_of_what_was_counted():
    assert count_work("cohog", {}) == count_work("cohog", {"camera": "forward", "w1": 512, "gt": 0.4})
    assert count_work("cohog", {"w1": 256}) is None
    assert count_work("cohog", {"matching": "thesis"}) is None
    assert count_work("hog", {}) is None


def counted_parts():
    results = Path(__file__).parents[3] / "benchmarks" / "results" / "arm64.json"
    return {row["part"]: row["instructions"] for row in json.loads(results.read_text())["parts"]}


def test_on_board_takes_longer_with_fewer_cores():
    eight_threads = replace(REGIONS, encode=StageCost(0.1, 0.8))
    scaled = scale_to_board(eight_threads, replace(PI, cores=2), Speed(0.4, 0.4)).encode
    assert scaled == StageCost(pytest.approx(0.1 / 0.4 * 4), pytest.approx(0.8 / 0.4))
    network = replace(VECTOR, encode=StageCost(0.1, 0.8), is_network=True)
    two = scale_to_board(network, replace(PI, cores=4, threads=2), Speed(0.4, 0.4)).encode
    assert two == StageCost(pytest.approx(0.8 / 0.4 / 2), pytest.approx(0.8 / 0.4)), "as many as the board gives it"
