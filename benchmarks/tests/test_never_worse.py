"""Tests of the sweep of the rig that need no simulator."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "rig")]
import verdicts
from cells import CELLS, EVENTS, MATCHES, SET_UPS, Flight
from trial import Trial

CONTROL_ROW = {"cannot": None, "warnings": [], "strayed_m": 0.1, "sank_m": 0.2, "error_m": 0.5, "on_gps_s": 1.0}
FLIGHT_ROW = CONTROL_ROW | {"commit": "abc", "sent": 1200, "accepted": "0 of 60", "texts": ["map left"]}


def test_cells_are_many_and_make_scenarios():
    assert len(CELLS) >= 60
    assert 3 <= sum(cell.is_quick for cell in CELLS.values()) <= 6
    assert set(MATCHES) == {cell.flight.matches for cell in CELLS.values()}
    for cell in CELLS.values():
        event, set_up = EVENTS[cell.flight.event], SET_UPS[cell.flight.set_up]
        actions = {step.action for step in event.steps} | {action for action, _ in event.before}
        assert all(callable(getattr(Trial, action)) for action in actions)
        assert set_up.is_px4 or not actions & {"flag_gps", "use_gps"}
        assert "VISO_TYPE" in set_up.parameters or "choose_sources" not in actions
        assert cell.control != cell.flight
        assert EVENTS[cell.control.event].gps_back_s == event.gps_back_s
        cell.flight.make_scenario()
        cell.control.make_scenario()


def test_controls_are_shared():
    assert CELLS["gps_input-4_satellites-none"].control == CELLS["affinity-4_satellites-none"].control
    assert CELLS["gps_input-4_satellites-none"].control.name == "copter-4_satellites"
    assert CELLS["px4_sensor-home_set-right"].control.name == "px4_sensor-gps_off_late-right"


def test_combine_controls_returns_the_largest_figures():
    landed = CONTROL_ROW | {"strayed_m": 40.0, "on_gps_s": None}
    assert verdicts.combine_controls([CONTROL_ROW, landed]) == landed | {"flights": 2}
    assert verdicts.combine_controls([CONTROL_ROW | {"cannot": "never ready"}])["flights"] == 1


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({}, "right"),
        ({"strayed_m": 3.0, "on_gps_s": 5.9}, "right"),
        ({"strayed_m": 150.0, "error_m": 1200.0}, "strays 150 m; estimate 1200 m off"),
        ({"sank_m": 100.0}, "sinks 100 m"),
        ({"on_gps_s": 30.0}, "on GPS 29 s later"),
        ({"on_gps_s": None}, "not on GPS again"),
        ({"first_s": None}, "no position in time"),
        ({"sent_though_silent": 280}, "280 positions though paused"),
        ({"sent": 0, "warnings": ["GPS_PRIMARY=1: not sent"], "error_m": 9.0}, "refused"),
        ({"cannot": "never ready", "warnings": ["GPS_PRIMARY=1: not sent"], "sent": 0}, "refused"),
        ({"cannot": "never ready", "error_m": 40.0}, "never ready; estimate 40 m off"),
    ],
)
def test_judge_cells_compares_each_with_its_control(changed, verdict):
    name = "gps_input-gps_back-none"
    (row,) = verdicts.judge_cells({name: FLIGHT_ROW | changed, "copter-gps_back": CONTROL_ROW})
    assert row["verdict"] == verdict
    assert row["is_right"] == (verdict in ("right", "refused"))
    page = verdicts.format_page({"cells": [row], "commit": "abc", "date": "today", "machine": {"cpu": "one"}})
    assert f"| {verdict} |" in page
    assert f"* {name}: {FLIGHT_ROW['texts'][0]}" in page


def test_compute_flight_figures_measures_flight_until_gps_is_back(tmp_path):
    """A hover whose estimate and aircraft drift away together until GPS is back at 50 s."""
    columns = "t_s,east_m,north_m,est_east_m,est_north_m,error_m,mode,height_m"
    lines = []
    for after_s in np.arange(-5, 130, 0.1):
        drift_m = min(max(after_s, 0), 40) if after_s < 60 else 0.0
        lines.append(f"{1000 + after_s:.1f},{600 + drift_m},450,600,450,{drift_m:.2f},4,{100 - drift_m / 10:.2f}")
    (tmp_path / "track.csv").write_text("\n".join([columns, *lines]) + "\n")
    (tmp_path / "sent.csv").write_text(
        "t_s,kind,age_s,east_m,north_m,accuracy_m,true_east_m,true_north_m\n"
        + "".join(f"{t},GPS_INPUT,0,600,450,1,600,450\n" for t in range(990, 1200, 10))
    )
    (tmp_path / "flight.jsonl").write_text(
        "".join(f'{{"kind": "query", "accepted": {accepted}}}\n' for accepted in ("true", "false"))
    )
    texts = [[1003.0, 1, "EKF Failsafe"], [1004.0, 197, "edgevpr: map left"]]
    run = {"commit": "abc", "cannot": None, "warnings": [], "texts": texts, "marks_s": {"event": 1000.0}}
    (tmp_path / "run.json").write_text(json.dumps(run | {"path_m": [(600, 450), (600, 450)]}))

    figures = verdicts.compute_flight_figures(tmp_path, Flight("gps_input", "gps_back", "right"))

    assert (figures["strayed_m"], figures["error_m"], figures["sank_m"]) == pytest.approx((40, 40, 4), abs=0.1)
    assert figures["on_gps_s"] == pytest.approx(10.0, abs=0.11)
    assert (figures["sent"], figures["accepted"], figures["texts"]) == (13, "1 of 2", ["map left"])


def test_compute_distances_measures_distance_from_path():
    path_m = [(0, 0), (10, 0), (10, 10)]
    points_m = np.array([(5.0, 3.0), (12.0, 5.0), (-3.0, 4.0)])
    assert verdicts.compute_distances(points_m, path_m) == pytest.approx([3, 2, 5])
