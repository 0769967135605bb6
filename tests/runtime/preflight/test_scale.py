"""Costs of one machine as they would be on another."""

import json
from dataclasses import replace
from pathlib import Path

import example_costs
import pytest
from example_costs import VECTOR

from edgevpr.core.types import StageCost
from edgevpr.power.boards import MachineSpeed, load_board
from edgevpr.power.speed import REFERENCE_PASSES_HZ
from edgevpr.runtime.preflight import scale
from edgevpr.runtime.preflight.scale import Ratios, count_work, is_same, on_board, ratios, with_comparable_score

REGIONS = replace(example_costs.REGIONS, candidates=40, scan_per_place=StageCost(1e-6, 1e-6))
HERE, PI = load_board("generic-x86"), load_board("rpi-4b")


def scored(single=None, multi=None, products=None, passes=None, **changes):
    return replace(
        PI,
        benchmark_score=MachineSpeed(
            single=single, multi=multi, products=products, passes=passes, verified=True, source="by hand"
        ),
        **changes,
    )


def test_on_board_scales_products_and_passes_apart_and_no_memory():
    there = scored(single=0.4, products=0.05, passes=0.2)
    scaled = on_board(REGIONS, HERE, there)
    assert scaled.encode == StageCost(pytest.approx(0.1 / 0.2), pytest.approx(0.1 / 0.2))
    assert scaled.match_per_place.cpu_s == pytest.approx(0.004 / 0.05), "region against region is a product"
    assert scaled.scan_per_place.wall_s == pytest.approx(1e-6 / 0.2)
    assert (scaled.ram_bytes_per_place, scaled.process_mb) == (1_000, 90.0)


def test_on_board_takes_networks_as_products_and_scans_of_vectors_as_passes():
    there = scored(single=0.4, products=0.05, passes=0.2)
    assert on_board(replace(VECTOR, is_network=True), HERE, there).encode.wall_s == pytest.approx(0.05 / 0.05)
    assert on_board(VECTOR, HERE, there).encode.wall_s == pytest.approx(0.05 / 0.2)
    assert on_board(VECTOR, HERE, there).match_per_place.wall_s == pytest.approx(0.001 / 0.2)


def test_ratios_of_an_arm_board_follow_from_the_counted_instructions():
    assert ratios(HERE, PI).products == PI.benchmark_score.products
    passes_hz = 1e6 * PI.benchmark_score.arm64_mips / counted_parts()["micro-benchmark: a round of passes"]
    assert ratios(HERE, PI).passes == pytest.approx(passes_hz / REFERENCE_PASSES_HZ, rel=1e-6)
    for name in ("rpi-4b", "rpi-5"):  # whose products Linpack tells
        score = load_board(name).benchmark_score
        alone = replace(PI, benchmark_score=replace(score, products=None))
        assert ratios(HERE, alone).products == pytest.approx(score.products, rel=0.3)


def test_on_board_takes_counted_instructions_whatever_was_measured_here():
    work = count_work("cohog", {"camera": "nadir"})
    there = on_board(REGIONS, HERE, PI, work)
    parts, rate_hz = counted_parts(), 1e6 * PI.benchmark_score.arm64_mips
    assert there.encode.wall_s == pytest.approx(parts["down: encode a frame"] / rate_hz, rel=1e-6)
    query_s = there.encode.wall_s + replace(there, candidates=30).match(10_000).wall_s
    landmarks = parts["flight: landmarks of a frame"] + 2 * parts["flight: the stride since the frame before"]
    assert query_s == pytest.approx((parts["down: a query"] + landmarks) / rate_hz, rel=1e-3)
    assert on_board(REGIONS, HERE, HERE, work) == REGIONS
    assert on_board(REGIONS, HERE, scored(single=0.4), work) == on_board(REGIONS, HERE, scored(single=0.4))


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
    scaled = on_board(eight_threads, HERE, scored(single=0.4, cores=2)).encode
    assert scaled == StageCost(pytest.approx(0.1 / 0.4 * 4), pytest.approx(0.8 / 0.4))
    network = replace(VECTOR, encode=StageCost(0.1, 0.8), is_network=True)
    two = on_board(network, HERE, scored(single=0.4, products=0.4, cores=4, threads=2)).encode
    assert two == StageCost(pytest.approx(0.8 / 0.4 / 2), pytest.approx(0.8 / 0.4)), "as many as the board gives it"


def test_on_board_slows_busy_cores_down_as_the_score_of_all_says():
    four_threads = replace(REGIONS, encode=StageCost(0.1, 0.4))
    alone = on_board(four_threads, HERE, scored(single=0.4, cores=4)).encode
    together = on_board(four_threads, HERE, scored(single=0.4, multi=0.8, cores=4)).encode
    assert alone.wall_s == pytest.approx(0.1 / 0.4)
    assert together.wall_s == pytest.approx(2 * alone.wall_s), "four cores do the work of two"
    assert together.cpu_s == pytest.approx(4 * together.wall_s), "and are busy all the time"
    one_thread = on_board(REGIONS, HERE, scored(single=0.4, multi=0.8, cores=4)).encode
    assert one_thread.wall_s == pytest.approx(0.1 / 0.4)


def test_on_board_leaves_times_unchanged_where_a_speed_is_unknown():
    there = load_board("thesis-xeon")
    assert ratios(HERE, there) is None
    assert ratios(there, HERE) is None
    assert on_board(REGIONS, HERE, there) == REGIONS


def test_is_same_for_a_profile_that_was_written_on_this_machine():
    here = replace(HERE, machine="a box (N100)")
    mine = scored(name="mine", machine="a box (N100)")
    assert is_same(here, mine)
    assert ratios(here, mine) == Ratios(1.0, 1.0)
    assert on_board(REGIONS, here, mine) == REGIONS
    assert not is_same(here, scored(name="mine", machine="a box (N5105)"))
    assert not is_same(replace(here, machine=None), scored(name="mine"))


def test_with_comparable_score_measures_unless_both_are_published(monkeypatch):
    score = MachineSpeed(single=0.2, multi=0.7, products=0.1, passes=0.4, verified=True, source="micro-benchmark")
    monkeypatch.setattr(scale, "micro_benchmark", lambda: score)
    other = load_board("rpi-5")
    assert with_comparable_score(HERE, PI).benchmark_score == score
    assert with_comparable_score(PI, other) == PI, "7-zip beside 7-zip"
    assert with_comparable_score(PI, replace(other, benchmark_score=score)).benchmark_score == score
    assert with_comparable_score(HERE, HERE) == HERE
