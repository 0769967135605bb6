"""The grid of tiles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgevpr.core.geodesy import is_in_extent, widen_extent
from edgevpr.fleet.grid import Tile, list_tiles, locate, parse_zoom, zoom_of_places, zoom_of_spacing


@given(st.floats(-90, 90), st.floats(-180, 180), st.integers(12, 22))
def test_locate_gives_the_tile_of_a_position(lat_deg, lon_deg, zoom):
    at = np.array([lat_deg]), np.array([lon_deg])
    tile = Tile(zoom, *locate(*at, zoom)[0].tolist())
    assert -180 <= tile.extent_deg[1] < 180
    assert is_in_extent(widen_extent(tile.extent_deg, 0.01), *at).all()
    assert parse_zoom(tile.name) == zoom


def test_list_tiles_parts_the_ground_without_gaps_or_overlaps_across_the_antimeridian():
    lat_deg, lon_deg = np.random.default_rng(1).uniform((-0.05, 179.9), (0.1, 180.2), (500, 2)).T
    lon_deg = (lon_deg + 180) % 360 - 180
    lat_deg[:2], lon_deg[:4] = 0.0, (0.0, -180.0, 180.0, -1e-17)
    tiles = [*list_tiles((-0.06, 179.8, 0.11, 180.3), 13), *list_tiles((-0.06, -0.01, 0.11, 0.01), 13)]
    assert len({tile.name for tile in tiles}) == len(tiles)
    assert (sum(is_in_extent(tile.extent_deg, lat_deg, lon_deg).astype(int) for tile in tiles) == 1).all()


@pytest.mark.parametrize("lon_deg", [-179.9999, 179.9999])
def test_widen_extent_goes_on_across_the_antimeridian(lon_deg):
    tile = Tile(12, *locate(np.array([0.5]), np.array([lon_deg]), 12)[0].tolist())
    at = np.full(4, 0.5), np.array([-179.9999, 179.9999, 179.0, -179.0])
    assert is_in_extent(widen_extent(tile.extent_deg, 100.0), *at).tolist() == [True, True, False, False]
    assert is_in_extent(widen_extent(tile.extent_deg, 1.0), *at).tolist() == [lon_deg < 0, lon_deg > 0, False, False]


def test_zoom_of_places_is_the_lowest_whose_tiles_hold_them():
    rng = np.random.default_rng(1)
    lat_deg, lon_deg = 47 + 0.2 * rng.random(3000), 8 + 0.2 * rng.random(3000)
    zoom = zoom_of_places(lat_deg, lon_deg, 500)
    counts = [
        np.unique(locate(lat_deg, lon_deg, each), axis=0, return_counts=True)[1].max() for each in (zoom - 1, zoom)
    ]
    assert counts[0] > 500 >= counts[1]
    assert zoom_of_places(lat_deg[:1], lon_deg[:1], 500) == 12, "a few places do not decide for all that come later"
    assert zoom_of_places(np.full(9, 47.0), np.full(9, 8.0), 5) == 22, "places at one point cannot be parted"


@pytest.mark.parametrize(("spacing_m", "most"), [(40, 10_000), (10, 100)])
def test_zoom_of_spacing_bounds_the_places_of_a_tile(spacing_m, most):
    side_m = 360 / 2 ** zoom_of_spacing(spacing_m, most) * 111_320
    assert most / 4 < (side_m / spacing_m) ** 2 <= 1.01 * most
