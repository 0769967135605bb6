"""A mission rehearsed over a map: what its log lets expect, and one from the command to the page."""

import json

import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

from pathlib import Path

from rasters import HOME, textured_raster

from edgevpr.cli.main import main
from edgevpr.cli.wording import format_rehearsal
from edgevpr.core.geodesy import moved
from edgevpr.core.types import Place, Position
from edgevpr.frames.positions import GeoTag
from edgevpr.lab.simulate.mission import find_start
from edgevpr.lab.simulate.motion import TrueState
from edgevpr.lab.simulate.rehearsal_report import RehearsedFlight, judge_by_tags, report_on
from edgevpr.review.logged import read_lines

START_S = 1000.0


def east(metres):
    lat_deg, lon_deg = moved(HOME.lat_deg, HOME.lon_deg, metres, 0.0)
    return {"lat_deg": float(lat_deg), "lon_deg": float(lon_deg)}


def flown(seconds=100, refused=(), match_off_m=1.0, own_off_m=3.0, wrong_s=None):
    """A flight eastwards at 10 m/s: a query a second, whose fix is sent 0.2 s later."""
    lines = [{"kind": "start", "t_mono_s": START_S}]
    for second in range(seconds):
        off_m = 200 if second == wrong_s else match_off_m
        line = {"kind": "query", "query": f"{second}", "t_mono_s": START_S + second, "t_frame_s": START_S + second}
        line |= {"accepted": second not in refused, "located": east(10 * second + off_m)}
        line["vehicle"] = east(10 * second + own_off_m) | {"t_heard_s": START_S + second}
        line["fix"] = east(10 * second + 4) | {"sent": True}
        lines += [line, {"kind": "answer", "query": f"{second}", "t_sent_s": START_S + second + 0.2}]
    lines.append({"kind": "between", "t_sent_s": START_S + 50.5, **east(510)})
    flight = read_lines(lines, Path("f.jsonl"))
    truths = [east(10 * second) for second in range(seconds)]
    judge_by_tags(flight, {f"{second}": GeoTag(position=Position(**at)) for second, at in enumerate(truths)})
    track = [TrueState(**at, alt_m=0.0, t_s=second) for second, at in enumerate(truths)]
    return RehearsedFlight(flight, lines, track, START_S)


def places(to_m):
    spots = (Position(**east(metres)) for metres in range(0, to_m, 10))
    return [Place(place_id=number, source_image="", position=spot) for number, spot in enumerate(spots)]


def expected(to_m=1000, **change):
    return report_on(flown(**change), places(to_m), footprint_m=100.0, gps_until_s=20.0)


def test_report_on_a_flight_that_was_recognised_all_the_way():
    found = expected()
    assert found.is_to_work
    assert (found.queries, found.accepted, found.wrong, found.longest_gap_s) == (100, 100, 0, 0)
    assert (found.match_error.median_m, found.autopilot_error.most_m) == pytest.approx((1, 3), abs=0.02)
    assert (found.sent_error.median_m, found.sent_error.most_m) == pytest.approx((2, 5), abs=0.02), "0.2 s later"
    assert found.way_m == pytest.approx(990, abs=1)
    assert "is expected to work" in found.answer


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"wrong_s": 60}, "1 of the accepted matches wrong, by up to 200 m"),
        ({"own_off_m": 70.0}, "up to 70 m off"),
        ({"refused": range(100)}, "nothing is recognised for 99 s"),
        ({"refused": range(20, 52)}, "nothing is recognised for 33 s"),
        ({"refused": range(0, 99, 2), "seconds": 99}, "only 49 of 99 pictures"),
        ({"seconds": 15}, "no position without GPS"),
    ],
)
def test_report_on_a_flight_has_the_reasons_against_the_mission(change, said):
    found = expected(**change)
    assert not found.is_to_work
    assert said in found.answer


def test_report_on_a_flight_has_the_stretches_without_a_match():
    found = expected(to_m=700, refused={*range(30, 41), 50, *range(80, 100)})
    assert [(each.from_m, each.to_m, each.on_map) for each in found.unrecognised] == [
        (290, 410, True),
        (790, 990, False),
    ]
    assert found.longest_gap_s == 20
    said = "\n".join(format_rehearsal(found, "out"))
    assert "0.79 to 0.99 km of the way: 20 s around 50.00000, 11.91" in said
    assert said.count("beyond the map") == 1


def test_find_start_sees_pictures_that_come_late():
    assert find_start([0, 1, 2, 3], [10.2, 11.0, 12.6, 13.0]) == (10, True)
    assert find_start(list(range(20)), [10.0 + at + (at == 7) for at in range(20)]) == (10, False), "one is no matter"


def track_of(tmp_path, length_m):
    ends = [[each["lon_deg"], each["lat_deg"]] for each in (east(-length_m / 2), east(length_m / 2))]
    path = tmp_path / "track.geojson"
    path.write_text(json.dumps({"type": "LineString", "coordinates": ends}))
    return path


@pytest.fixture(scope="module")
def valley(tmp_path_factory):
    """Ground of 640 m, and a map of its middle."""
    folder = tmp_path_factory.mktemp("valley")
    ground = textured_raster(folder / "valley.tif", side_px=1280)
    cut = ("--orthophoto", str(ground), "--footprint-m", "100", "--spacing-m", "30")
    area = str(track_of(folder, 420))
    assert main(["map", "build", str(folder / "m.gpkg"), *cut, "--area", area, "--no-calibrate"]) == 0
    return folder


def rehearsed(valley, track, folder):
    over = ("--orthophoto", valley / "valley.tif", "--track", track, "--height-m", 77, "--every-m", 20)
    return main(list(map(str, ("simulate", "rehearsal", valley / "m.gpkg", folder, *over, "--json"))))


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.network
def test_simulate_rehearsal_flies_and_writes_its_page(tmp_path, valley, capsys, monkeypatch):
    monkeypatch.setattr("edgevpr.lab.simulate.mission._MIN_S", 25.0)
    capsys.readouterr()
    out = tmp_path / "out"
    code, said = rehearsed(valley, track_of(tmp_path, 280), out), capsys.readouterr()
    if code and "late" in said.err:
        pytest.skip("this computer is too busy for a flight in real time, and the command says so")
    assert code == 0
    found = json.loads(said.out)
    assert found["queries"] == 15
    assert found["wrong"] == 0
    assert found["accepted"] > 0.7 * found["queries"]
    assert found["match_error"]["median_m"] < 3
    assert found["autopilot_error"]["most_m"] > 1, "the wind moves it"
    page = (out / "report.html").read_text()
    assert f"is expected to {'work' if found['is_to_work'] else 'fail'}" in page
    assert "from the truth, median" in page


@pytest.mark.slow
def test_simulate_rehearsal_refuses_in_a_sentence_and_leaves_nothing(tmp_path, valley, capsys):
    out = tmp_path / "out"
    for length_m, said in ((300, "needs one of 40 s"), (900, "does not cover the track"), (100_000, "not taken")):
        capsys.readouterr()
        if length_m > 90_000:
            path = tmp_path / "track.geojson"
            path.write_text('{"type": "LineString", "coordinates": [[8, 40], [8.01, 40]]}')
        else:
            path = track_of(tmp_path, length_m)
        assert rehearsed(valley, path, out) == 2
        assert said in capsys.readouterr().err
        assert not out.exists()
    (tmp_path / "there").write_text("mine")
    assert rehearsed(valley, track_of(tmp_path, 420), tmp_path) == 2
    assert "name a new folder" in capsys.readouterr().err
    assert (tmp_path / "there").exists()
