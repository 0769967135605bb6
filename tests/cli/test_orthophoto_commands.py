"""`edgevpr map build --orthophoto` and `edgevpr simulate flight --orthophoto`: a map and a flight without flying."""

import numpy as np
import pytest
from commands import expect_refusal, run, run_json

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

from rasters import HOME, write_mission, write_textured_raster

from edgevpr.core.geodesy import distance_m, offset_position
from edgevpr.frames.positions import read_positions
from edgevpr.mapmaking import calibrate
from edgevpr.places.mapfile import PlaceMap


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    return str(write_textured_raster(tmp_path_factory.mktemp("ground") / "valley.tif"))


@pytest.fixture
def track(tmp_path):
    """A path of 142 m, 12 m north of the middle."""
    ends = [(0, *offset_position(HOME.lat_deg, HOME.lon_deg, east_m, 12.0), 0) for east_m in (-71, 71)]
    return str(write_mission(tmp_path / "track.waypoints", ends))


@pytest.mark.slow
def test_map_build_of_an_orthophoto_finds_a_flight_over_it(tmp_path, ground, track, capsys):
    place_map, flight = tmp_path / "m.gpkg", tmp_path / "flight"
    cut = ("--orthophoto", ground, "--footprint-m", 100, "--spacing-m", 40)
    built = run_json(capsys, "map", "build", place_map, *cut, "--area", track, "--no-calibrate")
    assert built["technique"] == "cohog"
    assert 8 <= built["places"] == built["added"]
    assert (built["without_position"], built["without_data"], built["low_texture"]) == (0, 0, 0)
    with PlaceMap.open(place_map) as opened:
        assert opened.spec.parameters["camera"] == "nadir"
        places = list(opened.read_places())
    assert all(place.heading_deg == 0 and place.source_image.startswith("valley.tif_r0") for place in places)

    over = ("--orthophoto", ground, "--track", track, "--height-m", 77, "--every-m", 40)
    assert run("simulate", "flight", flight, *over) == 0
    assert "4 images" in capsys.readouterr().out
    found = run_json(capsys, "match", place_map, "--images", flight / "images")
    taken = read_positions(flight / "positions.csv")
    off_m = []
    for query in found:
        at, named, fix = taken[query["query"]].position, query["place"], query["position"]
        off_m.append(distance_m(at.lat_deg, at.lon_deg, named["lat_deg"], named["lon_deg"]))
        if fix:
            away_m = distance_m(at.lat_deg, at.lon_deg, fix["lat_deg"], fix["lon_deg"])
            assert away_m == pytest.approx(query["from_gps_tag_m"], abs=0.01)
            assert away_m == pytest.approx(np.hypot(*query["gps_tag_offset_m"]), abs=0.01)
            assert away_m < 3, "places are 40 m apart: it is the fix, and not the place"
            assert not fix["of_place"]
    assert sum(query["accepted"] for query in found) >= 3
    assert np.median(off_m) < 25
    assert max(off_m) < 50


@pytest.mark.parametrize(
    ("flags", "code", "said"),
    [
        ([], 2, "Pass either --images"),
        (["--images", "x", "--footprint-m", "80"], 2, "--footprint-m applies"),
        (["--orthophoto", "GROUND"], 2, "needs --footprint-m"),
        (
            ["--orthophoto", "GROUND", "--footprint-m", "80", "--spacing-m", "20", "--camera", "forward"],
            2,
            "pass --camera nadir",
        ),
        (["--orthophoto", "nothing.tif", "--footprint-m", "80", "--spacing-m", "20"], 1, "nothing.tif"),
    ],
)
def test_map_build_refuses_a_wrong_request(tmp_path, ground, capsys, flags, code, said):
    flags = [ground if flag == "GROUND" else flag for flag in flags]
    assert said in expect_refusal(capsys, "map", "build", tmp_path / "m.gpkg", *flags, code=code, is_alone=True)
    assert not (tmp_path / "m.gpkg").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--track", "t"], "--track applies"),
        (["--orthophoto", "GROUND"], "needs --track"),
        (["--orthophoto", "GROUND", "--track", "TRACK"], "pass --height-m"),
        (["--orthophoto", "GROUND", "--track", "TRACK", "--height-m", "0"], "--height-m is 0"),
        (["--orthophoto", "GROUND", "--track", "TRACK", "--height-m", "900"], "no images"),
        (["--fov-deg", "66"], "--fov-deg applies"),
    ],
)
def test_simulate_flight_refuses_a_wrong_request(tmp_path, ground, track, capsys, flags, said):
    flags = [{"GROUND": ground, "TRACK": track}.get(flag, flag) for flag in flags]
    assert said in expect_refusal(capsys, "simulate", "flight", tmp_path / "flight", *flags, is_alone=True)


@pytest.mark.slow
def test_map_calibrate_cuts_the_orthophoto_again(tmp_path, ground, track, capsys, monkeypatch):
    monkeypatch.setattr(calibrate, "MIN_PLACES", 3)
    monkeypatch.setattr(calibrate, "count_queries", lambda technique: 3)
    path = tmp_path / "m.gpkg"
    cut = ("--orthophoto", ground, "--footprint-m", 100, "--spacing-m", 80, "--area", track)
    built = run_json(capsys, "map", "build", path, *cut, "--no-refine", "--no-calibrate")
    assert built["places"] == 9
    assert "calibration" not in built
    found = run_json(capsys, "map", "calibrate", path, *cut)["calibration"]
    assert 0 < found["places_asked"] <= found["asked"] <= 3  # where pictures may overlap, nobody knows
