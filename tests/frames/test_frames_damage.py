"""Streams that are cut, corrupted and lose packets: what is delivered is whole and no older than it says. The long form
is `python benchmarks/hostile.py --parts streams`."""

import pytest

pytest.importorskip("imageio_ffmpeg", reason="the cameras need ffmpeg (pip install imageio-ffmpeg)")

import bench_streams
import hostile_streams


def row(stream, count=160):
    (row,) = bench_streams.run(count, 1, only=stream.__eq__)
    return row


def test_the_time_can_be_read_from_every_band_of_a_picture():
    patched = hostile_streams.picture(700)
    patched[128:] = hostile_streams.picture(650)[128:]
    patched[8:16, :160] = 0
    assert hostile_streams.numbers_in(patched) == [None, *[700] * 7, *[650] * 7]


def test_a_whole_stream_loses_nothing():
    whole = row("MJPEG over HTTP, whole")
    assert (whole.old, whole.broken) == (0, 0)
    assert whole.delivered == whole.sent
    assert sum(whole.refused.values()) == 0


@pytest.mark.parametrize("damage", ["cut to 15 %", "truncated"])
def test_pictures_that_are_cut_are_refused_and_counted(damage):
    damaged = row(f"MJPEG over HTTP, {damage}")
    assert (damaged.old, damaged.broken) == (0, 0)
    assert damaged.refused["damaged"] > 20
    assert damaged.delivered + damaged.refused["damaged"] == 160


def test_pictures_whose_bytes_are_corrupted_are_never_old():
    corrupted = row("MJPEG over HTTP, bytes corrupted")
    assert corrupted.old == 0
    assert corrupted.refused["damaged"] > 0


@pytest.mark.parametrize(
    "stream",
    ["H.264 in MPEG-TS, 10% lost", "H.264 in RTP, 2% lost", "H.265 in RTP, 10% lost", "MPEG-2 in MPEG-TS, 10% lost"],
)
def test_of_a_stream_that_loses_packets_nothing_old_or_broken_is_delivered(stream):
    lossy = row(stream)
    assert (lossy.old, lossy.broken) == (0, 0)
    assert lossy.delivered < lossy.sent or lossy.delivered == 0
