"""The simulated flight controller: strict, and honest about what it saw."""

import json
import subprocess
import sys
import time

import pytest
from loopback import free_port, wait_until
from mavlink_peers import AutopilotThread, Peer, UdpPort, make_link

from edgevpr.mavlink import messages
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.messages import Fix, Health
from edgevpr.mavlink.requestlink import RequestLink, read_autopilot
from edgevpr.mavlink.wire import mavlink
from simulated import autopilot
from simulated.motion import TrueState, read_track

pytestmark = pytest.mark.network


def make_fix(**changes):
    command = messages.make_position_fix(Fix(50.0, 14.0, 25.0, 0.0), 0.5, target_system=1)
    for field, value in changes.items():
        setattr(command, field, value)
    return command


def test_run_autopilot_answers_and_counts():
    number = free_port()
    port = UdpPort(number)
    companion = Peer(port)
    autopilot = AutopilotThread(f"udpout:127.0.0.1:{number}")
    heartbeat = companion.expect("HEARTBEAT")

    def send(message):
        companion.send(message, component_id=197)

    send(messages.make_heartbeat(Health.ACTIVE))
    port.send(b"noise")
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (1, 1)
    assert heartbeat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    results = []
    for command in (make_fix(x=501234567), make_fix(z=3.0), make_fix(command=31_000)):
        send(command)
        results.append(companion.expect("COMMAND_ACK").result)
    assert results == [mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED]
    send(make_fix(target_system=2))  # for another vehicle: no answer
    companion.lose(3, component_id=197)
    send(make_fix(x=501234568))
    assert companion.expect("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED
    assert not companion.seen
    summary = autopilot.finish()
    port.close()
    assert summary.companion == "1/197"
    assert (summary.fixes_accepted, summary.fixes_denied) == (2, 1)
    assert summary.messages["COMMAND_INT"] == 5
    assert (summary.lost_packets, summary.bad_bytes) == (3, 5)


@pytest.mark.slow
def test_track_starts_with_a_flight_and_not_with_questions(monkeypatch):
    monkeypatch.setattr("edgevpr.mavlink.requestlink.LISTEN_S", 0.2)
    track = [TrueState(lat_deg=50.0 + t_s, lon_deg=8.0, alt_m=0.0, t_s=t_s) for t_s in (0.0, 0.1)]
    link = f"127.0.0.1:{free_port()}"
    autopilot = AutopilotThread(f"udpin:{link}", track=track, vehicle="px4-copter", gps=True)
    try:
        with RequestLink(parse_link(f"udpout:{link}")) as asking:
            assert read_autopilot(asking, {"px4": ("EKF2_AGP0_CTRL",)}).parameters == {"EKF2_AGP0_CTRL": 1}
            there = asking.request_message(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)
        assert there.lat / 1e7 == 50.0
        with make_link(f"udpout:{link}") as flight:
            wait_until(lambda: flight.stats().autopilot_heard)
            flight.send(*messages.make_named_values(time.monotonic(), vpr_place=3, vpr_score=0.5))
            wait_until(lambda: (vehicle := flight.vehicle()) and vehicle.lat_deg == 50.1, "the end of the track")
    finally:
        autopilot.finish()


def test_read_track_uses_attitude_and_course_if_known(tmp_path):
    known, unknown = tmp_path / "known.csv", tmp_path / "unknown.csv"
    known.write_text("file,roll_deg,pitch_deg,yaw_deg,rel_alt,time,lat,lon,alt\n0.jpg,-12,7,300,80.5,0,50,8,100")
    unknown.write_text("file,time,lat,lon\n0.jpg,10,50.0,8.001\n1.jpg,0,50.0,8.0")
    (state,) = read_track(known)
    assert (state.roll_deg, state.pitch_deg, state.heading_deg, state.height_m) == (-12, 7, 300, 80.5)
    level = [(state.roll_deg, state.pitch_deg, round(state.heading_deg), state.t_s) for state in read_track(unknown)]
    assert level == [(0, 0, 90, 0), (0, 0, 90, 10)], "in the order of time, along its way"


@pytest.mark.process
def test_script_sets_parameters_and_prints_its_summary():
    number = free_port()
    flags = ["--vehicle", "arducopter", "--param", "GPS2_TYPE=14", "--link", f"udpin:127.0.0.1:{number}"]
    process = subprocess.Popen(
        [sys.executable, autopilot.__file__, *flags], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert "arducopter" in process.stderr.readline()
        with RequestLink(parse_link(f"udpout:127.0.0.1:{number}")) as asking:
            assert asking.wait_for_heartbeat().type == mavlink.MAV_TYPE_QUADROTOR
            assert asking.request_parameters(["GPS2_TYPE"], bytewise=False) == {"GPS2_TYPE": 14}
        process.terminate()
        printed, more = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert more == ""
    assert json.loads(printed)["companion"] is None, "who only asks is none"
