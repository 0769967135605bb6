"""Positions, headings and times from EXIF; the tags are numbered as in the EXIF standard (JEITA CP-3451)."""

from contextlib import nullcontext

import numpy as np
import photographs
import pytest

from edgevpr.cli.main import main
from edgevpr.core.config import SourceConfig
from edgevpr.core.errors import UsageError
from edgevpr.core.types import Position
from edgevpr.frames.exif import read_exif, read_fov_deg
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import GeoTag
from edgevpr.mapmaking.advice import require_one_lens, suggest_lens, warn_of_gaps
from edgevpr.mapmaking.pictures import FlightPictures
from edgevpr.places.mapfile import PlaceMap
from edgevpr.techniques import create

pytest.importorskip("PIL", reason="the photographs with EXIF are made with Pillow")

LAT_REF = 1
LAT = 2
LON_REF = 3
LON = 4
ALT_REF = 5
ALT = 6
TIME = 7
STATUS = 9
DIRECTION_REF = 16
DIRECTION = 17
DATE = 29
GPS = {LAT_REF: "N", LAT: (46.0, 50.0, 33.0), LON_REF: "W", LON: (91.0, 59.0, 42.0)}
TAKEN = 0x9003
ZONE = 0x9011
T_UTC_S = 1466699519  # date -u -d '2016-06-23 16:31:59' +%s


def read_tag(path, gps=None, **tags):
    photographs.write_jpeg(path / "photo.jpg", gps, **tags)
    return read_exif(path / "photo.jpg")


def test_read_exif_of_a_photograph_with_everything(tmp_path):
    gps = GPS | {ALT_REF: b"\x00", ALT: 198.5, TIME: (16.0, 31.0, 59.5), DATE: "2016:06:23"}
    tag = read_tag(tmp_path, gps | {DIRECTION_REF: "T", DIRECTION: 123.25})
    assert tag.position.lat_deg == pytest.approx(46.8425, abs=1e-9)
    assert tag.position.lon_deg == pytest.approx(-91.995, abs=1e-9)
    assert (tag.position.alt_m, tag.heading_deg, tag.t_utc_s) == (198.5, 123.25, T_UTC_S + 0.5)


def test_read_exif_ignores_a_height_above_the_ellipsoid_and_a_magnetic_heading(tmp_path):
    assert read_tag(tmp_path, GPS | {ALT_REF: b"\x02", ALT: 198.5}).position == Position(46.8425, -91.995, None)
    assert read_tag(tmp_path, {DIRECTION_REF: "M", DIRECTION: 10.0}).heading_deg is None


@pytest.mark.parametrize(
    "gps",
    [
        {LAT: (0.0, 0.0, 0.0), LON: (0.0, 0.0, 0.0)},  # as a receiver writes it that knows no position
        {STATUS: "V"},  # the receiver itself says that the position is void
        {LAT: (96.0, 0.0, 0.0)},
        {LAT: (46.0, 99.0, 33.0)},
        {LON: (190.0, 0.0, 0.0)},
        {LAT_REF: "W"},
        {LAT_REF: ""},  # a hemisphere that is not named is not guessed
        {LAT: (46.0, 50.0)},
    ],
)
def test_read_exif_treats_an_implausible_position_as_unknown(gps, tmp_path):
    assert read_tag(tmp_path, GPS | gps).position is None


@pytest.mark.parametrize(
    ("gps", "camera", "t_utc_s"),
    [
        (None, {TAKEN: "2016:06:23 16:31:59"}, T_UTC_S),  # the receiver gives no time
        (None, {TAKEN: "2016:06:23 18:31:59", ZONE: "+02:00"}, T_UTC_S),
        (None, {TAKEN: "0000:00:00 00:00:00"}, None),
        ({TIME: (4294967295.0, 31.0, 59.5), DATE: "2016:06:23"}, None, None),
        ({TIME: (16.0, 31.0, 59.5), DATE: "1e308"}, None, None),
        (None, {TAKEN: "1e308"}, None),
        (None, {TAKEN: "9999:12:31 23:59:59"}, None),
        (None, {TAKEN: "    :  :     :  :  "}, None),
    ],
)
def test_read_exif_reads_the_time_of_each_source(gps, camera, t_utc_s, tmp_path):
    assert read_tag(tmp_path, gps, camera=camera).t_utc_s == t_utc_s


def test_photograph_lying_on_its_side_is_set_upright(tmp_path):
    photographs.write_jpeg(tmp_path / "lying.jpg", image={0x0112: 6})
    assert read_image(tmp_path / "lying.jpg").shape == (64, 48, 3)


def test_read_exif_adds_the_fraction_of_the_second(tmp_path):
    photographs.write_jpeg(tmp_path / "photo.jpg", camera={TAKEN: "2016:06:23 16:31:59", 0x9291: "25"})
    assert read_exif(tmp_path / "photo.jpg").t_utc_s == T_UTC_S + 0.25


@pytest.mark.parametrize("camera", ["nadir", "forward"])
def test_map_build_sets_images_upright_only_for_a_camera_that_looks_ahead(camera, tmp_path):
    stored = {}
    for orientation in (1, 6):
        folder, path = tmp_path / f"{orientation}", tmp_path / f"{orientation}.gpkg"
        folder.mkdir()
        photographs.write_jpeg(folder / "photo.jpg", image={0x0112: orientation})
        assert main(["map", "build", str(path), "--images", str(folder), "--camera", camera]) == 0
        with PlaceMap.open(path) as place_map:
            stored[orientation], _ = place_map.read_fine_part(1)
    assert np.array_equal(stored[1], stored[6]) == (camera == "nadir")


@pytest.mark.parametrize(
    "content", [b"", b"rubbish", b"II*\x00", b"MM\x00*\xff\xff\xff\xff", b"II*\x00\x08\x00\x00\x00" * 9]
)
def test_read_exif_returns_an_empty_tag_for_missing_or_invalid_data(content, tmp_path, capfd):
    path = tmp_path / "rubbish.jpg"
    path.write_bytes(photographs.insert_app1(photographs.encode_image(".jpg", photographs.draw_picture()), content))
    assert read_exif(path) == read_exif(tmp_path / "missing.jpg") == GeoTag()
    assert read_image(path).shape == (48, 64, 3)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("focal_mm", "sides", "fov_deg"),
    [
        (24, (4000, 3000), 71.6),  # as DJI says of the Mini 2: 83 degrees across the diagonal
        (24, (3000, 4000), 71.6),
        (20, (4000, 2250), 83.1),
        (0, (4000, 3000), None),
        (24, (), None),
    ],
)
def test_fov_deg_of_is_that_of_the_equivalent_focal_length(focal_mm, sides, fov_deg, tmp_path):
    size = dict(zip((0xA002, 0xA003), sides, strict=False))
    photographs.write_jpeg(tmp_path / "photo.jpg", camera={0xA405: focal_mm, **size})
    assert read_fov_deg(tmp_path / "photo.jpg") == (None if fov_deg is None else pytest.approx(fov_deg, abs=0.1))


@pytest.mark.parametrize(("focal_mm", "is_accepted"), [(24, True), (48, False)])
def test_map_build_refuses_and_reports_wide_and_tele_pictures_in_one_folder(focal_mm, is_accepted, tmp_path, caplog):
    for name, focal in (("a.jpg", 24), ("b.jpg", focal_mm)):
        photographs.write_jpeg(tmp_path / name, camera={0xA405: focal, 0xA002: 4000, 0xA003: 3000})
    pictures = FlightPictures(source=str(tmp_path))
    with nullcontext() if is_accepted else pytest.raises(UsageError, match="from 40 to 72 degrees"):
        require_one_lens(pictures)
    caplog.set_level("INFO")
    suggest_lens(pictures, SourceConfig(), create("cohog", {"camera": "nadir"}))
    assert ("pass --fov-deg 72" if is_accepted else "from 40 to 72 degrees") in caplog.text


@pytest.mark.parametrize(("images_each", "is_reported"), [(1, False), (3, False), (12, True)])
def test_map_build_asks_whether_gps_was_frozen(tmp_path, caplog, images_each, is_reported):
    for number in range(12):
        gps = GPS | {LAT: (46.0, number // images_each, 0.0), ALT: number}
        photographs.write_jpeg(tmp_path / f"{number:02d}.jpg", gps)
    warn_of_gaps(FlightPictures(source=str(tmp_path)), 0, None)
    assert ("was GPS frozen?" in caplog.text) == is_reported
