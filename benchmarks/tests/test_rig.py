"""The rig: what needs no simulator."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.lab.simulate.generated import ORIGIN, to_metres, to_position

sys.path.append(str(Path(__file__).parents[1] / "rig"))
import figures
import truth


def degrees(east_m: float, north_m: float) -> tuple[float, float]:
    at = to_position(CameraPose(east_m=east_m, north_m=north_m, height_m=0.0, heading_deg=0.0))
    return at.lat_deg, at.lon_deg


def test_truth_interpolates_a_turn_between_two_states():
    """Banked by 30 degrees, the nose turns at g tan(30) / v: 14.7 degrees a second at 22 m/s."""
    roll, turn = np.radians(30.0), 9.81 * np.tan(np.radians(30.0)) / 22.0
    lat_deg, lon_deg = degrees(500.0, 300.0)
    state = SimpleNamespace(
        get_type=lambda: "SIM_STATE",
        lat_int=round(lat_deg * 1e7),
        lon_int=round(lon_deg * 1e7),
        alt=ORIGIN.alt_m + 100.0,
        roll=roll,
        pitch=0.0,
        yaw=np.radians(350.0),
        xgyro=0.0,
        ygyro=turn * np.sin(roll),
        zgyro=turn * np.cos(roll),
        ve=0.0,
        vn=22.0,
        vd=1.0,
    )
    told = truth.Truth()
    told.listen(state, 10.0)
    at = told.at(10.1)
    assert (at.east_m, at.north_m, at.height_m) == pytest.approx((500.0, 302.2, 99.9), abs=0.02)
    assert (at.roll_deg, at.pitch_deg, at.heading_deg) == pytest.approx((30.0, 0.0, 350.0 + np.degrees(turn) / 10))
    assert told.at(9.9) is None  # nothing is known of before
    assert told.at(10.5) is None  # nor of so long after


def test_figures_of_a_run(tmp_path):
    """GPS is lost at 100 s; the estimate drifts at 2 m/s for ten seconds, and the pictures were taken at the truth."""
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
    located = [(104, 503.0), (106, 501.0)]
    log = [
        {
            "kind": "query",
            "query": str(t),
            "t_frame_s": t,
            "t_mono_s": t + 0.2,
            "accepted": True,
            "accuracy_m": 2.0,
            "located": dict(zip(("lat_deg", "lon_deg"), degrees(east, 300.0), strict=True)),
        }
        for t, east in located
    ]
    log.append({"kind": "gps", "t_mono_s": 107.0, "is_wrong": True})
    log.append({"kind": "end", "mavlink": {"acks": {"ACCEPTED": 2}}})
    (tmp_path / "flight.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    texts = [[103.0, 1, "EKF Failsafe"], [104.0, 197, "edgevpr: map left"]]
    run = {"commit": "abc", "marks_s": {"loss": 100.0}, "texts": texts}
    (tmp_path / "run.json").write_text(json.dumps(run))

    found = figures.figures_of(tmp_path)

    assert found["estimate"]["after"]["median"] == pytest.approx(10.0, abs=0.2)
    assert found["estimate"]["at_s"] == {"10": 20.0}
    assert found["modes"] == [[0.0, 10]]
    assert found["alarms"] == [[3.0, "EKF Failsafe"]]
    assert found["fixes"]["error"] == {"n": 2, "median": 2.0, "p90": 2.8, "max": 3.0}
    assert found["fixes"]["by_roll_deg"]["20-90"]["max"] == 1.0
    assert found["fixes"]["within"] == [0.75, 1.0]
    assert found["sent"]["COMMAND_INT"]["error"]["max"] == 3.0
    assert found["wire_ms"] == [100.0, 100.0]
    assert found["gps_alarms_s"] == [7.0]
    assert found["answers"] == {"ACCEPTED": 2}


def test_worse_than_without_compares_the_worst_seconds():
    assert figures.worse_by(np.array([1.0, 5.0, 2.0]), np.array([2.0, 1.0, 9.0, 20.0])) == (4.0, 1)
    assert to_metres(*degrees(12.0, 34.0)) == pytest.approx((12.0, 34.0), abs=1e-6)
