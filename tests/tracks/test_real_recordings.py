"""Recordings of real aircraft, from public projects. They are fetched once, into EDGEVPR_RECORDINGS or the
cache of this user; without a network the tests are skipped."""

import os
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from edgevpr.tracks.record import read_record

pytestmark = [pytest.mark.network, pytest.mark.slow]

CACHE = Path(os.environ.get("EDGEVPR_RECORDINGS") or Path.home() / ".cache" / "edgevpr-recordings")
TIMEOUT_S = 5
DJI = "JuanIrache/DJI_SRT_Parser/b6ed7901b0f77dc8864eaeaf153914482bfba6da/samples"
PX4 = "PX4/pyulog/3cf17793f14709713ab297d3743314c658874068/test"
PYMAVLINK = "ArduPilot/pymavlink/b4c7ca298cfac46aa841994d5d3288143e2fa7e5/tests"
VIEWER = "ArduPilot/UAVLogViewer/c048ae207a105540d762a72ef8701565540d8d4a/src/assets"
GPXPY = "tkrajina/gpxpy/017d9961ee9aa86ccdbf5bb50a4e2341d5c42f4b/test_files"
AGUNG = "spwoodcock/drone-testdata-agung-2/40b1e3d2a1950b97260c129b120db63d3245e464"
# Project, commit and file; what it is, how many positions it has, and about where and for how many seconds.
RECORDINGS = {
    f"{DJI}/mavic_pro.SRT": ("subtitles", 468, (-20.25, 149.03), 467),
    f"{DJI}/matrice_300.srt": ("subtitles", 381, (36.61, -6.11), 380),
    f"{DJI}/MAVIC3.srt": ("subtitles", 1938, (3.41, -3.38), 246),
    f"{PX4}/sample_px4_events.ulg": ("PX4", 109, (47.4, 8.55), 21),
    f"{PYMAVLINK}/test.BIN": ("ArduPilot", 12, (-35.36, 149.17), 1),
    f"{VIEWER}/vtol.tlog": ("telemetry", 744, (-35.36, 149.16), 208),
    f"{GPXPY}/cerknicko-jezero.gpx": ("GPX", 296, (45.77, 14.36), 7190),
    f"{AGUNG}/image_metadata.csv": ("GPSLatitude", 1817, (-8.29, 115.46), None),
}


def fetched(name):
    path = CACHE / name
    if not path.is_file():
        try:
            with urllib.request.urlopen(f"https://raw.githubusercontent.com/{name}", timeout=TIMEOUT_S) as answer:
                content = answer.read()
        except (urllib.error.URLError, OSError) as error:
            pytest.skip(f"{name} cannot be fetched: {error}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return path


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_real_recording_is_read(name):
    kind, count, where, lasts_s = RECORDINGS[name]
    record = read_record(fetched(name))
    assert kind in record.kind
    tags = record.track.tags if record.track else list(record.named.values())
    assert len(tags) == count
    middle = tags[count // 2].position
    assert (middle.lat_deg, middle.lon_deg) == pytest.approx(where, abs=0.01)
    if lasts_s is not None:
        assert record.track.t_s[-1] - record.track.t_s[0] == pytest.approx(lasts_s, abs=1)
