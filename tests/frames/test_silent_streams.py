"""Streams of which no new picture comes, though they stay connected: sound goes on, or the codec changes."""

import io
import time
from contextlib import closing, suppress
from fractions import Fraction

import av
import numpy as np
import pytest
from answering_cameras import Server
from loopback import wait_until

from edgevpr.frames.shot import Condition
from edgevpr.frames.source import open_source

pytestmark = [pytest.mark.network, pytest.mark.slow]

SIZE_PX = 160, 120


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


def transport_stream(connection, codec="mpeg2video", **options):
    """A muxer of MPEG-TS to a viewer, and its stream of pictures."""
    at_once = {"max_interleave_delta": "1", "flush_packets": "1"}
    box = av.open(Out(connection), "w", format="mpegts", container_options=at_once)
    stream = box.add_stream(codec, rate=Fraction(20), options=options)
    stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
    stream.codec_context.gop_size = 5
    return box, stream


def send(box, stream, number):
    frame = av.VideoFrame.from_ndarray(picture(number), "bgr24").reformat(format="yuv420p")
    frame.pts = number
    for packet in stream.encode(frame):
        box.mux(packet)


def pictures_then_sound(connection):
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


def one_codec(connection):
    box, stream = transport_stream(connection, "libx264", tune="zerolatency")
    for number in range(10**6):
        send(box, stream, number)
        time.sleep(0.05)


def two_codecs(connection):
    """The codec changes: from then on no packet is of the stream that the viewer has opened."""
    box, stream = transport_stream(connection)
    for number in range(60):
        send(box, stream, number)
        time.sleep(0.05)
    one_codec(connection)


@pytest.mark.parametrize(("first", "later"), [(pictures_then_sound, pictures_then_sound), (two_codecs, one_codec)])
def test_stream_whose_pictures_end_is_lost_and_opened_again(first, later):
    viewers = []

    def answer(connection, asked):
        viewers.append(connection)
        with suppress(av.FFmpegError):  # the viewer has gone
            (later if len(viewers) > 1 else first)(connection)

    with closing(Server(answer)) as server, closing(open_source(f"tcp://{server.address}", live=True)) as source:
        wait_until(lambda: source.read(0.1))
        wait_until(lambda: source.read(0.1) is None and source.condition in (Condition.LOST, Condition.DAMAGED))
        assert source.latency_s > 2.0, "the age of the newest picture grows"
        wait_until(lambda: len(viewers) >= 2 and source.read(0.1))
        assert source.condition is Condition.RUNNING
