"""What a technique costs here, and which one a board can afford."""

import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from example_costs import REGIONS, VECTOR, make_accuracy

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec, TechniqueSpec
from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.preflight import choose as choosing
from edgevpr.runtime.preflight.probe import measure_costs

COSTS = {"regions": REGIONS, "vector": VECTOR}


@pytest.fixture
def accuracies(monkeypatch):
    """Regions find more than vectors; a test may change it."""
    table = {"regions": make_accuracy(0.9), "vector": make_accuracy(0.5)}
    monkeypatch.setattr(choosing, "_read_accuracies", lambda: {"forward": table, "nadir": {}})
    return table


def make_plan(places, rate_hz=1.0):
    battery = {"flight_min": 20.0, "pack": parse_pack("4S5200"), "regulator_efficiency": 0.85}
    return choosing.FlightPlan(places=places, rate_hz=rate_hz, budget_mb=100, **battery)


def make_options(board, costs, places):
    plan = make_plan(places)
    return [choosing.make_option(board, name, name, cost, plan) for name, cost in costs.items()]


def fit(board, costs, places, rate_hz=1.0):
    return choosing.make_option(board, "regions", "regions", costs, make_plan(places, rate_hz))


def choose_label(board, costs, places):
    option = choosing.choose_best(make_options(board, costs, places))
    return option and option.label


def make_board(**changes):
    """A board of 4 cores, of which 2 may be used, with 100 MB for the map and 300 MB for the process."""
    whole = {"title": "Test board", "cores": 4, "cpu_share": 0.5, "budget_mb": 100.0, "memory_max_mb": 300.0}
    return dataclasses.replace(load_board("rpi-4b"), **{**whole, **changes})


class TinyTechnique:
    """Four numbers a place, and regions of 6x2 if `fine`; counts what it is asked."""

    candidates = 3
    min_score = 0.0
    min_margin = 0.0

    def __init__(self, fine):
        parts = (PartSpec((4,), "<f4"), PartSpec((6, 2), "<f4") if fine else None)
        self.spec = TechniqueSpec(name="tiny", parameters={"side": 2}, coarse=parts[0], fine=parts[1])
        self.shapes, self.matched = set(), 0

    def encode(self, image, mask=None):
        self.shapes.add((image.shape, image.dtype))
        return Descriptor(coarse=np.ones(4, np.float32), fine=np.ones((6, 2), np.float32) if self.spec.fine else None)

    def score_places(self, query, rows, mean):
        return rows @ query.coarse, None

    def match(self, query, fine, hypotheses=None):
        self.matched += 1
        return FineMatch(float((query.fine * fine).mean()))


def test_probe_tries_a_technique_on_frames_of_a_camera_and_a_map_on_disk():
    technique = TinyTechnique(fine=True)
    costs = measure_costs(technique)
    assert technique.shapes == {((480, 640), np.dtype(np.uint8))}
    assert technique.matched >= 6
    assert costs.ram_bytes_per_place == 4 * 4 + 26  # its row, and id, latitude, longitude and heading
    assert costs.disk_bytes_per_place == 4 * 4 + 6 * 2 * 4
    assert 10 < costs.process_mb < 2_000
    assert min(costs.encode.wall_s, costs.match_per_place.wall_s, costs.match_per_place.cpu_s) > 0


def test_probe_excludes_the_load_of_other_programs():
    technique, now = TinyTechnique(fine=True), {"wall": 0.0, "cpu": 0.0}
    others_s = itertools.cycle([0.9, 0.3, 0.0])

    def encode_slowly(image, mask=None):
        now["cpu"] += 0.1
        now["wall"] += 0.1 + next(others_s)
        return TinyTechnique.encode(technique, image, mask)

    technique.encode = encode_slowly
    clocks = {"wall_clock": lambda: now["wall"], "cpu_clock": lambda: now["cpu"]}
    costs = measure_costs(technique, repeat_s=0.2, meter=QueryMeter(make_board(), **clocks))
    assert costs.encode == StageCost(pytest.approx(0.1), pytest.approx(0.1))


def test_choose_best_returns_the_most_accurate_that_fits(accuracies):
    assert choose_label(make_board(), COSTS, places=100) == "regions"
    assert choose_label(make_board(), dict(reversed(COSTS.items())), places=100) == "regions", "whatever the order"
    assert choose_label(make_board(), COSTS, places=300) == "vector", "regions are too slow"
    of_ten = {**COSTS, "regions": dataclasses.replace(REGIONS, sequence=10)}
    assert choose_label(make_board(), of_ten, 100) == "vector", "a sequence is not chosen by itself"
    del accuracies["regions"]
    assert choose_label(make_board(), COSTS, 100) == "vector", "what was never measured"


def test_choose_best_never_returns_one_that_accepted_wrong_places(accuracies):
    accuracies["regions"] = make_accuracy(0.9, wrong=1)
    assert choose_label(make_board(), COSTS, 100) == "vector"
    accuracies["vector"] = make_accuracy(0.5, wrong=2)
    assert choose_label(make_board(), COSTS, 100) is None
    objections = [option.objection for option in make_options(make_board(), COSTS, 100)]
    assert [re.findall(r"\d", objection) for objection in objections] == [["1"], ["2"]]


def test_match_scans_a_large_map_whole_and_compares_a_part_of_it():
    scan = {"scan_per_place": StageCost(1e-6, 1e-6), "scan_once": StageCost(0.03, 0.03)}
    two_stages = dataclasses.replace(REGIONS, candidates=20, **scan)
    for places in (4, 20, 21, 10_000):
        assert two_stages.match(places).wall_s == pytest.approx(0.03 + 0.004 * min(places, 20) + 1e-6 * places)
    turned = dataclasses.replace(two_stages, tries_rotations=True)
    for places, compared in ((1999, 20), (2000, 32)):
        assert turned.match(places).wall_s == pytest.approx(0.03 + 0.004 * compared + 1e-6 * places)


def test_make_option_counts_the_whole_map_in_ram_and_its_candidates_in_time():
    two_stages = dataclasses.replace(REGIONS, candidates=20)
    fitting = fit(make_board(), two_stages, places=50_000)
    assert not fitting.misfit
    assert fitting.map_ram_mb == pytest.approx(50.0)
    assert fitting.reachable_hz == pytest.approx(1 / (0.1 + 20 * 0.004))
    assert not fit(make_board(), two_stages, 100_000).misfit
    assert "RAM" in fit(make_board(), two_stages, 100_100).misfit


def test_make_option_limits_the_rate_of_a_multicore_technique_by_the_cpu_share():
    four_threads = dataclasses.replace(REGIONS, encode=StageCost(0.1, 0.4), match_per_place=StageCost(0.001, 0.004))
    assert fit(make_board(cpu_share=1.0), four_threads, 100).reachable_hz == pytest.approx(1 / 0.2)
    assert fit(make_board(cpu_share=0.25), four_threads, 100).reachable_hz == pytest.approx(1 / 0.8)


def test_make_option_refuses_rates_at_which_fixes_would_be_too_late():
    slow = fit(make_board(), REGIONS, places=1300, rate_hz=0.1)
    assert slow.t_query_s == pytest.approx(5.3)
    assert "takes 5.3 s" in slow.misfit
    assert not fit(make_board(), REGIONS, places=1225, rate_hz=0.1).misfit


def test_find_accuracy_gives_the_figures_of_the_results():
    assert choosing.list_fewer_candidates("cohog", "nadir") == choosing.list_fewer_candidates("cohog", None) == (20, 10)
    for camera in ("forward", "nadir"):
        for name in ("cohog", "hog 1bit", "seqslam", "netvlad 8bit"):
            assert choosing.find_accuracy(name, camera).queries > 50
        assert not choosing.find_accuracy("cohog", camera).accepted_elsewhere
    results = Path(__file__).parents[3] / "benchmarks" / "results"
    recalls = []
    for name in ("grief_stromovka_seasons", "nordland_tiny"):
        table = json.loads((results / f"{name}.json").read_text())["rows"]
        rows = (dict(zip(table["columns"], row, strict=True)) for row in table["rows"])
        recalls.append(next(row["recall_at_1"] for row in rows if row["technique"] == "cohog"))
    assert choosing.find_accuracy("cohog", "forward").recall_at_1 == pytest.approx(sum(recalls) / 2, abs=1e-4)
