"""The grid of tiles, by quad keys."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgevpr.core.errors import UsageError
from edgevpr.core.quadkeys import (
    MOST_LAT_DEG,
    extent_around,
    in_extent,
    keys_over,
    ring_around,
    tile_extent,
    tile_keys,
    zoom_of_places,
    zoom_of_spacing,
)

ONE = np.array([47.6]), np.array([-122.3])


def test_keys_at_are_those_of_map_servers():
    # The example in "Bing Maps Tile System" (Microsoft): column 3 and row 5 at level 3 are 213.
    south, west, _, _ = tile_extent("213")
    assert (west, tile_keys(np.array([south + 1]), np.array([west + 1]), 3)[0]) == (-45.0, "213")


@given(st.floats(-85, 85), st.floats(-180, 180), st.integers(1, 22))
def test_keys_at_name_the_tile_of_a_position(lat_deg, lon_deg, zoom):
    south, west, north, east = tile_extent(str(tile_keys(np.array([lat_deg]), np.array([lon_deg]), zoom)[0]))
    assert south - 1e-9 <= lat_deg <= north + 1e-9
    assert west - 1e-9 <= lon_deg <= east + 1e-9 or lon_deg > 180 - 1e-9


def test_keys_over_a_box_across_the_date_line():
    keys = list(keys_over((10.0, 179.9, 10.1, 180.2), 8))
    assert sorted(tile_extent(key)[1] for key in keys) == [-180.0, 178.59375]
    assert keys == [str(key) for key in tile_keys(np.array([10.05, 10.05]), np.array([179.95, -179.9]), 8)]


def test_ring_around_encloses_the_tile():
    ring = ring_around(tile_extent("021230"))
    assert ring[0] == ring[-1]
    south, west, north, east = tile_extent("021230")
    assert min(ring) < (south, west)
    assert max(ring) > (north, east)


@pytest.mark.parametrize("beside_deg", [-179.9999, 179.9999])
def test_extent_around_goes_on_across_the_date_line(beside_deg):
    (key,) = tile_keys(np.array([0.5]), np.array([beside_deg]), 12)
    lat_deg, lon_deg = np.full(4, 0.5), np.array([-179.9999, 179.9999, 179.0, -179.0])
    assert in_extent(extent_around(key, 100.0), lat_deg, lon_deg).tolist() == [True, True, False, False]
    assert in_extent(extent_around(key, 1.0), lat_deg, lon_deg).tolist() == [
        beside_deg < 0,
        beside_deg > 0,
        False,
        False,
    ]


def test_keys_at_refuses_a_position_near_a_pole():
    with pytest.raises(UsageError, match=r"89\.00 degrees north.*make a single map"):
        tile_keys(np.array([MOST_LAT_DEG, 89.0]), np.zeros(2), 5)


def test_zoom_of_places_is_the_lowest_whose_tiles_hold_them():
    rng = np.random.default_rng(1)
    lat_deg, lon_deg = 47 + 0.2 * rng.random(3000), 8 + 0.2 * rng.random(3000)
    zoom = zoom_of_places(lat_deg, lon_deg, 500)
    counts = [np.unique(tile_keys(lat_deg, lon_deg, each), return_counts=True)[1].max() for each in (zoom - 1, zoom)]
    assert counts[0] > 500 >= counts[1]
    assert zoom_of_places(lat_deg[:1], lon_deg[:1], 500) == 12, "a few places do not decide for all that come later"
    assert zoom_of_places(np.full(9, 47.0), np.full(9, 8.0), 5) == 22, "places at one point cannot be parted"


@pytest.mark.parametrize(("spacing_m", "most"), [(40, 10_000), (10, 100)])
def test_zoom_of_spacing_bounds_the_places_of_a_tile(spacing_m, most):
    south, _, north, _ = tile_extent(str(tile_keys(*ONE, zoom_of_spacing(47.6, spacing_m, most))[0]))
    side_m = (north - south) * 111_200
    assert most / 4 < (side_m / spacing_m) ** 2 <= 1.01 * most
