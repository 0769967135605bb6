"""Squares cut out of orthophotos of every kind: what is where, to a fraction of a pixel, and what is refused."""

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

import rasterio
from rasterio.warp import transform
from rasters import HOME, MARKS_M, draw_marks, grid, write_marked_raster, write_raster

from edgevpr.core.errors import ImageError, SourceError
from edgevpr.mapmaking.orthophoto import Orthophoto

pytestmark = pytest.mark.slow

FOOTPRINT_M = 80.0
SIDE_PX = 400


def cut(path, footprint_m=FOOTPRINT_M, at=HOME):
    orthophoto = Orthophoto(path)
    picture, valid = orthophoto.cut(at, footprint_m, SIDE_PX)
    orthophoto.close()
    return picture, valid


def require_marks(picture: np.ndarray, footprint_m: float = FOOTPRINT_M, within_px: float = 0.1) -> None:
    """Hold the middle of each mark against where it must be: north is up, and metres are those of the ground."""
    pixel_m = footprint_m / SIDE_PX
    bright = picture[..., 2].astype(float)
    bright = np.clip(bright - np.median(bright) - 8, 0, None)
    rows, columns = np.indices(bright.shape)
    for east_m, north_m in MARKS_M:
        column, row = SIDE_PX / 2 - 0.5 + east_m / pixel_m, SIDE_PX / 2 - 0.5 - north_m / pixel_m
        weight = bright * (np.hypot(columns - column, rows - row) < 7 / pixel_m)
        found = (columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()
        assert found == pytest.approx((column, row), abs=within_px), (east_m, north_m)


@pytest.mark.parametrize(
    ("crs", "rotation_deg"),
    [
        ("EPSG:32632", 0),
        ("EPSG:32632", 37),
        ("EPSG:4326", 0),
        ("EPSG:3857", 0),
        ("EPSG:3857", 200),
        ("EPSG:31468", 0),  # another datum, 130 m off
        ("+proj=tmerc +lat_0=50 +lon_0=9 +datum=WGS84 +units=us-ft", 0),
    ],
)
def test_cut_places_marks_correctly_with_true_north_up(tmp_path, crs, rotation_deg):
    picture, valid = cut(write_marked_raster(tmp_path / "o.tif", crs, rotation_deg=rotation_deg, side_px=720))
    assert picture.shape == (SIDE_PX, SIDE_PX, 3)
    assert picture.dtype == np.uint8
    assert valid.all()
    require_marks(picture)
    assert picture[..., 2].mean() > 1.1 * picture[..., 0].mean(), "red comes last"


@pytest.mark.parametrize(
    ("crs", "west"), [("EPSG:4326", 179.999), ("EPSG:4326", -180.001), ("EPSG:3857", 20037398.0), ("EPSG:32660", None)]
)
def test_orthophoto_reads_a_file_across_the_antimeridian(tmp_path, crs, west):
    (x,), (y,) = transform("EPSG:4326", crs, [179.999], [-17.0])
    pixel = 1e-5 if crs == "EPSG:4326" else 1.1
    to_crs = rasterio.Affine(pixel, 0, x if west is None else west, 0, -pixel, y + 100 * pixel)
    bands = np.full((3, 200, 200), 90, np.uint8)
    bands[:, :, 100:] = 200
    orthophoto = Orthophoto(write_raster(tmp_path / "o.tif", bands, crs, to_crs))
    _, west_deg, _, east_deg = orthophoto.extent_deg
    assert 0 < east_deg - west_deg < 0.01
    for lon_deg in (179.99995, -179.99995):
        _, valid = orthophoto.cut(type(HOME)(-17.0, lon_deg), 40.0, 50)
        assert valid.all()


@pytest.mark.parametrize("pixel_m", [0.07, 0.45])
def test_pixels_much_finer_or_coarser_than_the_picture_are_averaged_and_in_place(tmp_path, pixel_m):
    picture, valid = cut(write_marked_raster(tmp_path / "o.tif", pixel_m=pixel_m, side_px=int(84 / pixel_m)))
    assert valid.all()
    require_marks(picture, within_px=0.2)


def test_cut_masks_ground_beyond_the_edge(tmp_path):
    path = write_marked_raster(tmp_path / "o.tif")  # 160 m wide
    orthophoto = Orthophoto(path)
    _, valid = orthophoto.cut(HOME, 320.0, SIDE_PX)
    assert valid.mean() == pytest.approx(0.25, abs=0.01)
    picture, valid = orthophoto.cut(type(HOME)(50.1, 11.9), 80.0, SIDE_PX)
    assert not valid.any()
    assert not picture.any()
    south, west, north, east = orthophoto.extent_deg
    assert south < 50 < north
    assert west < 11.9 < east
    assert orthophoto.resolution_m == pytest.approx(0.25, rel=0.01)


def convert_marks(kind: str, bright: np.ndarray) -> tuple[np.ndarray, dict]:
    """The marks in another form of file, with the west half of the ground without data where the form can say so."""
    byte = bright.astype(np.uint8)
    known = np.full(byte.shape, 255, np.uint8)
    known[:, : byte.shape[1] // 2 - 20] = 0
    empty = np.where(known, byte, 0)
    return {
        "grey": (byte[None], {}),
        "alpha": (np.stack((byte, byte, byte, known)), {"photometric": "RGB", "alpha": "yes"}),
        "grey and alpha": (np.stack((byte, known)), {"alpha": "yes"}),
        "near infrared": (np.stack((byte, byte, byte, 255 - byte)), {"photometric": "RGB", "alpha": "no"}),
        "near infrared as opacity": (
            np.stack((byte, byte, byte, np.maximum(byte, 1) // 2)),
            {"photometric": "RGB", "alpha": "yes"},
        ),
        "nodata": (np.stack([empty] * 3), {"nodata": 0}),
    }[kind]


@pytest.mark.parametrize(
    "kind", ["grey", "alpha", "grey and alpha", "near infrared", "near infrared as opacity", "nodata"]
)
def test_orthophoto_reads_each_file_format(tmp_path, kind):
    to_crs, east_m, north_m = grid("EPSG:32632", 0.25, 640)
    bands, profile = convert_marks(kind, draw_marks(east_m, north_m))
    picture, valid = cut(write_raster(tmp_path / "o.tif", bands, "EPSG:32632", to_crs, **profile))
    assert picture.shape == (SIDE_PX, SIDE_PX, 3)
    if "alpha" in kind or kind == "nodata":
        assert valid[:, SIDE_PX // 2 :].all()
        assert not valid[:, : SIDE_PX // 4].any()
        assert valid.mean() == pytest.approx(0.5 + 5 / 80, abs=0.02)
        unknown = picture[~valid]
        assert (unknown == unknown[0]).all(), "what is not known has one colour"
    else:
        assert valid.all()
        require_marks(picture)


def read_refusal(path) -> str:
    with pytest.raises(SourceError) as caught:
        Orthophoto(path)
    assert str(caught.value).endswith(".")
    return str(caught.value)


def test_orthophoto_refuses_other_files_in_one_sentence(tmp_path):
    to_crs, east_m, north_m = grid("EPSG:32632", 1.0, 64)
    bright = draw_marks(east_m, north_m)
    byte = bright.astype(np.uint8)[None]
    assert "missing.tif" in read_refusal(tmp_path / "missing.tif")
    assert "is a folder" in read_refusal(tmp_path)
    (tmp_path / "notes.tif").write_text("not a raster")
    assert "opened" in read_refusal(tmp_path / "notes.tif")
    assert "georeference" in read_refusal(write_raster(tmp_path / "a.tif", byte, None, to_crs))
    no_place = write_raster(tmp_path / "b.tif", byte, "EPSG:32632", rasterio.Affine.identity())
    assert "georeference" in read_refusal(no_place)
    nameless = write_raster(tmp_path / "d.tif", byte, "+proj=utm +zone=32 +ellps=bessel", to_crs)
    assert "names no datum" in read_refusal(nameless)
    Orthophoto(write_raster(tmp_path / "e.tif", byte, "+proj=utm +zone=32 +ellps=GRS80", to_crs)).close()
    heights = write_raster(tmp_path / "c.tif", bright[None].astype(np.float32), "EPSG:32632", to_crs)
    assert "float32" in read_refusal(heights)
    assert "8-bit" in read_refusal(heights)
    deep = write_raster(tmp_path / "f.tif", bright[None].astype(np.uint16), "EPSG:32632", to_crs)
    assert "gdal_translate -ot Byte" in read_refusal(deep)
    local = write_raster(tmp_path / "d.tif", byte, 'LOCAL_CS["site",UNIT["metre",1]]', to_crs)
    assert "latitude" in read_refusal(local)
    assert "not degrees" in read_refusal(write_raster(tmp_path / "g.tif", byte, "EPSG:4326", to_crs))
    palette = write_raster(tmp_path / "e.tif", byte, "EPSG:32632", to_crs, photometric="palette")
    with rasterio.open(palette, "r+") as data:
        data.write_colormap(1, {number: (number, 0, 0, 255) for number in range(256)})
    assert "palette" in read_refusal(palette)


def test_cut_refuses_a_truncated_file(tmp_path):
    path = write_marked_raster(tmp_path / "o.tif")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ImageError, match="copy"):
        Orthophoto(path).cut(HOME, 120.0, SIDE_PX)


def test_cut_draws_no_dark_line_at_the_edge_of_the_data(tmp_path):
    to_crs, _, _ = grid("EPSG:32632", 0.13, 800)
    picture = np.full((1, 800, 800), 150, np.uint8)
    picture[..., :400] = 0
    cut_out, valid = cut(write_raster(tmp_path / "o.tif", picture, "EPSG:32632", to_crs, nodata=0))
    assert 0.4 < valid.mean() < 0.6
    assert cut_out.min() >= 145
