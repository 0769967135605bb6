"""Requests to an autopilot over a real UDP link: answered, lost, refused, signed, and never answered."""

import pytest
from answering_autopilot import AnsweringAutopilot, healthy_messages
from loopback import free_port
from mavlink_peers import SerialCable

from edgevpr.core.errors import LinkError
from edgevpr.mavlink import requestlink as module
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.requestlink import RequestLink, read_autopilot
from edgevpr.mavlink.wire import mavlink

pytestmark = [pytest.mark.network, pytest.mark.slow]

READ_ONLY = {"HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ"}


@pytest.fixture
def address() -> LinkAddress:
    return LinkAddress("udpin", "127.0.0.1", free_port())


@pytest.fixture(autouse=True)
def _listen_briefly(monkeypatch):
    monkeypatch.setattr(module, "LISTEN_S", 0.2)


def read(address, names=(), **autopilot):
    with AnsweringAutopilot(address.number, **autopilot) as peer, RequestLink(address) as link:
        return read_autopilot(link, {"ardupilot": names, "px4": names}), peer


def test_request_link_reads_everything_the_autopilot_reports(address):
    parameters = {"GPS1_TYPE": 14, "FS_EKF_THRESH": 0.5, "NO_NUMBER": float("nan")}
    said, peer = read(address, [*parameters, "ABSENT"], messages=healthy_messages(), parameters=parameters, system_id=7)
    assert (said.system_id, said.firmware, said.vehicle) == (7, "ardupilot", "copter")
    assert (said.version, said.version_text) == ((4, 7, 0), "4.7.0")
    assert said.parameters == {"GPS1_TYPE": 14, "FS_EKF_THRESH": 0.5}
    assert (said.gps_fix, said.origin) == ((3, None), (50.0, 14.0))
    assert said.filter_flags & mavlink.EKF_POS_HORIZ_ABS
    assert abs(said.clock_ahead_s) < 60
    assert said.round_trip_s > 0
    assert (said.answers, said.signs, said.sends_mavlink1, said.other_systems) == (True, False, False, ())
    assert {"GLOBAL_POSITION_INT", "ATTITUDE", "GPS_RAW_INT"} <= set(said.received)
    assert peer.names() == READ_ONLY, "nothing is ever set"
    assert {message.command for message in peer.heard if message.get_type() == "COMMAND_LONG"} == {512}
    assert {message.get_srcComponent() for message in peer.heard} == {197}


def test_request_link_repeats_lost_requests(address):
    names = [f"P{number}" for number in range(12)]
    answers = {"messages": healthy_messages(), "parameters": dict.fromkeys(names, 3)}
    with AnsweringAutopilot(address.number, loses=1, **answers), RequestLink(address) as link:
        assert link.wait_for_heartbeat(60)
        assert link.request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        assert link.request_parameters(names, bytewise=False) == dict.fromkeys(names, 3)


def test_request_link_reads_a_denied_message_from_the_stream(address):
    """As a PX4 does with GPS_RAW_INT."""
    fix = mavlink.MAVLink_gps_raw_int_message(0, 3, 500_000_000, 140_000_000, 0, 80, 120, 0, 0, 14)
    streamed = fix.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    with AnsweringAutopilot(address.number, noise=streamed), RequestLink(address) as link:
        assert link.wait_for_heartbeat(60)
        assert link.request_message(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT).fix_type == 3
        assert link.request_message(mavlink.MAVLINK_MSG_ID_GPS2_RAW) is None


def test_request_link_leaves_out_a_parameter_without_an_answer(address, monkeypatch):
    monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", 0.3)
    said, peer = read(address, ["A", "B"], says_unknown=False, messages=healthy_messages(), parameters={"B": 2})
    assert said.parameters == {"B": 2}
    assert [m.param_id for m in peer.heard if m.get_type() == "PARAM_REQUEST_READ"] == ["A", "B", "A", "A"]


@pytest.mark.parametrize("key", [None, bytes(32)])
def test_request_link_distinguishes_a_mute_autopilot_from_a_signing_one(address, monkeypatch, key):
    monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", 0.1)
    said, _ = read(address, ["A"], is_mute=True, key=key)
    assert (said.answers, said.signs, said.version, said.parameters) == (False, bool(key), None, {})


def test_request_link_counts_mavlink_1_and_damaged_bytes(address):
    said, _ = read(address, messages=healthy_messages(), version_1=True, noise=bytes(50))
    assert said.sends_mavlink1
    assert said.bad_bytes >= 50


def test_request_link_lists_a_second_autopilot_but_ignores_it(address):
    with AnsweringAutopilot(address.number, system_id=3), AnsweringAutopilot(address.number, system_id=4) as other:
        with RequestLink(address, system_id=4) as link:
            assert link.wait_for_heartbeat(60).get_srcSystem() == 4
            link.listen(0.3)
        assert link.other_systems == {3}
        assert link.received.keys() == {"HEARTBEAT"}
    assert {message.get_srcSystem() for message in other.heard} <= {4}


def test_request_link_reports_a_pulled_cable_in_one_sentence(tmp_path):
    cable = SerialCable(tmp_path)
    cable.plug()
    link = RequestLink(LinkAddress("serial", str(tmp_path / "a"), 115_200))
    cable.unplug()
    with pytest.raises(LinkError, match="link lost"), link:
        link.listen(60)
