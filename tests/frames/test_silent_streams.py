"""Streams of which no new picture comes, though they stay connected: sound goes on, or the codec changes."""

import time
from contextlib import closing, suppress

import av
import numpy as np
import pytest
from answering_cameras import Server
from encoders import Encoder
from loopback import wait_until
from numbered_pictures import HEIGHT, WIDTH, draw_picture

from edgevpr.frames.shot import Condition
from edgevpr.frames.source import open_source

pytestmark = [pytest.mark.network, pytest.mark.slow]

RATE_HZ = 20


def open_encoder(connection, codec="mpeg2video", **options):
    """An encoder of MPEG-TS for a viewer."""
    return Encoder(connection.sendall, "mpegts", codec, RATE_HZ, (WIDTH, HEIGHT), {"g": "5", **options})


def send_late_audio(connection):
    encoder = open_encoder(connection)
    sound = encoder.box.add_stream("mp2", rate=16000)
    sound.layout = "mono"
    for number in range(10**6):
        if number < 60:
            encoder.write(number, draw_picture(number))
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        samples.sample_rate, samples.pts = 16000, number * 800
        encoder.box.mux(sound.encode(samples))
        time.sleep(1 / RATE_HZ)


def send_one_codec(connection):
    encoder = open_encoder(connection, "libx264", tune="zerolatency")
    for number in range(10**6):
        encoder.write(number, draw_picture(number))
        time.sleep(1 / RATE_HZ)


def send_two_codecs(connection):
    """The codec changes: from then on no packet is of the stream that the viewer has opened."""
    encoder = open_encoder(connection)
    for number in range(60):
        encoder.write(number, draw_picture(number))
        time.sleep(1 / RATE_HZ)
    send_one_codec(connection)


@pytest.mark.parametrize(("first", "later"), [(send_late_audio, send_late_audio), (send_two_codecs, send_one_codec)])
def test_stream_without_further_images_is_lost_and_reopened(first, later):
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
