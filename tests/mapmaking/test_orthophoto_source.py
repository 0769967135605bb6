"""The places cut from an orthophoto: their grid, what is left out, what a frame says, and the memory it takes."""

from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

import rasterio
from rasters import HOME, grid, ground_m, write_marked_raster, write_raster, write_textured_raster

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_position
from edgevpr.mapmaking.missions import Area, Waypoint
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.mapmaking.orthophoto_source import SIDE_PX, OrthophotoSource, make_lattice
from edgevpr.mapmaking.pictures import OrthophotoGrid

pytestmark = pytest.mark.slow


def read_all_frames(source: OrthophotoSource) -> list:
    frames = []
    while not source.ended:
        frames.append(source.read(1.0))
    return [frame for frame in frames if frame is not None]


def open_grid(path, footprint_m, spacing_m, area=None, only=None) -> OrthophotoSource:
    orthophoto = Orthophoto(path)
    return OrthophotoSource(orthophoto, [make_lattice(orthophoto, footprint_m, spacing_m, area)], only=only)


def compute_offsets_m(lattice) -> np.ndarray:
    """Metres east and north of HOME, (N, 2)."""
    return np.column_stack(ground_m(lattice.lat_deg, lattice.lon_deg))


def make_waypoint(east_m: float, north_m: float) -> Waypoint:
    return Waypoint(*offset_position(HOME.lat_deg, HOME.lon_deg, east_m, north_m))


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4326", "EPSG:3857"])
def test_places_lie_on_a_grid_of_metres_in_rows_from_the_north(tmp_path, crs):
    path = write_marked_raster(tmp_path / "o.tif", crs, pixel_m=0.5, side_px=400)
    lattice = make_lattice(Orthophoto(path), 80.0, 20.0)
    points_m = compute_offsets_m(lattice).reshape(*lattice.shape, 2)
    assert min(lattice.shape) >= 3
    np.testing.assert_allclose(np.diff(points_m[..., 0], axis=1), 20, atol=0.01)
    np.testing.assert_allclose(np.diff(points_m[..., 1], axis=0), -20, atol=0.01)
    assert points_m.reshape(-1, 2).mean(axis=0) == pytest.approx((0, 0), abs=0.5)
    assert len(lattice) == np.prod(lattice.shape)


def test_frames_have_position_and_footprint(tmp_path):
    source = open_grid(write_marked_raster(tmp_path / "o.tif", pixel_m=0.5, side_px=400), 80.0, 60.0)
    frames = read_all_frames(source)
    assert source.total == 9 == len(frames)
    assert (source.is_live, source.dropped, source.state, source.read(0)) == (False, None, "ended", None)
    assert [frame.name for frame in frames[:4]] == [f"o.tif_r00{at // 3}_c00{at % 3}" for at in range(4)]
    middle = frames[4]
    assert middle.image.shape == (SIDE_PX, SIDE_PX, 3)
    assert ground_m(middle.position.lat_deg, middle.position.lon_deg) == pytest.approx((0, 0), abs=0.5)
    assert middle.heading_deg == middle.pose.up_deg == 0
    assert middle.pose.footprint_m == 80
    assert middle.pose.is_surveyed
    assert middle.pose.covariance_m2 == pytest.approx((1 + 0.25**2, 0, 1 + 0.25**2), rel=1e-3)


def test_places_without_data_are_left_out_and_counted(tmp_path):
    to_crs, _, _ = grid("EPSG:32632", 0.5, 400)
    picture = np.full((1, 400, 400), 90, np.uint8)
    picture[..., :150] = 0
    source = open_grid(write_raster(tmp_path / "o.tif", picture, "EPSG:32632", to_crs, nodata=0), 60.0, 40.0)
    kept = read_all_frames(source)
    assert 0 < len(kept) < source.total
    assert source.counts["without_data"] == source.total - len(kept)
    east_m = [ground_m(frame.position.lat_deg, frame.position.lon_deg)[0] for frame in kept]
    assert min(east_m) >= -25 + 30 - 6 - 3  # the data begins 25 m west; a tenth of 60 m may lie beyond, and grid north

    turned = open_grid(write_marked_raster(tmp_path / "turned.tif", rotation_deg=45), 40.0, 40.0)
    assert 0.3 < len(read_all_frames(turned)) / turned.total < 0.7


def test_make_lattice_keeps_places_near_the_path_of_the_area(tmp_path):
    path = write_marked_raster(tmp_path / "o.tif", pixel_m=0.5, side_px=800)
    way = Area(path=(make_waypoint(-100, -50), make_waypoint(50, 100), make_waypoint(50, 150)))
    points_m = compute_offsets_m(make_lattice(Orthophoto(path), 25.0, 5.0, way))
    ends_m = np.array([(-100, -50), (50, 100), (50, 150)], float)
    away_m = np.full(len(points_m), np.inf)
    for begin, end in pairwise(ends_m):
        step = end - begin
        share = np.clip((points_m - begin) @ step / (step @ step), 0, 1)
        away_m = np.minimum(away_m, np.hypot(*(points_m - begin - share[:, None] * step).T))
    assert away_m.max() == pytest.approx(25, abs=2)
    assert len(points_m) == pytest.approx((np.hypot(150, 150) + 50) * 2 + 25 * np.pi, rel=0.1)  # 25 m2 each


@pytest.mark.parametrize(
    ("footprint_m", "spacing_m", "said"),
    [
        (0, 20, "--footprint-m is 0"),
        (-5, 20, "--footprint-m is -5"),
        (float("nan"), 20, "--footprint-m is nan"),
        (500, 20, "--footprint-m is 500, but .* 16. m by 16. m"),
        (80, 0, "--spacing-m is 0"),
        (80, 1000, "--spacing-m is 1000"),
        (80, 0.01, "pass --spacing-m 1, or"),
    ],
)
def test_make_lattice_refuses_an_invalid_grid(tmp_path, footprint_m, spacing_m, said):
    orthophoto = Orthophoto(write_marked_raster(tmp_path / "o.tif"))
    with pytest.raises(UsageError, match=said):
        make_lattice(orthophoto, footprint_m, spacing_m)


def test_make_lattice_refuses_an_area_elsewhere_with_both_extents(tmp_path):
    orthophoto = Orthophoto(write_marked_raster(tmp_path / "o.tif"))
    for way in (Waypoint(-35.36, 149.16), make_waypoint(3000, 0)):
        with pytest.raises(UsageError, match=r"\d north, .*\d east, .* 49\.99.* east\.$"):
            make_lattice(orthophoto, 40.0, 10.0, Area(path=(way,)))
    for off_m in (15.5, 4.0):  # between places, and so near to a row that its box holds one of either
        with pytest.raises(UsageError, match="10 m"):
            make_lattice(orthophoto, 0.5, 10.0, Area(path=(make_waypoint(off_m, 15.5),)))


def test_make_lattice_keeps_grid_and_names_within_an_area(tmp_path):
    path = write_marked_raster(tmp_path / "o.tif", pixel_m=0.5, side_px=400)
    every = {frame.name: frame.position for frame in read_all_frames(open_grid(path, 80.0, 30.0))}
    some = read_all_frames(open_grid(path, 80.0, 30.0, Area(path=(make_waypoint(60, 60),))))
    assert 2 <= len(some) < len(every)
    for frame in some:
        there = every[frame.name]
        assert frame.position.lat_deg == pytest.approx(there.lat_deg, abs=1e-8)
        assert frame.position.lon_deg == pytest.approx(there.lon_deg, abs=1e-8)


def test_places_under_cloud_are_counted(tmp_path):
    path = write_textured_raster(tmp_path / "o.tif", pixel_m=0.5)
    with rasterio.open(path, "r+") as raster:
        raster.write(np.full((1, 200, 200), 240, np.uint8), window=rasterio.windows.Window(220, 220, 200, 200))
    source = open_grid(path, 100.0, 60.0)
    assert (len(read_all_frames(source)), source.counts["white"]) == (16, 4)


def test_orthophoto_source_cuts_each_place_at_several_footprints(tmp_path):
    path = write_textured_raster(tmp_path / "o.tif", pixel_m=0.5)
    source = OrthophotoGrid(orthophoto=str(path), footprint_m=(150.0, 100.0), spacing_m=50.0).open()
    frames = read_all_frames(source)
    assert len({frame.name for frame in frames}) == len(frames) == source.total
    assert {frame.pose.footprint_m for frame in frames if "_150m_" in frame.name} == {150.0}
    assert {frame.pose.footprint_m for frame in frames if "_100m_" in frame.name} == {100.0}
    grid = OrthophotoGrid(orthophoto=str(path), footprint_m=(100.0, 150.0), spacing_m=50.0)
    (one,) = read_all_frames(grid.open(only=[frames[-1].name]))
    assert np.array_equal(one.image, frames[-1].image)
    with pytest.raises(UsageError, match="--footprint-m is 5000"):
        OrthophotoGrid(orthophoto=str(path), footprint_m=(100.0, 5000.0), spacing_m=50.0).open()
