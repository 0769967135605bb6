"""The stand-ins of `fakes.py` and the real things keep the same promises."""

import time
from types import SimpleNamespace

import cv2
import pytest
from fakes import FakeClock, FakeLink, FakeSource, make_vehicle
from loopback import free_port, wait_until
from mavlink_peers import AutopilotThread, Peer, UdpPort, make_link
from pictures import draw_texture
from simulated.motion import TrueState

from edgevpr.core.errors import ImageError
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.frames.devices import DeviceCapture
from edgevpr.frames.live import LiveSource
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import open_source
from edgevpr.mavlink.ground import UserCommand
from edgevpr.mavlink.messages import Fix, Severity
from edgevpr.mavlink.wire import mavlink

COUNT = 3


@pytest.fixture(params=["real", "fake"])
def recording(request, tmp_path):
    """Three pictures, of which the second cannot be used."""
    if request.param == "fake":
        pictures = [draw_texture(0), ImageError("1.png is truncated"), draw_texture(2)]
        return FakeSource(pictures, FakeClock(), is_live=False)
    for number in range(COUNT):
        cv2.imwrite(str(tmp_path / f"{number}.png"), draw_texture(number))
    (tmp_path / "1.png").write_bytes((tmp_path / "1.png").read_bytes()[:200])
    return open_source(str(tmp_path), live=True)


def test_source_of_a_recording_is_read_to_its_end(recording):
    assert (recording.is_live, recording.total, recording.dropped) == (False, COUNT, None)
    assert (recording.condition, recording.state, recording.ended) == (Condition.RUNNING, "reading", False)
    first = recording.read(0.0)
    assert (first.image == draw_texture(0)).all()
    with pytest.raises(ImageError, match="truncated"):
        recording.read(0.0)
    last = recording.read(0.0)
    assert (last.image == draw_texture(2)).all()
    assert last.t_mono_s >= first.t_mono_s
    assert last.name != first.name
    assert (recording.condition, recording.state, recording.ended) == (Condition.ENDED, "ended", True)
    assert recording.read(0.0) is None
    recording.close()


@pytest.fixture(params=["real", "fake"])
def camera(request):
    pictures = [cv2.cvtColor(draw_texture(number), cv2.COLOR_GRAY2BGR) for number in range(2)]
    if request.param == "fake":
        source = FakeSource(pictures, FakeClock())
        yield source, lambda: setattr(source, "is_lost", True)
        return
    device = SimpleNamespace(get=lambda prop: 0.0, release=lambda: None)  # OpenCV's, whose pictures come to an end
    device.read = lambda: (bool(pictures), pictures.pop(0) if pictures else None)
    source = LiveSource(lambda: DeviceCapture(device, time.monotonic), time.monotonic)
    yield source, lambda: None  # it is lost by itself, when its pictures are at an end
    source.close()


def test_source_of_a_camera_can_be_lost(camera):
    source, lose = camera
    assert (source.is_live, source.total, source.ended) == (True, 0, False)
    frame = wait_until(lambda: source.read(0.05))
    assert frame.image.shape == (120, 160, 3)
    assert (frame.position, frame.heading_deg) == (None, None)
    assert source.dropped >= 0
    lose()
    wait_until(lambda: source.condition is Condition.LOST)
    assert source.state.startswith("lost, reopening in ")
    source.close()
    wait_until(lambda: source.ended)
    assert source.read(0.0) is None


@pytest.fixture(params=["real", "fake"])
def link(request):
    """A link with an autopilot that takes fixes and says where it is; gives it with its clock."""
    clock = FakeClock()
    if request.param == "fake":
        yield FakeLink(clock, vehicle=lambda: make_vehicle(50.0, 8.0, clock.now_s, has_gps=False)), clock
        return
    number = free_port()
    autopilot = AutopilotThread(f"udpin:127.0.0.1:{number}", track=[TrueState(lat_deg=50.0, lon_deg=8.0, alt_m=300.0)])
    ahead_s = clock.now_s - time.monotonic()

    def is_ready():
        clock.now_s = time.monotonic() + ahead_s  # the link says nothing twice while its clock stands still
        return real.is_alive() and real.vehicle()

    try:
        with make_link(f"udpout:127.0.0.1:{number}", clock=clock) as real:
            real.request_position()
            wait_until(is_ready)
            yield real, clock
    finally:
        autopilot.finish()


def make_fix(clock, age_s=0.0):
    return Fix(50.0, 8.0, 20.0, clock.now_s - age_s)


def test_send_fix_is_answered_or_dropped_and_link_reports_the_vehicle(link):
    link, clock = link
    old = link.send_fix(make_fix(clock, age_s=6.2))
    old.wait(10.0)
    assert (old.sent, old.why.code) == (False, ReasonCode.FRAME_TOO_OLD)
    assert (link.stats().fixes_sent, link.stats().dropped_stale_fixes) == (0, 1)
    sending = link.send_fix(make_fix(clock))
    sending.wait(10.0)
    assert (sending.sent, sending.why) == (True, None)
    assert wait_until(lambda: sending.answer) == "ACCEPTED"
    assert link.stats().fixes_sent == 1
    assert wait_until(lambda: link.stats().acks) == {"ACCEPTED": 1}
    assert link.is_alive()
    vehicle = link.vehicle()
    assert (vehicle.lat_deg, vehicle.lon_deg, vehicle.alt_m) == (50.0, 8.0, 300.0)
    assert (vehicle.heading_deg, vehicle.has_gps) == (None, False)
    assert vehicle.is_fresh(clock.now_s)
    seen = link.predict_vehicle(clock.now_s)
    assert (seen.lat_deg, seen.lon_deg, seen.heading_deg, seen.roll_deg) == (50.0, 8.0, None, None)


@pytest.mark.parametrize("kind", ["real", "fake"])
def test_link_announces_texts_and_returns_commands(kind):
    clock, port = FakeClock(), UdpPort()
    link = FakeLink(clock)
    if kind == "real":
        link = make_link(f"udpout:127.0.0.1:{port.number}", clock=clock)
        link.start()
        peer = Peer(port)
        peer.expect("HEARTBEAT")

    def wish(wish):
        if kind == "fake":
            return link.send_command(wish)
        station = {"system_id": 255, "component_id": 190}
        peer.send(mavlink.MAVLink_command_long_message(1, 197, 31010, 0, wish, 0, 0, 0, 0, 0, 0), **station)
        return mavlink.enums["MAV_RESULT"][peer.expect("COMMAND_ACK").result].name.removeprefix("MAV_RESULT_")

    link.announce(Severity.WARNING, "camera lost", "camera")
    wait_until(lambda: link.stats().sent.get("STATUSTEXT") == 1)
    assert wish(UserCommand.PAUSE) == "TEMPORARILY_REJECTED"
    assert link.take_command() is None
    link.accept_commands()
    assert (wish(UserCommand.RESUME), wish(UserCommand.PAUSE)) == ("ACCEPTED", "ACCEPTED")
    assert link.take_command() == (UserCommand.PAUSE, "255/190")
    assert link.take_command() is None
    link.close()
    port.close()


@pytest.mark.parametrize("kind", ["real", "fake"])
def test_send_fix_waits_a_second_for_an_autopilot(kind):
    clock = FakeClock()
    port = UdpPort()
    link = FakeLink(clock, answer=None)
    if kind == "real":
        link = make_link(f"udpout:127.0.0.1:{port.number}", clock=clock)
        link.start()
    assert not link.is_alive()
    assert link.vehicle() is None
    sending = link.send_fix(make_fix(clock))
    assert sending.sent is None
    clock.now_s += 1.1
    wait_until(lambda: link.stats().dropped_stale_fixes == 1)
    assert (sending.sent, sending.why) == (False, Reason(ReasonCode.NO_AUTOPILOT, {"limit_s": 1.0}))
    link.close()
    port.close()
