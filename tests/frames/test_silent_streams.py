"""Streams of which no new picture comes, though they stay connected: sound goes on, the codec changes, one picture is
repeated. And slow cameras, which are none of these."""

import io
import time
from contextlib import suppress
from fractions import Fraction

import av
import numpy as np
import pytest
from answering_cameras import Server, multipart
from live_sources import wait_for

from edgevpr.frames.shot import Condition
from edgevpr.frames.source import open_source

pytestmark = [pytest.mark.network, pytest.mark.slow]

SIZE_PX = 160, 120


@pytest.fixture
def served():
    """Open a source of what `feed(number of the viewer)` answers to each viewer; returns it and the list of viewers."""
    to_close = []

    def serve(feed, address):
        viewers = []

        def answer(connection, asked):
            viewers.append(connection)
            with suppress(av.FFmpegError):  # the viewer has gone
                feed(len(viewers) - 1)(connection, asked)

        server = Server(answer)
        source = open_source(address.format(server.address), live=True)
        to_close.extend((source, server))
        return source, viewers

    yield serve
    for each in to_close:
        each.close()


def picture(number):
    return np.random.default_rng(number).integers(0, 255, (*SIZE_PX[::-1], 3), np.uint8)


class Out(io.RawIOBase):
    """What a muxer writes goes to the viewer at once."""

    def __init__(self, connection):
        self._connection = connection

    def writable(self):
        return True

    def write(self, data):
        self._connection.sendall(bytes(data))
        return len(data)


def transport_stream(connection, codec="mpeg2video", rate_hz=20, **options):
    """A muxer of MPEG-TS to a viewer, and its stream of pictures."""
    at_once = {"max_interleave_delta": "1", "flush_packets": "1"}
    box = av.open(Out(connection), "w", format="mpegts", container_options=at_once)
    stream = box.add_stream(codec, rate=Fraction(rate_hz), options=options)
    stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
    stream.codec_context.gop_size = 5
    return box, stream


def send(box, stream, number):
    frame = av.VideoFrame.from_ndarray(picture(number), "bgr24").reformat(format="yuv420p")
    frame.pts = number
    for packet in stream.encode(frame):
        box.mux(packet)


def pictures_then_sound(connection, _):
    box, stream = transport_stream(connection)
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


def one_codec(connection, _):
    box, stream = transport_stream(connection, "libx264", tune="zerolatency")
    for number in range(10**6):
        send(box, stream, number)
        time.sleep(0.05)


def two_codecs(connection, _):
    """The codec changes: from then on no packet is of the stream that the viewer has opened."""
    box, stream = transport_stream(connection)
    for number in range(60):
        send(box, stream, number)
        time.sleep(0.05)
    one_codec(connection, _)


@pytest.mark.parametrize("feed", [lambda _: pictures_then_sound, lambda viewer: one_codec if viewer else two_codecs])
def test_stream_whose_pictures_end_is_lost_and_opened_again(served, feed):
    source, viewers = served(feed, "tcp://{}")
    wait_for(lambda: source.read(0.1))
    wait_for(lambda: source.read(0.1) is None and source.condition in (Condition.LOST, Condition.DAMAGED))
    assert source.latency_s > 2.0, "the age of the newest picture grows"
    wait_for(lambda: len(viewers) >= 2 and source.read(0.1))
    assert source.condition is Condition.RUNNING


def test_picture_that_stays_for_every_viewer_is_never_a_frame_again(served):
    def feed(viewer):
        return multipart(numbers=(5 if viewer else min(number, 5) for number in range(10**6)), every_s=0.05)

    source, viewers = served(feed, "http://{}/")
    wait_for(lambda: source.read(0.1))
    wait_for(lambda: source.read(0.1) is None and source.condition is Condition.FROZEN)
    while len(viewers) < 2:
        assert source.read(0.1) is None
    frozen = source.refused["frozen"]
    while source.refused["frozen"] < frozen + 20:
        assert source.read(0.1) is None
    assert source.condition is Condition.FROZEN


def slow_stream(connection, _):
    box, stream = transport_stream(connection, rate_hz=1)
    for number in range(10**6):
        send(box, stream, number)
        time.sleep(1.0)


@pytest.mark.parametrize(
    ("feed", "address"),
    [(lambda _: multipart(every_s=4.0), "http://{}/"), (lambda _: slow_stream, "tcp://{}")],
)
def test_slow_camera_is_not_lost(served, feed, address):
    source, viewers = served(feed, address)
    for _ in range(3):
        wait_for(lambda: source.read(0.1))
        assert source.condition is Condition.RUNNING
    assert len(viewers) == 1
