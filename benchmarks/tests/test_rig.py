"""Tests of the rig that need no simulator."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edgevpr.lab.simulate.generated import ORIGIN, to_metres

sys.path.append(str(Path(__file__).parents[1] / "rig"))
import figures
import truth
from simulator import to_degrees


def test_compute_pose_extrapolates_a_turn_after_two_states():
    """Banked by 30 degrees, an aircraft turns at g tan(30) / v: 14.7 degrees per second at 22 m/s."""
    roll, turn_rate = np.radians(30.0), 9.81 * np.tan(np.radians(30.0)) / 22.0
    lat_deg, lon_deg = to_degrees(500.0, 300.0)
    state = SimpleNamespace(
        get_type=lambda: "SIM_STATE",
        lat_int=round(lat_deg * 1e7),
        lon_int=round(lon_deg * 1e7),
        alt=ORIGIN.alt_m + 100.0,
        roll=roll,
        pitch=0.0,
        yaw=np.radians(350.0),
        xgyro=0.0,
        ygyro=turn_rate * np.sin(roll),
        zgyro=turn_rate * np.cos(roll),
        ve=0.0,
        vn=22.0,
        vd=1.0,
    )
    states = truth.Truth()
    states.handle_message(state, 10.0)
    pose = states.compute_pose(10.1)
    assert (pose.east_m, pose.north_m, pose.height_m) == pytest.approx((500.0, 302.2, 99.9), abs=0.02)
    heading_deg = 350.0 + np.degrees(turn_rate) / 10
    assert (pose.roll_deg, pose.pitch_deg, pose.heading_deg) == pytest.approx((30.0, 0.0, heading_deg))
    assert states.compute_pose(9.9) is None  # before the first state
    assert states.compute_pose(10.5) is None  # too long after the last state


def test_compute_run_figures_measures_run_after_gps_loss(tmp_path):
    """GPS is lost at 100 s; the estimate drifts at 2 m/s for ten seconds, and the aircraft does not move."""
    columns = "t_s,east_m,north_m,est_east_m,est_north_m,error_m,mode"
    lines = [f"{t:.1f},500,300,500,300,{2 * max(t - 100, 0):.2f},10" for t in np.arange(95, 110.05, 0.1)]
    (tmp_path / "track.csv").write_text("\n".join([columns, *lines]) + "\n")
    poses = "t_s,east_m,north_m,height_m,heading_deg,roll_deg,pitch_deg"
    pictures = [f"{t},500,300,100,0,{30 if t > 104 else 0},0" for t in range(95, 110)]
    (tmp_path / "pictures.csv").write_text("\n".join([poses, *pictures]) + "\n")
    (tmp_path / "sent.csv").write_text(
        "t_s,kind,age_s,east_m,north_m,accuracy_m,true_east_m,true_north_m\n"
        "99,COMMAND_INT,0.1,999,300,1,500,300\n"
        "104.1,COMMAND_INT,0.1,503,300,2,500,300\n106.1,COMMAND_INT,0.1,501,300,2,500,300\n"
    )
    fixes = [(104, 503.0), (106, 501.0)]
    log = [
        {
            "kind": "query",
            "query": str(t),
            "t_frame_s": t,
            "t_mono_s": t + 0.2,
            "accepted": True,
            "accuracy_m": 2.0,
            "located": dict(zip(("lat_deg", "lon_deg"), to_degrees(east, 300.0), strict=True)),
        }
        for t, east in fixes
    ]
    log.append({"kind": "gps", "t_mono_s": 107.0, "is_wrong": True})
    log.append({"kind": "end", "mavlink": {"acks": {"ACCEPTED": 2}}})
    (tmp_path / "flight.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    texts = [[103.0, 1, "EKF Failsafe"], [104.0, 197, "edgevpr: map left"]]
    run = {"commit": "abc", "marks_s": {"loss": 100.0}, "texts": texts}
    (tmp_path / "run.json").write_text(json.dumps(run))

    result = figures.compute_run_figures(tmp_path)

    assert result["estimate"]["after"]["median"] == pytest.approx(10.0, abs=0.2)
    assert result["estimate"]["at_s"] == {"10": 20.0}
    assert result["modes"] == [[0.0, 10]]
    assert result["alarms"] == [[3.0, "EKF Failsafe"]]
    assert result["fixes"]["error"] == {"n": 2, "median": 2.0, "p90": 2.8, "max": 3.0}
    assert result["fixes"]["by_roll_deg"]["20-90"]["max"] == 1.0
    assert result["fixes"]["within"] == [0.75, 1.0]
    assert result["sent"]["COMMAND_INT"]["error"]["max"] == 3.0
    assert result["wire_ms"] == [100.0, 100.0]
    assert result["gps_alarms_s"] == [7.0]
    assert result["answers"] == {"ACCEPTED": 2}


def test_compare_estimates_finds_the_worst_second():
    assert figures.compare_estimates(np.array([1.0, 5.0, 2.0]), np.array([2.0, 1.0, 9.0, 20.0])) == (4.0, 1)
    assert to_metres(*to_degrees(12.0, 34.0)) == pytest.approx((12.0, 34.0), abs=1e-6)
