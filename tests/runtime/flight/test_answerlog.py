"""The log has a line for every fix as its answer comes: a real link, and autopilots that answer late, refuse, or are
silent."""

from contextlib import closing

import pytest
from fakes import FakeClock, FakeLink, FakeSource
from flights import Flight, of_kind
from mavlink_peers import Peer, UdpPort, link_to, wait_until
from pictures import textured

from edgevpr.mavlink.vehicle import GPS_IN_USE
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight import systemd

ACCEPTED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED


class Answering:
    """An autopilot with a GPS fix on a real link. The n-th fix gets the n-th of the `results` 40 ms after it was sent,
    None: no answer."""

    def __init__(self, link, peer, clock, results):
        self._link, self._peer, self._clock, self._results = link, peer, clock, list(results)

    def _heard(self, name):
        return self._link.stats().received.get(name, 0)

    def say(self, message):
        before = self._heard(message.get_type())
        self._peer.send(message)
        wait_until(lambda: self._heard(message.get_type()) > before)

    def beat(self):
        # Of a firmware that is asked for no parameter before it gets fixes.
        self.say(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_GENERIC, 128, 0, 4, 3))
        self.say(mavlink.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9))

    def be_seen(self):
        """Say what it says while a picture is taken; the answer comes after the query."""
        self.beat()
        self._clock.at(0.04, self.answer)

    def answer(self):
        wait_until(lambda: self._link.stats().fixes_sent)
        result = self._results.pop(0)
        if result is not None:
            self.say(mavlink.MAVLink_command_ack_message(43003, result, target_system=1, target_component=197))
        self.beat()  # when this is heard, the answer has been taken in


def flown(recording, tmp_path, clock, results):
    with (
        closing(UdpPort()) as port,
        link_to(f"udpout:127.0.0.1:{port.number}", clock=clock) as link,
    ):
        peer = Peer(port)
        peer.expect("HEARTBEAT")
        autopilot = Answering(link, peer, clock, results)
        autopilot.beat()
        peer.synchronise(link)
        flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
        pictures = [textured(number, 240, 320) for number in range(len(results) + 1)]
        return flight.fly(FakeSource(pictures, clock, work=autopilot.be_seen))


@pytest.mark.slow
def test_every_answer_has_its_own_line_before_the_next_query(recording, tmp_path, monkeypatch):
    monkeypatch.setattr("edgevpr.runtime.flight.autopilot._SETTLED_WITHIN_S", 60.0)
    clock, statuses = FakeClock(), []
    monkeypatch.setattr(systemd, "notify", lambda STATUS="", **_: statuses.append(STATUS) if STATUS else None)
    lines = flown(recording, tmp_path, clock, [ACCEPTED, FAILED, FAILED])
    kinds = [line["kind"] for line in lines if line["kind"] in ("query", "answer")]
    assert kinds[:7] == ["query", "answer"] * 3 + ["query"]
    answers = of_kind(lines, "answer")[:3]
    assert [line["query"] for line in answers] == [line["query"] for line in of_kind(lines, "query")[:3]]
    assert [line["result"] for line in answers] == ["ACCEPTED", "FAILED", "FAILED"]
    assert [line["why"] for line in answers] == [None, GPS_IN_USE.sentence, GPS_IN_USE.sentence]
    for line in answers:
        assert line["sent"] is True
        assert 0 <= line["latency_ms"] <= 200
        assert line["t_sent_s"] + line["latency_ms"] / 1e3 <= line["t_mono_s"] + 1e-3 < line["t_sent_s"] + 1
    assert "3 fixes sent, 1 taken, 2 refused (GPS in use)" in statuses[-1]


@pytest.mark.parametrize("settings", [{"mavlink.send_fixes": False}, {}])
def test_what_was_never_sent_waits_for_no_answer(recording, tmp_path, settings):
    clock = FakeClock()
    link = FakeLink(clock) if settings else None
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **settings)
    lines = flight.fly(FakeSource([textured(number, 240, 320) for number in range(3)], clock))
    assert len(of_kind(lines, "query")) == 3
    assert not of_kind(lines, "answer")
