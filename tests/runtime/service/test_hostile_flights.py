"""A short form of `benchmarks/hostile_flights.py`: behind a damaged stream no fix is sent from an old picture."""

import pytest

pytest.importorskip("imageio_ffmpeg", reason="the cameras need ffmpeg (pip install imageio-ffmpeg)")

import hostile_flights
from hostile_flights import RATE_HZ, behind_s, place_of

from edgevpr.lab.simulate.autopilot import ReceivedFix

STREAM = "MJPEG over HTTP, truncated"


def fix_of(number, t_claimed_s):
    here = place_of(number)
    processing_s = 0.25
    return ReceivedFix(
        lat_deg=here.lat_deg,
        lon_deg=here.lon_deg,
        accuracy_m=20.0,
        t_sent_s=t_claimed_s + processing_s,
        processing_s=processing_s,
    )


def test_a_fix_tells_by_its_position_when_its_picture_was_sent():
    sent_s = {number: 100.0 + number / RATE_HZ for number in range(200)}
    fixes = [fix_of(40, 101.0), fix_of(40, 103.5), fix_of(120, 102.0)]
    assert behind_s(fixes, sent_s) == pytest.approx([0.0, 2.5, -1.0], abs=1e-3)


def test_a_flight_behind_a_damaged_stream_sends_no_fix_from_an_old_picture(monkeypatch):
    monkeypatch.setattr(hostile_flights, "_TECHNIQUE", (*hostile_flights._TECHNIQUE, "--no-calibrate"))  # half a minute
    damaged, total = hostile_flights.run(count=480, seed=3, only=STREAM.__eq__)
    assert (damaged.stream, damaged.sent) == (STREAM, 480)
    assert damaged.fixes > 0
    assert (damaged.old, damaged.ahead) == (0, 0)
    assert (total.fixes, total.old) == (damaged.fixes, 0)
