"""The simulated flight controller: strict, and honest about what it saw."""

import json
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from mavlink_peers import AutopilotThread, Peer, UdpPort, free_port, wait_until

from edgevpr.cli.simulation import _VEHICLES
from edgevpr.errors import LinkError, UsageError
from edgevpr.mavlink import messages
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Fix, Health
from edgevpr.mavlink.wire import mavlink
from edgevpr.simulate.autopilot import run_autopilot, serve
from edgevpr.simulate.flight import ORIGIN
from edgevpr.simulate.flightcontroller.controller import VEHICLES, FlightController
from edgevpr.simulate.flightcontroller.freeflight import FreeFlight
from edgevpr.simulate.flightcontroller.recorded import Track, read_track, truth_at


def a_fix(**changes):
    command = messages.position_fix(Fix(50.0, 14.0, 25.0, 0.0), 0.5, target_system=1)
    for field, value in changes.items():
        setattr(command, field, value)
    return command


def test_it_answers_counts_and_remembers():
    number = free_port()
    port = UdpPort(number)
    companion = Peer(port)
    autopilot = AutopilotThread(f"udpout:127.0.0.1:{number}")
    heartbeat = companion.expect("HEARTBEAT")

    def send(message):
        companion.send(message, component_id=197)

    send(messages.heartbeat(Health.ACTIVE))
    port.send(b"noise")
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (1, 1)
    assert heartbeat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    results = []
    for command in (a_fix(x=501234567), a_fix(z=3.0), a_fix(command=31_000)):
        send(command)
        results.append(companion.expect("COMMAND_ACK").result)
    assert results == [mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED]
    send(a_fix(target_system=2))  # for another vehicle: no answer
    companion.lose(3, component_id=197)
    send(a_fix(x=501234568))
    assert companion.expect("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED
    assert not companion.seen
    summary = autopilot.finish()
    port.close()
    assert summary.companion == "1/197"
    assert [(fix.lat_deg, fix.lon_deg, fix.accuracy_m) for fix in summary.fixes] == [
        (50.1234567, 14.0, 25.0),
        (50.1234568, 14.0, 25.0),
    ]
    assert (summary.fixes_accepted, summary.fixes_denied) == (2, 1)
    assert summary.messages["COMMAND_INT"] == summary.messages_by_sender["1/197"]["COMMAND_INT"] == 5
    assert (summary.lost_packets, summary.bad_bytes) == (3, 5)
    assert json.loads(summary.to_json())["fixes"][0]["lat_deg"] == 50.1234567
    assert "2 accepted, 0 failed, 1 denied" in str(summary)


def test_it_is_a_process_that_ends_well_on_sigterm_and_says_what_it_saw():
    number = free_port()
    code = f"from edgevpr.simulate.autopilot import run_autopilot as r; print(r('udpin:127.0.0.1:{number}').to_json())"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    with Link(parse_link(f"udpout:127.0.0.1:{number}")) as link:
        link.set_health(Health.ACTIVE)
        wait_until(lambda: link.stats().autopilot_heard, "the other process")
        link.send_fix(Fix(50.1234567, 14.0, 25.0, time.monotonic()))
        link.send(*messages.place_match(time.monotonic(), 3, 0.5))
        wait_until(lambda: link.stats().acks == {"ACCEPTED": 1})
        wait_until(lambda: link.stats().sent.get("NAMED_VALUE_FLOAT") == 1)
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    summary = json.loads(said)
    assert summary["fixes_accepted"] == 1
    assert {"HEARTBEAT", "COMMAND_INT", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"} <= set(summary["messages"])
    assert (summary["lost_packets"], summary["bad_bytes"]) == (0, 0)


def test_it_flies_along_a_track_from_when_a_companion_is_heard(tmp_path):
    csv = tmp_path / "positions.csv"
    rows = [
        "b.jpg,50.002,8.0,110,90,2026-02-14T00:30:00.4Z",
        "a.jpg,50.000,8.0,100,0,2026-02-14T00:30:00Z",
        "c.jpg,,,,,",
    ]
    csv.write_text("\n".join(["file,lat,lon,alt,yaw_deg,time", *rows]))
    number = free_port()
    with Link(parse_link(f"udpin:127.0.0.1:{number}")) as link:
        link.want_position()
        autopilot = AutopilotThread(f"udpout:127.0.0.1:{number}", track=read_track(csv))
        seen = []

        def at_the_end():
            position = link.vehicle()
            if position and (not seen or position.t_heard_s != seen[-1].t_heard_s):
                seen.append(position)
            return len(seen) > 3 and seen[-1].lat_deg == seen[-2].lat_deg

        wait_until(at_the_end, "the end of the track")
        autopilot.finish()
    north = [position.lat_deg for position in seen]
    assert north == sorted(north)
    assert len(set(north)) >= 2, "on the way, too"
    assert (seen[-1].lat_deg, seen[-1].lon_deg, seen[-1].alt_m, seen[-1].heading_deg) == (50.002, 8.0, 110.0, 90.0)
    assert seen[0].heading_deg in (0.0, 90.0)
    east_m_s, north_m_s = seen[-1].velocity_m_s
    assert (east_m_s, north_m_s) == (0.0, 0.0), "it stays where the track ends"


def test_it_says_how_fast_it_flies_along_the_track():
    track = Track(
        t_s=np.array([0.0, 10.0, 20.0, 21.0]),
        lat_deg=np.array([50.0, 50.001, 50.001, 51.0]),
        lon_deg=np.array([8.0, 8.0, 8.001, 8.0]),
        alt_m=np.zeros(4),
        heading_deg=np.full(4, np.nan),
    )
    velocities = [truth_at(track, t_s).velocity_m_s for t_s in (0.0, 5.0, 15.0, 20.5, 30.0)]
    expected = [11.12j, 11.12j, 7.15 + 0j, -71.47 + 327j, 0j]
    assert [each.real for each in velocities] == pytest.approx([each.real for each in expected], abs=0.01)
    assert [each.imag for each in velocities] == pytest.approx([each.imag for each in expected], abs=0.01), (
        "north first"
    )


def test_it_says_how_it_hangs_in_the_air_where_the_track_knows(tmp_path):
    csv = tmp_path / "positions.csv"
    csv.write_text(
        "file,lat,lon,alt,rel_alt,yaw_deg,roll_deg,pitch_deg,time\n"
        "a.jpg,50.000,8.0,100,80.5,300,-12,7,2026-02-14T00:30:00Z\n"
    )
    number = free_port()
    with Link(parse_link(f"udpin:127.0.0.1:{number}")) as link:
        link.want_position()
        autopilot = AutopilotThread(f"udpout:127.0.0.1:{number}", track=read_track(csv))

        def with_attitude():
            vehicle = link.vehicle_at(time.monotonic())
            return vehicle if vehicle and vehicle.roll_deg is not None else None

        seen = wait_until(with_attitude)
        autopilot.finish()
    assert (seen.roll_deg, seen.pitch_deg, seen.heading_deg) == pytest.approx((-12, 7, 300), abs=1e-3)
    assert seen.height_m == 80.5


def test_a_track_without_times_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text("file,lat,lon\na.jpg,50,8\n")
    with pytest.raises(UsageError, match="lat, lon and time"):
        read_track(tmp_path / "p.csv")


def test_it_ends_when_its_time_is_up():
    summary = run_autopilot(f"udpin:127.0.0.1:{free_port()}", duration_s=0.1)
    assert (summary.messages, summary.companion, summary.fixes) == ({}, None, ())
    assert "not heard" in str(summary)


@pytest.mark.parametrize("link", ["tcp:127.0.0.1:{}", "serial:/dev/no-such-device:{}"])
def test_a_link_that_cannot_be_opened_is_one_sentence(link):
    with pytest.raises(LinkError, match="cannot be opened"):
        run_autopilot(link.format(free_port(socket.SOCK_STREAM)))


def test_gps_is_switched_off_by_a_parameter_and_the_clock_may_run_fast():
    number = free_port()
    companion = Peer(UdpPort(number))
    controller = FlightController("arducopter", FreeFlight("copter", ORIGIN), gps=True)
    stop = threading.Event()
    served = threading.Thread(
        target=serve, args=(controller, f"udpout:127.0.0.1:{number}", None, stop), kwargs={"speedup": 100.0}
    )
    served.start()
    try:
        companion.expect_text("EKF3 IMU0 is using GPS")
        for number, *values in ((176, 1, 4), (400, 1), (22, 0, 0, 0, 0, 0, 0, 30)):  # GUIDED, arm, take off
            values += [0] * (7 - len(values))
            companion.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *values), component_id=197)
            assert companion.expect("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED
        companion.send(mavlink.MAVLink_param_set_message(1, 1, b"SIM_GPS1_ENABLE", 0, 9), component_id=197)
        assert companion.expect("PARAM_VALUE").param_value == 0
        companion.expect_text("EKF Failsafe: changed to LAND Mode")
        companion.expect_text("EKF3 IMU0 stopped aiding")
    finally:
        stop.set()
        served.join()
        companion.port.close()


def test_the_command_line_knows_every_vehicle():
    assert set(_VEHICLES) == set(VEHICLES)
