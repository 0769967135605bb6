"""Live sources on real streams. What is asserted is what happens and in which order, never how fast."""

import queue
import socket
import threading
import time

import numpy as np
import pytest

from edgevpr.errors import SourceError
from edgevpr.frames import streams
from edgevpr.frames.live import Camera, LiveSource, wait_before_reopening_s
from edgevpr.frames.source import open_source

PATIENCE_S = 60.0


@pytest.fixture
def cameras():
    pytest.importorskip("imageio_ffmpeg", reason="the test cameras need ffmpeg (pip install imageio-ffmpeg)")
    import live_cameras

    return live_cameras


@pytest.fixture
def opened(monkeypatch):
    """open_source for live sources, with a short read time-out; closed at the end."""
    monkeypatch.setattr(streams, "READ_TIMEOUT_S", 0.7)
    sources = []

    def open_live(uri):
        sources.append(open_source(uri, live=True))
        return sources[-1]

    yield open_live
    for source in sources:
        source.close()


def wait_for(condition):
    """Turn until `condition()` is true and return what it gave."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not (result := condition()):
        assert time.monotonic() < give_up_s, "nothing happened"
        time.sleep(0.01)
    return result


def next_frame(source):
    return wait_for(lambda: source.read(0.05))


def number(frame):
    return int(frame.name.split()[1])


@pytest.mark.parametrize("kind", ["udp", "tcp", "http", "rtsp"])
def test_a_stream_that_is_lost_is_noticed_and_opened_again_when_it_is_back(kind, cameras, opened, tmp_path):
    camera = cameras.RtspOverRtp(tmp_path) if kind == "rtsp" else cameras.FfmpegCamera(kind)
    camera.switch_on()
    try:
        source = opened(camera.uri)
        frame = next_frame(source)
        assert frame.image.shape == (cameras.HEIGHT, cameras.WIDTH, 3)
        assert frame.image.std() > 20  # the test picture, not a grey area
        assert source.state == "streaming"
        assert not source.ended

        camera.switch_off()
        wait_for(lambda: source.read(0.02) is None and source.state.startswith("lost, reopening in "))
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


def test_rtp_described_by_an_sdp_file_is_shown(cameras, opened, tmp_path):
    camera = cameras.RtpCamera(tmp_path)
    camera.switch_on()
    try:
        assert next_frame(opened(camera.uri)).image.shape == (cameras.HEIGHT, cameras.WIDTH, 3)
    finally:
        camera.switch_off()


def test_a_stream_that_is_not_there_at_the_start_is_waited_for_in_silence(opened, capfd):
    with socket.socket() as closed:  # bound but not listening: every connection is refused
        closed.bind(("127.0.0.1", 0))
        source = opened(f"tcp://127.0.0.1:{closed.getsockname()[1]}")
        wait_for(lambda: source.state == "nothing there, reopening in 0.5 s")
        wait_for(lambda: source.state == "nothing there, reopening in 1 s")
        assert source.read(0.01) is None
        assert not source.ended
    assert capfd.readouterr().err == ""


def test_a_device_that_gives_no_pictures_is_tried_again_in_silence(opened, capfd):
    source = opened("/dev/null")
    wait_for(lambda: source.state.startswith("nothing there"))
    assert source.read(0.01) is None
    assert capfd.readouterr().err == ""


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

    def read(self):
        self.taken.release()
        picture = self.pictures.get()
        return picture is not None, picture

    def release(self):
        self.released.set()


def test_the_newest_frame_wins_and_the_others_are_counted():
    camera, clock = SteppedCamera(), iter(range(100)).__next__
    source = LiveSource(lambda: Camera(camera, clock), clock)
    for value in range(5):
        camera.pictures.put(np.full((20, 20, 3), 9 * value, np.uint8))
    for _ in range(6):  # the sixth call means that the fifth picture has been put away
        camera.taken.acquire()
    frame = source.read(0)
    assert frame.image[0, 0, 0] == 36
    assert frame.name == "frame 000004 t=10.000 s"
    assert frame.t_mono_s == 10
    assert source.dropped == 4
    assert source.read(0) is None
    camera.pictures.put(None)
    source.close()


def test_the_capture_is_released_by_the_thread_that_reads_it_and_opened_anew():
    cameras = [SteppedCamera(), SteppedCamera()]
    waiting = iter(cameras)
    source = LiveSource(lambda: Camera(next(waiting), time.monotonic), time.monotonic)
    cameras[0].pictures.put(np.zeros((20, 20, 3), np.uint8))
    cameras[0].pictures.put(None)
    assert cameras[0].released.wait(PATIENCE_S)
    wait_for(lambda: source.state == "lost, reopening in 0.5 s")
    cameras[1].taken.acquire()  # the second is being read
    source.read(0)
    cameras[1].pictures.put(np.ones((20, 20, 3), np.uint8))
    assert next_frame(source).name.startswith("frame 000001 ")
    cameras[1].pictures.put(None)
    source.close()
    assert cameras[1].released.is_set()


def test_the_wait_before_reopening_doubles_up_to_ten_seconds():
    waits_s = [wait_before_reopening_s(failures) for failures in (1, 2, 3, 4, 5, 6, 7, 5000)]
    assert waits_s == [0.5, 1, 2, 4, 8, 10, 10, 10]


@pytest.mark.parametrize(
    ("uri", "complaint"),
    [
        ("/dev/video97", "There is nothing at `/dev/video97`: connect the camera"),
        ("missing.sdp", "There is nothing at `missing.sdp`"),
        ("missing.mp4", "There is nothing at `missing.mp4`: give a folder of images, a video file, a camera"),
        ("0", "There is nothing at `0`"),
        ("rtmp://host/live", "rtmp:// is not understood: give a folder of images"),
        ("rtsp:///camera", "names no host"),
        ("udp://127.0.0.1", "names no port: write it like udp://HOST:PORT"),
        ("tcp://:5000", "names no host"),
        ("tcp://host:camera", "is not a proper address"),
        ("http://[::1", "is not a proper address"),
        ("rtsp://host:99999/x", "is not a proper address"),
    ],
)
def test_what_can_never_be_opened_is_refused_at_once(uri, complaint):
    with pytest.raises(SourceError) as refusal:
        open_source(uri, live=True)
    assert complaint in str(refusal.value)
    assert uri in str(refusal.value)


@pytest.mark.parametrize("uri", ["udp://:5600", "udp://@239.0.0.1:5600", "rtsp://user:secret@host/path", "/dev/null"])
def test_live_sources_are_refused_where_the_work_has_an_end(uri):
    with pytest.raises(SourceError, match="is live and never ends"):
        open_source(uri, live=False)
