"""Flights over an orthophoto: where a point of the ground appears in the picture, and how a track is flown."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

from rasters import HOME, MARKS_M, write_marked_raster, write_mission

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m, move_position, offset_position
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, read_positions
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, ground_to_pixel
from edgevpr.lab.simulate.overflight import make_poses, photograph_ground, read_shots, write_overflight
from edgevpr.mapmaking.orthophoto import Orthophoto

pytestmark = pytest.mark.slow

CLEAR = Light(sun_azimuth_deg=0, sun_elevation_deg=90)
CAMERA = Camera(noise_sigma=0)
LEVEL = CameraPose(east_m=0, north_m=0, height_m=80, heading_deg=0)


@pytest.fixture(scope="module")
def orthophoto(tmp_path_factory):
    """Marked ground of 300 m, in Web Mercator and turned: the flight must not show it."""
    path = tmp_path_factory.mktemp("ground") / "o.tif"
    return Orthophoto(write_marked_raster(path, "EPSG:3857", pixel_m=0.4, side_px=750, rotation_deg=30))


@pytest.mark.parametrize(
    ("change", "off_m"),
    [
        ({}, (0, 0)),
        ({"heading_deg": 120}, (10, -15)),
        ({"heading_deg": 350, "roll_deg": 8}, (0, 0)),
        ({"heading_deg": 45, "roll_deg": -6, "pitch_deg": 7, "height_m": 60}, (-8, 5)),
    ],
)
def test_photograph_ground_shows_a_mark_like_a_pinhole_camera(orthophoto, change, off_m):
    at = move_position(HOME, *off_m)
    pose = replace(LEVEL, **change)
    picture = photograph_ground(orthophoto, at, pose, CAMERA, CLEAR, np.random.default_rng(0))
    assert picture.shape == (480, 640, 3)
    bright = np.clip(picture[..., 2].astype(float) - 75, 0, None)
    rows, columns = np.indices(bright.shape)
    seen = 0
    for east_m, north_m in MARKS_M:
        there = ground_to_pixel(pose, CAMERA) @ (east_m - off_m[0], north_m - off_m[1], 1)
        column, row = there[:2] / there[2]
        if 40 < column < 600 and 40 < row < 440:
            weight = bright * (np.hypot(columns - column, rows - row) < 36)
            found = (columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()
            assert found == pytest.approx((column, row), abs=0.8)
            seen += 1
    assert seen >= 3


def test_photograph_ground_is_none_beyond_the_orthophoto_and_refuses_the_horizon(orthophoto):
    rng = np.random.default_rng(0)
    assert photograph_ground(orthophoto, move_position(HOME, 300, 0), LEVEL, CAMERA, CLEAR, rng) is None
    for angle_deg in (58, 75):
        with pytest.raises(UsageError, match="horizon"):
            photograph_ground(orthophoto, HOME, replace(LEVEL, roll_deg=angle_deg), CAMERA, CLEAR, rng)


def write_csv(tmp_path, text):
    path = tmp_path / "track.csv"
    path.write_text(text)
    return path


def test_read_shots_has_a_picture_for_each_line(tmp_path):
    path = write_csv(
        tmp_path,
        "file,lat,lon,alt,height_m,roll_deg,pitch_deg,yaw_deg\n"
        "a,50.0,11.9,600,80,3,-4,270\nb,,,,,,,\nc,50.001,11.9,,90,,,\nd,50.001,11.902,,90,,,\n",
    )
    shots = read_shots(path, None, 20.0)
    assert [shot.height_m for shot in shots] == [80, 90, 90]
    assert [round(shot.heading_deg) for shot in shots] == [270, 0, 90]
    assert (shots[0].roll_deg, shots[0].pitch_deg, shots[0].position.alt_m) == (3, -4, 600)
    assert [shot.t_utc_s - shots[0].t_utc_s for shot in shots] == pytest.approx([0, 11.12, 11.12 + 14.3], abs=0.05)
    assert [shot.height_m for shot in read_shots(path, 50.0, 20.0)] == [50, 50, 50]
    told, swaying, _ = make_poses(shots, 1)
    assert (told.heading_deg, told.roll_deg, told.pitch_deg) == (270, 3, -4)
    assert 0 < abs(swaying.roll_deg) <= 2


def test_read_shots_follows_the_waypoints_of_a_mission(tmp_path):
    rows = [(0, 50.0, 11.9, 500), (3, 50.001, 11.9, 60), (3, 50.001, 11.902, 80)]
    shots = read_shots(write_mission(tmp_path / "mission.waypoints", rows), None, 10.0)
    assert len(shots) == 1 + int((111.2 + 142.9) / 10)
    seconds = [shot.t_utc_s - shots[0].t_utc_s for shot in shots]
    assert seconds == pytest.approx(np.arange(len(shots)), abs=0.4), "it cuts the corner"
    assert [round(shot.heading_deg) for shot in (shots[0], shots[10], shots[13], shots[-1])] == [0, 0, 90, 90]
    assert shots[0].height_m == 60, "home has no height of its own"
    assert 78 < shots[-1].height_m <= 80
    here, there = shots[20].position, shots[21].position
    assert distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg) == pytest.approx(10, abs=0.01)


def test_read_shots_refuses_a_track_without_path_or_height(tmp_path):
    for text, said in (
        ("file,lat,lon\na,50,11.9\n", "--height-m"),
        ("file,lat,lon,height_m\na,,,\n", "lat and lon"),
        ("file,lat,lon,height_m\na,50,11,-3\n", "--height-m"),
    ):
        with pytest.raises(UsageError, match=said):
            read_shots(write_csv(tmp_path, text), None, 20.0)
    line = write_mission(tmp_path / "line.waypoints", [(0, 50, 11.9, 0), (0, 60, 11.9, 0)])
    with pytest.raises(UsageError, match="--height-m"):
        read_shots(line, None, 20_000.0)
    with pytest.raises(UsageError, match="waypoints"):
        read_shots(write_mission(line, [(0, 50, 11.9, 0)]), 80.0, 1.0)


def test_write_overflight_writes_the_truth_and_is_the_same_each_time(tmp_path, orthophoto):
    north = [offset_position(HOME.lat_deg, HOME.lon_deg, 0, 15.0 * step) for step in range(-2, 12)]
    shots = [GeoTag(position=Position(*at), height_m=70, t_utc_s=2.0 * n, heading_deg=0) for n, at in enumerate(north)]
    written = {}
    for name, seed in (("one", 1), ("two", 1), ("other", 2)):
        written[name] = list(write_overflight(tmp_path / name, orthophoto, shots, 60, seed))
    names = written["one"]
    assert 5 < len(names) < len(shots), "the end of the track lies beyond the orthophoto"
    assert names == sorted(path.name for path in (tmp_path / "one" / "images").iterdir())
    tags = read_positions(tmp_path / "one" / "positions.csv")
    assert list(tags) == names
    first = tags[names[0]]
    assert (first.position.lat_deg, first.height_m) == (north[0][0], 70)
    assert first.roll_deg != 0
    one, two, other = ((tmp_path / name / "images" / names[0]).read_bytes() for name in ("one", "two", "other"))
    assert one == two != other
    assert not list(write_overflight(tmp_path / "none", orthophoto, shots[-2:], 60, 1))
