"""Live sources on real streams. What is asserted is what happens and in which order, never how fast."""

import queue
import socket
import threading
import time

import numpy as np
import pytest
from fakes import FakeClock
from live_sources import PATIENCE_S, wait_for

from edgevpr.core.errors import SourceError
from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames.live import DeviceCapture, LiveSource
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
    camera, clock = SteppedCamera(), iter(range(100)).__next__
    source = LiveSource(lambda: DeviceCapture(camera, clock), clock)
    for value in range(5):
        camera.pictures.put(np.full((20, 20, 3), 9 * value, np.uint8))
    for _ in range(6):  # the sixth call means that the fifth picture has been put away
        camera.taken.acquire()
    frame = source.read(0)
    assert frame.image[0, 0, 0] == 36
    assert frame.name == "frame 000004 t=16.000 s"
    assert frame.t_mono_s == 16
    assert source.dropped == 4
    assert source.read(0) is None
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
    source.read(0)
    cameras[1].pictures.put(np.ones((20, 20, 3), np.uint8))
    assert next_frame(source).name.startswith("frame 000001 ")
    cameras[1].pictures.put(None)
    source.close()
    assert cameras[1].released.is_set()


class ScriptedCapture:
    """A capture that gives shots and refusals; `clock` steps before each, and when all are given it waits."""

    def __init__(self, given, clock, step_s):
        self._given, self._clock, self._step_s = iter(given), clock, step_s
        self.is_done, self.may_end = threading.Event(), threading.Event()

    def read(self):
        self._clock.now_s += self._step_s
        shot = next(self._given, None)
        if shot is None:
            self.is_done.set()
            self.may_end.wait(PATIENCE_S)
        return shot

    def release(self):
        pass


def shot(number, t_mono_s=0.0):
    picture = np.random.default_rng(number).integers(0, 255, (48, 64), np.uint8)
    return Shot(t_mono_s=t_mono_s, look=picture, pixels=lambda: picture)


def condition_after(given, step_s=0.1):
    """The source after it was given these, one every `step_s`, and was lost; what is read of it, and its condition."""
    clock = FakeClock()
    capture = ScriptedCapture(given, clock, step_s)
    source = LiveSource(lambda: capture, clock)
    assert capture.is_done.wait(PATIENCE_S)
    condition, state, frame = source.condition, source.state, source.read(0)
    capture.may_end.set()
    source.close()
    return source, condition, state, frame


@pytest.mark.parametrize(
    ("repeats", "step_s", "condition"),
    [
        (5, 0.1, Condition.RUNNING),
        (11, 0.1, Condition.FROZEN),
        (2, 0.9, Condition.RUNNING),
        (3, 0.9, Condition.FROZEN),
        (3, 0.2, Condition.RUNNING),
    ],
)
def test_a_picture_that_repeats_for_a_second_and_three_times_is_frozen(repeats, step_s, condition):
    source, found, state, frame = condition_after([shot(1), shot(2), *[shot(2)] * repeats], step_s)
    assert found is condition
    assert (
        state == {Condition.RUNNING: "streaming", Condition.FROZEN: "frozen: the same picture over and over"}[condition]
    )
    assert frame.name.startswith("frame 000001 "), "only the first of them is a frame"
    assert source.refused == {"damaged": 0, "patched": 0, "frozen": repeats, "late": 0}


def test_a_frozen_source_is_back_with_its_next_new_picture():
    _, condition, state, frame = condition_after([*[shot(1)] * 30, shot(2)])
    assert (condition, state) == (Condition.RUNNING, "streaming")
    assert frame.name.startswith("frame 000001 ")


def test_a_stream_of_which_nothing_is_whole_is_damaged_after_five_seconds():
    refusals = [Refusal.DAMAGED] * 51
    assert condition_after([shot(1), *refusals[:-2]])[1] is Condition.RUNNING
    source, condition, state, frame = condition_after(refusals)
    assert (condition, state, frame) == (Condition.DAMAGED, "damaged: no picture is whole", None)
    assert source.refused["damaged"] == 51


def test_a_picture_that_is_older_than_the_one_before_is_refused_and_the_age_of_the_newest_is_known():
    source, _, _, frame = condition_after([shot(1, 998.1), shot(2, 998.0)])
    assert frame.t_mono_s == 998.1
    assert source.refused["late"] == 1
    assert source.latency_s == pytest.approx(2.0)


def test_a_source_of_unknown_age_is_late_after_five_seconds_and_says_why():
    _, condition, state, frame = condition_after([shot(1), *[Refusal.LATE] * 51])
    assert condition is Condition.LATE
    assert state.startswith("late: the age of its pictures is unknown")
    assert frame.name.startswith("frame 000000 ")


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
    source = LiveSource(lambda: None, time.monotonic)
    source.close()
    monkeypatch.setattr(source._closing, "is_set", lambda: len(waits_s) == 7)
    monkeypatch.setattr(source._closing, "wait", waits_s.append)
    source._capture()
    assert waits_s == [0.5, 1, 2, 4, 8, 10, 10]


@pytest.mark.parametrize(
    ("uri", "complaint"),
    [
        ("/dev/video97", "There is nothing at `/dev/video97`: connect the camera"),
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
