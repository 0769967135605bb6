"""Live sources on real streams. What is asserted is what happens and in which order, never how fast."""

import itertools
import queue
import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fakes import FakeClock
from live_sources import PATIENCE_S, wait_for

from edgevpr.core.errors import SourceError
from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames import live as live_module
from edgevpr.frames import liveness
from edgevpr.frames import source as source_module
from edgevpr.frames.devices import DeviceCapture
from edgevpr.frames.live import LiveSource
from edgevpr.frames.shot import Condition, Refusal, Shot
from edgevpr.frames.source import open_source


@pytest.fixture
def cameras():
    pytest.importorskip("imageio_ffmpeg", reason="the test cameras need ffmpeg (pip install imageio-ffmpeg)")
    import live_cameras

    return live_cameras


def next_frame(source):
    return wait_for(lambda: source.read(0.05))


def number(frame):
    return int(frame.name.split()[1])


@pytest.mark.network
@pytest.mark.process
@pytest.mark.parametrize("kind", ["udp", "tcp", "http", "rtsp", "sdp"])
def test_a_stream_that_is_lost_is_noticed_and_opened_again_when_it_is_back(kind, cameras, opened, tmp_path):
    over_rtp = {"rtsp": cameras.RtspOverRtp, "sdp": cameras.RtpCamera}
    camera = over_rtp[kind](tmp_path) if kind in over_rtp else cameras.FfmpegCamera(kind)
    camera.switch_on()
    try:
        source = opened(camera.uri)
        frame = next_frame(source)
        assert frame.image.shape == (cameras.HEIGHT, cameras.WIDTH, 3)
        assert frame.image.std() > 20  # the test picture, not a grey area
        assert source.state == "streaming"
        assert not source.ended

        camera.switch_off()
        wait_for(lambda: source.read(0.02) is None and source.condition is Condition.LOST)
        assert ", reopening in " in source.state
        assert not source.ended

        camera.switch_on()
        wait_for(lambda: source.read(0.05) and source.state == "streaming")
        again = next_frame(source)
        assert number(again) > number(frame)
        assert again.t_mono_s > frame.t_mono_s
    finally:
        camera.switch_off()
        if kind == "rtsp":
            camera.scrap()


@pytest.mark.network
@pytest.mark.process
def test_a_slow_reader_gets_the_newest_frame_of_a_stream(cameras, opened):
    camera = cameras.FfmpegCamera("tcp")
    camera.switch_on()
    try:
        source = opened(camera.uri)
        first = next_frame(source)
        dropped = source.dropped
        wait_for(lambda: source.dropped >= dropped + 5)
        assert number(next_frame(source)) - number(first) >= 6
    finally:
        camera.switch_off()


@pytest.mark.network
@pytest.mark.process
@pytest.mark.slow
def test_a_camera_that_delivers_fewer_pictures_than_it_stamps_gives_no_old_ones(cameras, opened):
    """It stamps 60 pictures a second and delivers 15: by its stamps they would be 4 s old after 6 s."""
    camera = cameras.FfmpegCamera("tcp", rate=0.25)
    camera.switch_on()
    try:
        source = opened(camera.uri)
        begun_s = next_frame(source).t_mono_s

        def is_new():
            frame = source.read(0.05)
            return frame and frame.t_mono_s - begun_s > 6 and source.latency_s < 0.5 and frame.t_sd_s < 0.3

        assert wait_for(is_new)
    finally:
        camera.switch_off()


@pytest.mark.network
def test_a_stream_that_is_not_there_at_the_start_is_waited_for_in_silence(opened, capfd):
    with socket.socket() as closed:  # bound but not listening: every connection is refused
        closed.bind(("127.0.0.1", 0))
        source = opened(f"tcp://127.0.0.1:{closed.getsockname()[1]}")
        wait_for(lambda: source.state == "connection refused, reopening in 0.5 s")
        wait_for(lambda: source.state == "connection refused, reopening in 1 s")
        assert source.read(0.01) is None
        assert not source.ended
    assert capfd.readouterr().err == ""


@pytest.mark.network
def test_a_stream_that_hangs_does_not_hold_up_read_or_close(opened):
    with socket.create_server(("127.0.0.1", 0)) as server:
        source = opened(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        connection, _ = server.accept()  # and then says nothing
        assert source.read(0.05) is None
        source.close()
        assert source.ended
        hanging = [thread for thread in threading.enumerate() if thread.name == "capture"]
        assert hanging  # so close did not wait for it
        connection.close()
    for thread in hanging:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


class SteppedCamera:
    """Stands in for cv2.VideoCapture: gives a picture when the test says so; None is the loss of the camera."""

    def __init__(self):
        self.pictures = queue.Queue()
        self.taken = threading.Semaphore(0)
        self.released = threading.Event()

    def get(self, prop):
        return 0.0

    def read(self):
        self.taken.release()
        picture = self.pictures.get()
        return picture is not None, picture

    def release(self):
        self.released.set()


def test_the_newest_frame_wins_and_the_others_are_counted():
    camera, clock = SteppedCamera(), FakeClock()
    source = LiveSource(lambda: DeviceCapture(camera, clock), clock)
    for value in range(5):
        camera.pictures.put(np.full((20, 20, 3), 9 * value, np.uint8))
    for _ in range(6):  # the sixth call means that the fifth picture has been put away
        camera.taken.acquire()
    clock.now_s += 1.5
    frame = next_frame(source)
    assert frame.image[0, 0, 0] == 36
    assert frame.name == "frame 000004 t=0.000 s"
    assert frame.t_mono_s == 1000.0
    assert source.dropped == 4
    assert source.read(0) is None
    wait_for(lambda: source.latency_s == 1.5)  # it grows while no newer picture comes
    camera.pictures.put(None)
    source.close()


@pytest.mark.slow
def test_the_capture_is_released_by_the_thread_that_reads_it_and_opened_anew():
    cameras = [SteppedCamera(), SteppedCamera()]
    waiting = iter(cameras)
    source = LiveSource(lambda: DeviceCapture(next(waiting), time.monotonic), time.monotonic)
    cameras[0].pictures.put(np.zeros((20, 20, 3), np.uint8))
    cameras[0].pictures.put(None)
    assert cameras[0].released.wait(PATIENCE_S)
    wait_for(lambda: source.state == "lost, reopening in 0.5 s")
    cameras[1].taken.acquire()  # the second is being read
    next_frame(source)
    cameras[1].pictures.put(np.full((20, 20, 3), 90, np.uint8))
    assert next_frame(source).name.startswith("frame 000001 ")
    cameras[1].pictures.put(None)
    source.close()
    assert cameras[1].released.is_set()


def shot(number, t_mono_s=None):
    picture = np.random.default_rng(number).integers(0, 255, (48, 64), np.uint8)
    t_mono_s = time.monotonic() if t_mono_s is None else t_mono_s
    return Shot(t_mono_s=t_mono_s, look=picture, pixels=lambda: picture)


class Camera:
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
            return replace(given, pixels=lambda: self.step("pixels") or given.pixels())
        if given is None:
            self.is_cancelled.wait(PATIENCE_S)
        return given

    def cancel(self):
        self.is_cancelled.set()

    def release(self):
        self.step("release")
        self.is_released.set()


def paced(given, rate_hz=50):
    for each in given:
        time.sleep(1 / rate_hz)
        yield each


def live(*cameras):
    """A source that opens these one after the other, and then finds none."""
    waiting = iter(cameras)

    def opened():
        if camera := next(waiting, None):
            camera.step("open")
        return camera

    return LiveSource(opened, time.monotonic)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "condition", "text"),
    [
        ([], Condition.LOST, "lost: no new picture"),
        (itertools.repeat(Refusal.DAMAGED), Condition.DAMAGED, "damaged: no picture is whole"),
        ((shot(4) for _ in itertools.count()), Condition.FROZEN, "frozen: the same picture over and over"),
    ],
)
def test_a_source_without_a_new_picture_is_said_to_be_so_and_opened_anew(given, condition, text):
    first = Camera(paced(itertools.chain(map(shot, range(5)), given)))
    second = Camera(paced(map(shot, itertools.count(100))))
    source = live(first, second)
    wait_for(lambda: source.read(0.1) is None and source.condition is condition)
    assert source.state.startswith(text)
    assert not first.is_released.is_set() or condition is Condition.LOST
    wait_for(lambda: first.is_released.is_set() and source.condition is Condition.RUNNING)
    assert next_frame(source)
    assert source.state == "streaming"
    source.close()


@pytest.mark.slow
def test_a_picture_that_a_server_has_kept_is_not_new_after_a_loss():
    kept = [shot(1), shot(2), shot(3)]
    source = live(Camera(kept), Camera(itertools.chain(paced([kept[-1]] * 30), map(shot, range(50, 52)))))
    wait_for(lambda: source.refused["frozen"] >= 30)
    assert source.read(0.0) is None or source.refused["frozen"] == 30
    wait_for(lambda: source.read(0.1))
    source.close()


def test_a_picture_that_is_older_than_the_one_before_is_refused_and_the_age_of_the_newest_is_known():
    clock = FakeClock()
    camera = Camera([shot(1, 998.1), shot(2, 998.0)])
    source = LiveSource(lambda: camera, clock)
    assert next_frame(source).t_mono_s == 998.1
    wait_for(lambda: source.refused["late"] == 1)
    assert source.latency_s == pytest.approx(1.9)
    source.close()


@pytest.mark.slow
@pytest.mark.parametrize("step", ["open", "read", "pixels", "release"])
def test_a_call_that_hangs_is_given_up_and_holds_nobody(step, monkeypatch):
    monkeypatch.setattr(live_module, "_OPENING_S", 1.0)
    monkeypatch.setattr(liveness, "_UNKNOWN_RATE_S", 1.0)
    shots = map(shot, range(3)) if step == "release" else map(shot, itertools.count())
    hanging = Camera(itertools.chain(paced(shots), [None]), step)
    hanging.is_cancelled.set()  # it is lost, rather than silent
    source = live(hanging, Camera(paced(map(shot, itertools.count(1000)))))
    wait_for(lambda: source.read(0.1) is None and source.condition is Condition.LOST)
    wait_for(lambda: source.read(0.1))
    assert source.condition is Condition.RUNNING
    source.close()
    assert source.ended
    hanging.go.set()
    assert hanging.is_released.wait(PATIENCE_S)


def test_a_source_that_hangs_each_time_takes_no_more_than_three_threads(monkeypatch):
    monkeypatch.setattr(live_module, "_OPENING_S", 0.2)
    monkeypatch.setattr(live_module, "_FIRST_WAIT_S", 0.01)
    opened, go = [], threading.Event()
    source = LiveSource(lambda: opened.append(1) or (go.wait(PATIENCE_S) and None), time.monotonic)
    wait_for(lambda: source.state == "lost: the opening hangs; 3 calls into it hang")
    assert len(opened) == 3
    go.set()
    wait_for(lambda: len(opened) > 3)
    source.close()


def test_an_error_of_a_driver_is_a_loss_with_its_words():
    def broken():
        raise ValueError("no such codec")

    source = LiveSource(broken, time.monotonic)
    wait_for(lambda: source.state == "ValueError: no such codec, reopening in 0.5 s")
    source.close()


def test_a_picture_that_cannot_be_converted_is_left_out():
    broken = replace(shot(1), pixels=lambda: 1 / 0)
    camera = Camera(paced([broken, *map(shot, range(2, 20))], 20))
    source = live(camera)
    assert next_frame(source)
    source.close()


def test_a_picture_of_a_device_that_may_have_waited_is_known_less_well_in_time():
    """Ten pictures at their usual intervals, then one that was there already, after a second without a read."""
    camera = SteppedCamera()
    reads_s = [(0.1 * number, 0.1 * number + 0.1) for number in range(10)] + [(2.0, 2.0005)]
    times_s = iter([0.0, *(time_s for read_s in reads_s for time_s in read_s)])
    capture = DeviceCapture(camera, times_s.__next__)
    for number in range(len(reads_s)):
        camera.pictures.put(np.full((20, 20, 3), number, np.uint8))
    sds_s = [capture.read().t_sd_s for _ in reads_s]
    assert sds_s[9] == FRAME_TIME_SD_S
    assert sds_s[10] == pytest.approx(1 / np.sqrt(3), rel=0.01)


def test_the_wait_before_reopening_doubles_up_to_ten_seconds(monkeypatch):
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
    source._keep_open()
    assert waits_s == [0.5, 1, 2, 4, 8, 10, 10]


@pytest.mark.parametrize("name", ["video97", "camera.sdp"])
def test_a_device_that_comes_late_is_waited_for(name, tmp_path, monkeypatch):
    monkeypatch.setattr(source_module, "is_live", lambda uri: True)
    path = tmp_path / name
    source = open_source(str(path), live=True)
    wait_for(lambda: source.state.startswith(f"there is nothing at {path}, reopening in "))
    assert source.condition is Condition.LOST
    path.write_text("v=0")
    wait_for(lambda: not source.state.startswith(f"there is nothing at {path}"))
    source.close()


@pytest.mark.parametrize(
    ("uri", "complaint"),
    [
        ("missing.mp4", "There is nothing at `missing.mp4`: give a folder of images, a video file, a camera"),
        *(
            (uri, f"{uri} is no address of a stream")
            for uri in ("rtmp://host/live", "rtsp:///camera", "udp://127.0.0.1", "tcp://:5000", "tcp://host:camera")
        ),
    ],
)
def test_what_can_never_be_opened_is_refused_at_once(uri, complaint):
    with pytest.raises(SourceError) as refusal:
        open_source(uri, live=True)
    assert complaint in str(refusal.value)


@pytest.mark.parametrize("uri", ["udp://:5600", "udp://@239.0.0.1:5600", "rtsp://user:secret@host/path", "/dev/null"])
def test_live_sources_are_refused_where_the_work_has_an_end(uri):
    with pytest.raises(SourceError, match="live"):
        open_source(uri, live=False)
