"""Streams that are cut, corrupted and lose packets: what is delivered is whole and no older than it says. The long form
is `python benchmarks/hostile.py --parts streams`."""

from concurrent.futures import ThreadPoolExecutor

import damaged_streams
import pytest

from edgevpr.frames import streams

pytestmark = [pytest.mark.network, pytest.mark.slow]

PICTURES = 120
RATE_HZ = 80.0
WHOLE = ("MJPEG over HTTP, whole", "H.264 in MPEG-TS, 0% lost", "H.264 in RTSP, 0% lost")
CUT = ("MJPEG over HTTP, cut to 15 %", "MJPEG over HTTP, truncated")
CORRUPTED = "MJPEG over HTTP, bytes corrupted"
LOSSY = (
    "H.264 in MPEG-TS, 10% lost",
    "H.264 in RTP, 2% lost",
    "H.265 in RTP, 10% lost",
    "H.265 in RTSP, 10% lost",
    "MPEG-2 in MPEG-TS, 10% lost",
)


@pytest.fixture(scope="module")
def rows():
    """What was delivered of each stream, by its name; read side by side, as it takes seconds, mostly of waiting."""
    names = (*WHOLE, *CUT, CORRUPTED, *LOSSY)
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(3) as pool:
        patch.setattr(streams, "READ_TIMEOUT_S", 1.5)
        found = pool.map(lambda name: damaged_streams.run(PICTURES, 1, only=name.__eq__, rate_hz=RATE_HZ), names)
        return {row.stream: row for (row,) in found}


@pytest.mark.parametrize("stream", WHOLE)
def test_undamaged_stream_loses_no_image(stream, rows):
    whole = rows[stream]
    late = whole.refused["late"]  # those that waited for the opening, and what a busy machine is too slow for
    assert (whole.old, whole.broken) == (0, 0)
    assert whole.refused == {"damaged": 0, "patched": 0, "frozen": 0, "late": late}
    assert whole.delivered + late >= 0.95 * PICTURES  # some were sent before the viewer was there
    assert whole.delivered > PICTURES / 10


@pytest.mark.parametrize("stream", CUT)
def test_truncated_images_are_refused_and_counted(stream, rows):
    cut = rows[stream]
    assert (cut.old, cut.broken) == (0, 0)
    assert cut.refused["damaged"] > 12
    assert cut.delivered + sum(cut.refused.values()) == cut.sent


def test_pictures_whose_bytes_are_corrupted_are_never_old(rows):
    corrupted = rows[CORRUPTED]
    assert corrupted.old == 0
    assert corrupted.refused["damaged"] > 0


@pytest.mark.parametrize("stream", LOSSY)
def test_stream_with_packet_loss_gives_no_old_or_damaged_image(stream, rows):
    lossy = rows[stream]
    assert (lossy.old, lossy.broken) == (0, 0)
    assert lossy.delivered < lossy.sent
    assert sum(lossy.refused.values()) > PICTURES / 10


def test_stream_decoded_too_slowly_skips_images_but_gives_no_old_ones():
    """Each takes twice as long as the stream has for it: one would be 1.5 s behind after 3 s."""
    (slow,) = damaged_streams.run(80, 1, only="MJPEG over HTTP, whole, decoded too slowly".__eq__, rate_hz=RATE_HZ)
    assert (slow.old, slow.broken) == (0, 0)
    assert slow.refused["late"] > 80
    assert slow.delivered > 40
