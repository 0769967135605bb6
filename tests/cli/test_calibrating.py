"""`edgevpr map calibrate`, what `map build` says at its end, and what the other commands know of a calibrated map."""

import json
import shutil
import sys

import pytest
from commands import expect_refusal
from pictures import draw_texture, write_flight

from edgevpr.cli.main import main
from edgevpr.mapmaking import calibrate
from edgevpr.places.examine import shrink_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.calibration import read_calibration

PLACES = 8


@pytest.fixture(autouse=True)
def few_suffice(monkeypatch):
    monkeypatch.setattr(calibrate, "MIN_PLACES", PLACES)
    monkeypatch.setattr(calibrate, "count_queries", lambda technique: PLACES)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Pictures with positions, and those of another flight of the same names."""
    folder = tmp_path_factory.mktemp("flight")
    write_flight(folder / "ref", [draw_texture(number, 240, 320) for number in range(PLACES)], step_deg=0.002)
    write_flight(folder / "other", [draw_texture(50 + number, 240, 320) for number in range(PLACES)])
    return folder


def build_map(path, images, *flags):
    words = ["map", "build", str(path), "--images", str(images), "--technique", "cohog", "--param", "w1=208", *flags]
    return main(words)


@pytest.fixture(scope="module")
def bare_map(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("bare") / "m.gpkg"
    assert build_map(path, flight / "ref", "--no-calibrate") == 0
    return path


@pytest.fixture
def uncalibrated_map(bare_map, tmp_path):
    return shutil.copy(bare_map, tmp_path / "m.gpkg")


def read_stored_calibration(path):
    with PlaceMap.open(path) as place_map:
        text = place_map.calibration
    return None if text is None else read_calibration(text)


@pytest.mark.slow
def test_map_build_reports_what_to_expect(flight, tmp_path, capsys):
    path = tmp_path / "m.gpkg"
    assert build_map(path, flight / "ref") == 0
    assert f"expect: {(found := read_stored_calibration(path)).describe()}\n" in capsys.readouterr().out
    assert build_map(tmp_path / "again.gpkg", flight / "ref", "--json") == 0
    assert json.loads(capsys.readouterr().out)["calibration"] == found.figures()


def test_map_build_builds_a_map_that_cannot_be_calibrated(flight, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(calibrate, "MIN_PLACES", PLACES + 1)
    assert build_map(tmp_path / "small.gpkg", flight / "ref", "--param", "camera=nadir", "--no-refine") == 0
    said = capsys.readouterr()
    assert (said.out + said.err).count(f"it has {PLACES} places") == 1
    assert "expect:" not in said.out
    monkeypatch.setitem(sys.modules, "edgevpr.mapmaking.calibrate", None)  # as where SciPy is missing
    assert build_map(tmp_path / "bare.gpkg", flight / "ref", "--json") == 0
    made = json.loads(capsys.readouterr().out)
    assert (made["places"], len(made["not_done"])) == (PLACES, 1)
    assert "SciPy" in made["not_done"][0]


@pytest.mark.parametrize(
    ("flags", "code", "said"),
    [
        (["--images", "FLIGHT/other"], 2, " 0 places"),
        (["--images", "FLIGHT/absent"], 1, "does not exist"),
        ([], 2, "Pass either --images"),
        (["--images", "FLIGHT/ref", "--positions", "FLIGHT/absent.csv"], 2, "absent.csv"),
    ],
)
def test_map_calibrate_refuses_other_pictures(uncalibrated_map, flight, capsys, flags, code, said):
    flags = [each.replace("FLIGHT", str(flight)) for each in flags]
    assert said in expect_refusal(capsys, "map", "calibrate", uncalibrated_map, *flags, code=code)
    assert read_stored_calibration(uncalibrated_map) is None


@pytest.mark.slow
def test_shrink_map_keeps_the_calibration_and_map_merge_drops_it(uncalibrated_map, bare_map, flight, tmp_path, capsys):
    assert main(["map", "calibrate", str(uncalibrated_map), "--images", str(flight / "ref")]) == 0
    shrink_map(uncalibrated_map, tmp_path / "small.gpkg", 4)
    assert read_stored_calibration(tmp_path / "small.gpkg") == read_stored_calibration(uncalibrated_map)
    capsys.readouterr()
    merged = tmp_path / "merged.gpkg"
    assert main(["map", "merge", str(merged), str(uncalibrated_map), str(bare_map)]) == 0
    assert f"calibrate {merged}" in capsys.readouterr().out
    assert read_stored_calibration(merged) is None
