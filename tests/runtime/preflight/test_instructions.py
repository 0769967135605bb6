"""Costs of cohog on an ARM board, from counted instructions."""

import json
from dataclasses import replace
from pathlib import Path

import example_costs
import pytest

from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.instructions import compute_costs, count_work

REGIONS = replace(example_costs.REGIONS, candidates=40, scan_per_place=StageCost(1e-6, 1e-6))
PI = load_board("rpi-4b")


def test_compute_costs_scales_counted_instructions_but_not_memory():
    work = count_work("cohog", {"camera": "nadir"})
    there = compute_costs(REGIONS, PI, work)
    parts, rate_hz = read_instructions(), 1e6 * PI.benchmark_score.arm64_mips
    assert there.encode.wall_s == pytest.approx(parts["down: encode a frame"] / rate_hz, rel=1e-6)
    query_s = there.encode.wall_s + replace(there, candidates=30).match(10_000).wall_s
    landmarks = parts["flight: landmarks of a frame"] + 2 * parts["flight: the stride since the frame before"]
    assert query_s == pytest.approx((parts["down: a query"] + landmarks) / rate_hz, rel=1e-3)
    assert (there.ram_bytes_per_place, there.process_mb) == (1_000, 90.0)


def test_compute_costs_is_none_for_other_techniques_and_processors():
    assert compute_costs(REGIONS, PI, count_work("hog", {})) is None
    assert compute_costs(REGIONS, load_board("odroid-xu4"), count_work("cohog", {})) is None


def test_count_work_is_none_for_uncounted_settings():
    assert count_work("cohog", {}) == count_work("cohog", {"camera": "forward", "w1": 512, "gt": 0.4})
    assert count_work("cohog", {"w1": 256}) is None
    assert count_work("cohog", {"matching": "thesis"}) is None
    assert count_work("hog", {}) is None


def read_instructions():
    results = Path(__file__).parents[3] / "benchmarks" / "results" / "arm64.json"
    return {row["part"]: row["instructions"] for row in json.loads(results.read_text())["parts"]}
