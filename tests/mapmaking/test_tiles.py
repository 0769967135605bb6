"""Map tiles of folders: they give the ground, or a sentence."""

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

from pictures import textured
from rasterio.warp import transform
from rasters import HOME

from edgevpr.core.errors import EdgevprError, ImageError
from edgevpr.core.types import Position
from edgevpr.mapmaking.orthophoto import Orthophoto

HALF_WORLD_M = 20037508.342789244
ZOOM = 18
REACH = 2


def tile(x: int, y: int, side_px: int = 256) -> bytes:
    """Ground without a seam that differs everywhere."""
    rng = np.random.default_rng((x, y))
    coarse = rng.integers(30, 220, (side_px // 8, side_px // 8, 3), np.uint8)
    return cv2.imencode(".png", cv2.resize(coarse, (side_px, side_px), interpolation=cv2.INTER_CUBIC))[1].tobytes()


def middle(zoom: int = ZOOM, at: Position = HOME) -> tuple[int, int]:
    (x_m,), (y_m,) = transform("EPSG:4326", "EPSG:3857", [at.lon_deg], [at.lat_deg])
    return tuple(int((HALF_WORLD_M + side_m) / (2 * HALF_WORLD_M) * 2**zoom) for side_m in (x_m, -y_m))


def around(zoom: int = ZOOM, at: Position = HOME, reach: int = REACH) -> list[tuple[int, int, int]]:
    x, y = middle(zoom, at)
    steps = range(-reach, reach + 1)
    return [(zoom, (x + i) % 2**zoom, y + j) for i in steps for j in steps]


def folder(path: Path, tiles) -> Path:
    for zoom, x, y in tiles:
        (path / f"{zoom}/{x}").mkdir(parents=True, exist_ok=True)
        (path / f"{zoom}/{x}/{y}.png").write_bytes(tile(x, y))
    return path


def cut(source):
    orthophoto = Orthophoto(source)
    try:
        return orthophoto.cut(HOME, 100.0, 200)
    finally:
        orthophoto.close()


def refused(source) -> str:
    with pytest.raises(EdgevprError) as caught:
        cut(source)
    assert str(caught.value).endswith((".", "..."))
    return str(caught.value)


def joined(path: Path, from_south: bool = False, says_from_south: bool = False) -> Path:
    """Write tiles of one ground, whose rows join; their y counts from the south, and a file says so, or not."""
    ground = textured(1, 5 * 256, 5 * 256)
    left, top = (number - REACH for number in middle())
    for zoom, x, y in around():
        (path / f"{zoom}/{x}").mkdir(parents=True, exist_ok=True)
        row, column = 256 * (y - top), 256 * (x - left)
        named_y = 2**zoom - 1 - y if from_south else y
        cv2.imwrite(str(path / f"{zoom}/{x}/{named_y}.png"), ground[row : row + 256, column : column + 256])
    if says_from_south:
        (path / "tilemapresource.xml").write_text('<TileMap version="1.0.0"/>')
    return path


def test_a_folder_counts_its_rows_as_its_tiles_join_or_is_refused(tmp_path):
    expected, valid = cut(joined(tmp_path / "xyz"))
    assert valid.all()
    found, _ = cut(joined(tmp_path / "tms", from_south=True, says_from_south=True))
    assert np.array_equal(found, expected)
    assert "gdal2tiles --xyz" in refused(joined(tmp_path / "silent", from_south=True))
    assert "remove that file" in refused(joined(tmp_path / "wrong", says_from_south=True))


def test_a_folder_may_mix_formats_and_have_gaps_and_damage_is_named(tmp_path):
    x, y = middle()
    path = folder(tmp_path / "a folder #1", around()) / f"{ZOOM}/{x}/{y}.png"
    expected, _ = cut(tmp_path / "a folder #1")
    path.rename(path.with_suffix(".PNG"))
    (path.parent / "notes.txt").write_text("no tile")
    grey = path.with_name(f"{y - 1}.png")
    grey.write_bytes(cv2.imencode(".webp", np.full((256, 256), 90, np.uint8))[1].tobytes())
    found, valid = cut(tmp_path / "a folder #1")
    assert valid.all()
    assert np.array_equal(found[120:], expected[120:])
    path.with_suffix(".PNG").unlink()
    assert 0 < cut(tmp_path / "a folder #1")[1].mean() < 1
    path.write_bytes(b"nothing")
    with pytest.raises(ImageError, match="copy the file again"):
        cut(tmp_path / "a folder #1")
