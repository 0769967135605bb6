"""The places that stay in RAM where the budget is too small for all: evenly spread, and those that say most."""

import numpy as np
import pytest

from edgevpr.places.index import choose_places


def make_track(east_m):
    lon_deg = np.asarray(east_m, float) / 111_195
    return np.zeros(len(lon_deg)), lon_deg


def test_choose_places_keeps_gaps_even_despite_densely_mapped_stretches():
    crowded = np.concatenate((np.arange(0, 100, 10), 100 + np.arange(0, 10, 0.1), np.arange(120, 220, 10)))
    lat, lon = make_track(crowded)
    kept = choose_places(lat, lon, np.ones(len(crowded)), 22)
    gaps = np.diff(crowded[kept])
    assert len(kept) == 22
    assert gaps.max() <= 21
    assert gaps.min() > 4


def test_choose_places_keeps_the_better_of_two_adjacent_places():
    lat, lon = make_track([0, 50, 51, 100])
    assert 1 in choose_places(lat, lon, np.array([1, 0.9, 0.2, 1]), 3)
    assert 2 in choose_places(lat, lon, np.array([1, 0.2, 0.9, 1]), 3)


@pytest.mark.parametrize("capacity", [1, 2, 7])
def test_places_without_positions_are_thinned_along_their_order(capacity):
    nowhere = np.full(20, np.nan)
    kept = choose_places(nowhere, nowhere, np.ones(20), capacity)
    assert len(kept) == capacity
    if capacity > 2:
        assert np.diff(kept).max() <= 8
