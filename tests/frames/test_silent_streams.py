"""Streams of which no new picture comes, though they stay connected: sound goes on, the codec changes, one picture is
repeated. And slow cameras, which are none of these."""

import io
import socket
import threading
import time
from contextlib import suppress
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from live_sources import wait_for

from edgevpr.frames.shot import Condition
from edgevpr.frames.source import open_source

pytestmark = [pytest.mark.network, pytest.mark.slow]

SIZE_PX = 160, 120
HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"


class Server:
    """Serves each viewer by `feed`, which is given its file and its number (0, 1, ...)."""

    def __init__(self, feed):
        self._feed, self.viewers = feed, 0
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        with suppress(OSError):
            while True:
                viewer, _ = self._server.accept()
                threading.Thread(target=self._run, args=(viewer, self.viewers), daemon=True).start()
                self.viewers += 1

    def _run(self, viewer, number):
        with viewer, suppress(OSError, av.FFmpegError), viewer.makefile("wb", 0) as file:
            self._feed(file, number)

    def close(self):
        self._server.close()


@pytest.fixture
def served():
    """Open a source of what `feed` serves; returns it and the server."""
    opened = []

    def serve(feed, address):
        server = Server(feed)
        source = open_source(address.format(server.port), live=True)
        opened.extend((source, server))
        return source, server

    yield serve
    for each in opened:
        each.close()


def picture(number):
    return np.random.default_rng(number).integers(0, 255, (*SIZE_PX[::-1], 3), np.uint8)


class Out(io.RawIOBase):
    """What a muxer writes goes to the viewer at once."""

    def __init__(self, file):
        self._file = file

    def writable(self):
        return True

    def write(self, data):
        self._file.write(bytes(data))
        return len(data)


def transport_stream(file, codec="mpeg2video", rate_hz=Fraction(20), options=()):
    """A muxer of MPEG-TS to a viewer, and its stream of pictures."""
    box = av.open(
        Out(file), "w", format="mpegts", container_options={"max_interleave_delta": "1", "flush_packets": "1"}
    )
    stream = box.add_stream(codec, rate=rate_hz, options=dict(options))
    stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
    stream.codec_context.gop_size = 5
    return box, stream


def send(box, stream, number):
    frame = av.VideoFrame.from_ndarray(picture(number), "bgr24").reformat(format="yuv420p")
    frame.pts = number
    for packet in stream.encode(frame):
        box.mux(packet)


def pictures_then_sound(file, _):
    box, stream = transport_stream(file)
    sound = box.add_stream("mp2", rate=16000)
    sound.layout = "mono"
    for number in range(10**6):
        if number < 60:
            send(box, stream, number)
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        samples.sample_rate, samples.pts = 16000, number * 800
        for packet in sound.encode(samples):
            box.mux(packet)
        time.sleep(0.05)


def two_codecs(file, viewer):
    """The first viewer sees the codec change: from then on no packet is of the stream that it has opened."""
    codecs = ("mpeg2video", "libx264") if viewer == 0 else ("libx264",)
    for codec in codecs:
        box, stream = transport_stream(
            file, codec, options={"tune": "zerolatency"}.items() if codec != "mpeg2video" else ()
        )
        for number in range(60 if codec == codecs[0] and viewer == 0 else 10**6):
            send(box, stream, number)
            time.sleep(0.05)


def mjpeg(file, numbers, every_s=0.05):
    """Pictures of these numbers, over HTTP."""
    file.write(HEAD)
    for number in numbers:
        jpeg = cv2.imencode(".jpg", picture(number))[1].tobytes()
        file.write(b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(jpeg), jpeg))
        time.sleep(every_s)


@pytest.mark.parametrize("feed", [pictures_then_sound, two_codecs])
def test_a_stream_whose_pictures_end_is_lost_and_opened_again(served, feed):
    source, server = served(feed, "tcp://127.0.0.1:{}")
    wait_for(lambda: source.read(0.1))
    wait_for(lambda: source.read(0.1) is None and source.condition in (Condition.LOST, Condition.DAMAGED))
    assert source.latency_s > 2.0, "the age of the newest picture grows"
    wait_for(lambda: server.viewers >= 2 and source.read(0.1))
    assert source.condition is Condition.RUNNING


def test_a_picture_that_is_repeated_until_the_viewer_comes_again_is_left(served):
    def feed(file, viewer):
        began = 1000 * viewer
        mjpeg(file, (began + min(number, 40) for number in range(10**6)))

    source, server = served(feed, "http://127.0.0.1:{}/")
    wait_for(lambda: source.read(0.1))
    wait_for(lambda: source.read(0.1) is None and source.condition is Condition.FROZEN)
    assert server.viewers == 1
    wait_for(lambda: server.viewers == 2 and source.read(0.1))


def test_a_picture_that_stays_for_every_viewer_is_never_a_frame_again(served):
    def feed(file, viewer):
        mjpeg(file, (5 if viewer else min(number, 5) for number in range(10**6)))

    source, server = served(feed, "http://127.0.0.1:{}/")
    wait_for(lambda: source.read(0.1))
    wait_for(lambda: source.read(0.1) is None and source.condition is Condition.FROZEN)
    while server.viewers < 2:
        assert source.read(0.1) is None
    frozen = source.refused["frozen"]
    while source.refused["frozen"] < frozen + 20:
        assert source.read(0.1) is None
    assert source.condition is Condition.FROZEN


@pytest.mark.parametrize("every_s", [2.0, 4.0])
def test_a_slow_camera_is_not_lost(served, every_s):
    source, server = served(lambda file, _: mjpeg(file, range(10**6), every_s), "http://127.0.0.1:{}/")
    for _ in range(3):
        wait_for(lambda: source.read(0.1))
        assert source.condition is Condition.RUNNING
    assert server.viewers == 1


def test_a_slow_stream_with_stamps_is_not_lost(served):
    def feed(file, _):
        box, stream = transport_stream(file, rate_hz=Fraction(1))
        for number in range(10**6):
            send(box, stream, number)
            time.sleep(1.0)

    source, server = served(feed, "tcp://127.0.0.1:{}")
    for _ in range(3):
        wait_for(lambda: source.read(0.1))
    assert (server.viewers, source.condition) == (1, Condition.RUNNING)
