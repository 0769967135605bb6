"""Live sources, on real streams and on cameras that the test drives. What is asserted is what happens and in which
order, never how fast."""

import itertools
import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from answering_cameras import RtspCamera, Server, read_request
from encoders import Encoder, describe_rtp
from fakes import FakeClock
from loopback import PATIENCE_S, free_port, wait_until
from numbered_pictures import HEIGHT, WIDTH, draw_picture

from edgevpr.core.errors import SourceError
from edgevpr.frames import live as live_module
from edgevpr.frames import liveness
from edgevpr.frames import source as source_module
from edgevpr.frames.shot import Capture, Condition, OpeningError, Refusal, Shot


def read_next_frame(source):
    return wait_until(lambda: source.read(0.05))


def read_number(frame):
    return int(frame.name.split()[1])


CODEC = "mpeg2video"


@pytest.fixture
def film():
    """A function that sends moving ground by FFmpeg, until the test ends or what it returns is called."""
    stops = []

    def start(target, form, codec=CODEC):
        is_over = threading.Event()

        def send():
            encoder = Encoder(target, form, codec, 60, (WIDTH, HEIGHT), {"g": "5", "b": "2M"})
            for number in itertools.count():
                if is_over.wait(1 / 60):
                    break
                encoder.write(number, draw_picture(number))

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        stops.append(lambda: (is_over.set(), thread.join()))
        return stops[-1]

    yield start
    for stop in stops:
        stop()


def serve_viewers(film, port):
    """Serve MJPEG as FFmpeg does over HTTP; return what ends it."""
    stops = []

    def answer(connection, asked):
        read_request(asked)
        connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: application/octet-stream\r\n\r\n")
        ended = threading.Event()
        stops.extend((film(connection.sendall, "mpjpeg", "mjpeg"), ended.set))
        ended.wait(PATIENCE_S)

    server = Server(answer, port)
    return lambda: [stop() for stop in (server.close, *stops)]


def serve_rtsp(film, port):
    camera = RtspCamera(describe_rtp(CODEC, 0), port)
    stop = film(camera.send, "rtp")
    return lambda: (stop(), camera.close())


def make_camera(kind, film, tmp_path):
    """The address of a camera, and a function that switches it on and returns the one that switches it off."""
    port = free_port()
    if kind == "http":
        return f"http://127.0.0.1:{port}/", lambda: serve_viewers(film, port)
    if kind == "rtsp":
        return f"rtsp://127.0.0.1:{port}/camera", lambda: serve_rtsp(film, port)
    if kind == "sdp":
        (tmp_path / "camera.sdp").write_text(describe_rtp(CODEC, port))
        return str(tmp_path / "camera.sdp"), lambda: film(f"rtp://127.0.0.1:{port}", "rtp")
    return f"udp://127.0.0.1:{port}", lambda: film(f"udp://127.0.0.1:{port}?pkt_size=1316", "mpegts")


@pytest.mark.network
@pytest.mark.parametrize("kind", ["udp", "http", "rtsp", "sdp"])
def test_lost_stream_is_reported_and_reopened(kind, film, open_live_source, tmp_path):
    uri, switch_on = make_camera(kind, film, tmp_path)
    switch_off = switch_on()
    source = open_live_source(uri)
    frame = read_next_frame(source)
    assert frame.image.shape == (HEIGHT, WIDTH, 3)
    assert frame.image.std() > 20  # the test picture, not a grey area
    assert (source.state, source.ended) == ("streaming", False)
    switch_off()
    wait_until(lambda: source.read(0.02) is None and source.condition is Condition.LOST)
    assert ", reopening in " in source.state
    switch_off = switch_on()
    wait_until(lambda: source.read(0.05) and source.state == "streaming")
    again = read_next_frame(source)
    assert read_number(again) > read_number(frame)
    assert again.t_mono_s > frame.t_mono_s
    switch_off()


@pytest.mark.network
def test_missing_stream_at_the_start_is_awaited_silently(open_live_source, capfd):
    with socket.socket() as closed:  # bound but not listening: every connection is refused
        closed.bind(("127.0.0.1", 0))
        source = open_live_source(f"tcp://127.0.0.1:{closed.getsockname()[1]}")
        wait_until(lambda: source.state == "connection refused, reopening in 0.5 s")
        wait_until(lambda: source.state == "connection refused, reopening in 1 s")
        assert source.read(0.01) is None
        assert not source.ended
    assert capfd.readouterr().err == ""


def make_shot(number, t_mono_s=None):
    picture = np.random.default_rng(number).integers(0, 255, (48, 64), np.uint8)
    t_mono_s = time.monotonic() if t_mono_s is None else t_mono_s
    return Shot(t_mono_s=t_mono_s, thumbnail=picture, convert=lambda: picture)


class Camera(Capture):
    """A `Capture` that gives what `shots` yields, and then nothing. It hangs in the step `hangs` (pixels: for each
    picture), until `go` is set."""

    def __init__(self, shots=(), hangs=None):
        self._shots, self._hangs, self.go = iter(shots), hangs, threading.Event()
        self.is_cancelled, self.is_released = threading.Event(), threading.Event()

    def step(self, name):
        if name == self._hangs:
            self.go.wait(PATIENCE_S)

    def read(self):
        self.step("read")
        given = next(self._shots, None)
        if isinstance(given, Shot):
            return replace(given, convert=lambda: self.step("pixels") or given.convert())
        if given is None:
            self.is_cancelled.wait(PATIENCE_S)
        return given

    def cancel(self):
        self.is_cancelled.set()

    def release(self):
        self.step("release")
        self.is_released.set()


def yield_paced(given, rate_hz=50):
    for each in given:
        time.sleep(1 / rate_hz)
        yield each


@pytest.fixture
def live():
    """A function that makes a source which opens these cameras one after the other, and then finds none."""
    sources = []

    def make(*cameras, clock=time.monotonic):
        waiting = iter(cameras)

        def open_next():
            camera = next(waiting, None)
            if camera is None:
                raise OpeningError("nothing there")
            camera.step("open")
            return camera

        sources.append(live_module.LiveSource(open_next, clock))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def test_read_gives_the_newest_frame_and_counts_the_others(live):
    clock = FakeClock()
    source = live(Camera(make_shot(each, 1000.0) for each in range(5)), clock=clock)
    wait_until(lambda: source.dropped == 4)
    clock.now_s += 1.5
    frame = read_next_frame(source)
    assert (frame.image == make_shot(4).convert()).all()
    assert (frame.name, frame.t_mono_s) == ("frame 000004 t=0.000 s", 1000.0)
    assert source.read(0) is None
    wait_until(lambda: source.latency_s == 1.5)  # it grows while no newer picture comes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "condition", "text"),
    [
        ([], Condition.LOST, "lost: "),
        (itertools.repeat(Refusal.DAMAGED), Condition.DAMAGED, "damaged: "),
        ((make_shot(4) for _ in itertools.count()), Condition.FROZEN, "frozen: "),
    ],
)
def test_source_without_new_images_is_reported_and_reopened(given, condition, text, live):
    first = Camera(yield_paced(itertools.chain(map(make_shot, range(5)), given)))
    source = live(first, Camera(yield_paced(map(make_shot, itertools.count(100)))))
    wait_until(lambda: source.read(0.1) is None and source.condition is condition)
    assert source.state.startswith(text)
    assert not first.is_released.is_set() or condition is Condition.LOST
    wait_until(lambda: first.is_released.is_set() and source.condition is Condition.RUNNING)
    assert read_next_frame(source)
    assert source.state == "streaming"


@pytest.mark.slow
def test_image_cached_by_the_server_is_not_new_after_a_loss(live):
    kept = [make_shot(1), make_shot(2), make_shot(3)]
    source = live(Camera(kept), Camera(itertools.chain(yield_paced([kept[-1]] * 30), map(make_shot, range(50, 52)))))
    wait_until(lambda: source.refused["frozen"] >= 30)
    assert source.read(0.0) is None or source.refused["frozen"] == 30
    wait_until(lambda: source.read(0.1))


def test_image_older_than_the_previous_one_is_refused(live):
    source = live(Camera([make_shot(1, 998.1), make_shot(2, 998.0)]), clock=FakeClock())
    assert read_next_frame(source).t_mono_s == 998.1
    wait_until(lambda: source.refused["late"] == 1)
    assert source.latency_s == pytest.approx(1.9)


@pytest.mark.slow
@pytest.mark.parametrize("step", ["open", "read", "pixels", "release"])
def test_hanging_call_is_abandoned_without_blocking(step, monkeypatch, live):
    monkeypatch.setattr(live_module, "_OPENING_TIMEOUT_S", 1.0)
    monkeypatch.setattr(liveness, "_UNKNOWN_RATE_TIMEOUT_S", 1.0)
    shots = map(make_shot, range(3)) if step == "release" else map(make_shot, itertools.count())
    hanging = Camera(itertools.chain(yield_paced(shots), [None]), step)
    hanging.is_cancelled.set()  # it is lost, rather than silent
    source = live(hanging, Camera(yield_paced(map(make_shot, itertools.count(1000)))))
    wait_until(lambda: source.read(0.1) is None and source.condition is Condition.LOST)
    wait_until(lambda: source.read(0.1))
    assert source.condition is Condition.RUNNING
    source.close()
    assert source.ended
    hanging.go.set()
    assert hanging.is_released.wait(PATIENCE_S)


def test_source_that_always_hangs_uses_at_most_three_threads(monkeypatch):
    monkeypatch.setattr(live_module, "_OPENING_TIMEOUT_S", 0.2)
    monkeypatch.setattr(live_module, "_FIRST_WAIT_S", 0.01)
    opened, go = [], threading.Event()
    source = live_module.LiveSource(lambda: opened.append(1) or (go.wait(PATIENCE_S) and Camera()), time.monotonic)
    wait_until(lambda: source.state == "lost: the opening hangs; 3 calls to it hang")
    assert len(opened) == 3
    go.set()
    wait_until(lambda: len(opened) > 3)
    source.close()


def test_driver_error_counts_as_a_loss_with_its_message():
    source = live_module.LiveSource(lambda: [].index("no such codec"), time.monotonic)
    wait_until(lambda: source.state == "ValueError: 'no such codec' is not in list, reopening in 0.5 s")
    source.close()


def test_image_that_cannot_be_converted_is_skipped(live):
    broken = replace(make_shot(1), convert=lambda: 1 / 0)
    assert read_next_frame(live(Camera(yield_paced([broken, *map(make_shot, range(2, 20))], 20))))


def test_wait_before_reopening_doubles_up_to_ten_seconds(monkeypatch, live):
    waits_s = []

    class Closing(threading.Event):
        def wait(self, timeout_s):
            waits_s.append(timeout_s)
            return super().is_set()

        def is_set(self):
            return len(waits_s) >= 7

    source = live()
    source.close()
    monkeypatch.setattr(source, "_closing", Closing())
    source._supervise()
    assert waits_s == [0.5, 1, 2, 4, 8, 10, 10]


@pytest.mark.parametrize("name", ["video97", "camera.sdp"])
def test_missing_device_is_awaited(name, tmp_path, monkeypatch):
    monkeypatch.setattr(source_module, "is_live", lambda uri: True)
    path = tmp_path / name
    source = source_module.open_source(str(path), live=True)
    wait_until(lambda: source.state.startswith(f"{path} does not exist, reopening in "))
    assert source.condition is Condition.LOST
    path.write_text("v=0")
    wait_until(lambda: not source.state.startswith(f"{path} does not exist"))
    source.close()


LIVE = ("udp://:5600", "udp://@239.0.0.1:5600", "rtsp://user:secret@host/path", "/dev/null")


@pytest.mark.parametrize(
    ("uri", "live", "complaint"),
    [
        ("missing.mp4", True, "missing.mp4"),
        *((uri, True, f"{uri} is not") for uri in ("rtmp://h/live", "rtsp:///a", "udp://h", "tcp://h:a")),
        *((uri, False, "live") for uri in LIVE),  # where the work has an end
    ],
)
def test_open_source_refuses_sources_that_can_never_open(uri, live, complaint):
    with pytest.raises(SourceError) as refusal:
        source_module.open_source(uri, live=live)
    assert complaint in str(refusal.value)
