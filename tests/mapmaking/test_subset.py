"""The part of a map that a mission needs."""

import shutil

import pytest
from pictures import draw_texture
from walks import make_map

from edgevpr.cli.main import main
from edgevpr.core.errors import MapError, UsageError
from edgevpr.core.geodesy import offset_position
from edgevpr.core.text import iterate_silently
from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.missions import Area, Waypoint
from edgevpr.mapmaking.subset import make_subset
from edgevpr.places.examine import merge_maps
from edgevpr.places.mapfile import PlaceMap
from edgevpr.techniques import create

HOME = 47.0, 8.0
SIDE = 5
STEP_M = 100.0


def to_lat_lon(east_m, north_m):
    return offset_position(*HOME, east_m, north_m)


def frame(column, row):
    position = Position(*to_lat_lon(column * STEP_M, row * STEP_M))
    return Frame(image=draw_texture(10 * column + row, 96, 96), name=f"{column}{row}", t_mono_s=0.0, position=position)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A folder of maps, of places 100 m apart: columns of them, and two in the last."""
    folder = tmp_path_factory.mktemp("maps")
    frames = [frame(column, row) for column in range(SIDE) for row in range(SIDE)]
    for tile in range(4):
        make_map(folder / f"{tile}.gpkg", create("hog"), frames[tile * SIDE : (tile + 1 + (tile == 3)) * SIDE])
    return folder


@pytest.fixture(scope="module")
def whole(maps, tmp_path_factory):
    """One map of them all."""
    path = tmp_path_factory.mktemp("whole") / "whole.gpkg"
    merge_maps(sorted(map(str, maps.iterdir())), path)
    return path


def list_names(path):
    with PlaceMap.open(path) as place_map:
        return sorted(place.source_image for place in place_map.read_places())


def make_path(*points):
    return Area(path=tuple(Waypoint(*to_lat_lon(*point)) for point in points))


@pytest.mark.parametrize("of_one", [True, False])
def test_make_subset_copies_places_along_a_path_from_several_maps(maps, whole, tmp_path, of_one):
    source, path = whole if of_one else maps, make_path((0, 200), (400, 200))
    found = make_subset(source, path, 110.0, tmp_path / "f.gpkg", None, iterate_silently)
    assert list_names(tmp_path / "f.gpkg") == sorted(f"{column}{row}" for column in range(5) for row in (1, 2, 3))
    assert (found.maps, found.near, found.places, found.lost_calibration) == (1 if of_one else 4, 15, 15, False)
    assert found.file_bytes == (tmp_path / "f.gpkg").stat().st_size


def test_subset_reads_only_the_maps_near_the_mission(maps, tmp_path):
    found = make_subset(maps, make_path((0, 0), (0, 400)), 20.0, tmp_path / "f.gpkg", None, iterate_silently)
    assert (found.maps, list_names(tmp_path / "f.gpkg")) == (1, [f"0{row}" for row in range(SIDE)])


def test_make_subset_copies_places_within_a_circle(maps, tmp_path):
    circle = Area((Waypoint(*to_lat_lon(100, 200)),), radius_m=130.0)
    make_subset(maps, circle, 20.0, tmp_path / "f.gpkg", None, iterate_silently)
    assert set(list_names(tmp_path / "f.gpkg")) == {f"{c}{r}" for c in range(3) for r in range(1, 4)}
    make_subset(maps, circle, 80.0, tmp_path / "g.gpkg", None, iterate_silently)
    assert "32" in list_names(tmp_path / "g.gpkg")


def test_make_subset_within_a_budget_keeps_the_places_with_the_smallest_gaps(maps, tmp_path):
    area = make_path((0, 0), (400, 400))
    whole = make_subset(maps, area, 1000.0, tmp_path / "whole.gpkg", None, iterate_silently)
    found = make_subset(maps, area, 1000.0, tmp_path / "f.gpkg", whole.file_bytes / 2, iterate_silently)
    assert (found.near, found.places) == (25, 12)
    assert found.file_bytes < whole.file_bytes
    with pytest.raises(UsageError, match=r"--mb 0\.0001 "):
        make_subset(maps, area, 1000.0, tmp_path / "g.gpkg", 100, iterate_silently)
    assert not (tmp_path / "g.gpkg").exists()


def test_map_subset_of_several_calibrated_maps_reports_that_it_is_not_calibrated(maps, tmp_path, capsys):
    shutil.copytree(maps, tmp_path / "tiles")
    for path in (tmp_path / "tiles").iterdir():
        with PlaceMap.open_for_writing(path) as place_map:
            place_map.record_calibration("of this map")
    out, (lat_deg, lon_deg) = tmp_path / "f.gpkg", to_lat_lon(200, 200)
    one, several = tmp_path / "tiles" / "0.gpkg", tmp_path / "tiles"
    for source, lost, kept in ((one, False, "of this map"), (several, True, None)):
        assert main(["map", "subset", str(source), "--mission", f"{lat_deg},{lon_deg},1000", "--out", str(out)]) == 0
        assert (f"map calibrate {out}" in capsys.readouterr().out) == lost
        with PlaceMap.open(out) as place_map:
            assert place_map.calibration == kept
        out.unlink()


def test_make_subset_refuses_invalid_requests_and_leaves_no_file(maps, tmp_path):
    with pytest.raises(UsageError, match=" 50 m "):
        make_subset(maps, make_path((5000, 0)), 50.0, tmp_path / "f.gpkg", None, iterate_silently)
    with pytest.raises(MapError, match=r"\*\.gpkg"):
        make_subset(tmp_path, make_path((0, 0)), 50.0, tmp_path / "f.gpkg", None, iterate_silently)
    assert not list(tmp_path.iterdir())
