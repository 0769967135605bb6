"""An index that grows in flight: within its budget, with its best places, and no different from one loaded afresh."""

import tracemalloc

import numpy as np
import pytest
from ranking import rank

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec, TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.core.types import Frame, Position
from edgevpr.places.index import GrowingIndex, best_places, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap


class Signs:
    """Packs as cohog does, simply: the sign of what a place has more of than the mean of the map."""

    spec = TechniqueSpec(
        name="signs",
        parameters={},
        coarse=PartSpec((256,), "<f4"),
        fine=None,
        model_sha256=None,
        packed=PartSpec((256,), "<i1"),
    )
    candidates = 5
    min_score = min_margin = 0.0

    def pack(self, coarse, mean):
        return np.where(coarse > mean, 1, -1).astype("<i1")

    def coarse_scores(self, query, rows, mean):
        asked = self.pack(query.coarse, mean)
        return (rows @ asked.astype(np.float32) / 256).astype(np.float32), None

    def match(self, query, fine, hypotheses):
        return FineMatch(0.0)


def descriptor(number, quality=1.0):
    # A strong common part: without the mean, all signs would be alike.
    return Descriptor(coarse=5 + np.random.default_rng(number).random(256, np.float32), quality=quality)


def learn(place_map, growing, numbers, quality=lambda number: 1.0):
    for number in numbers:
        position = Position(50.0 + number * 1e-4, 8.0) if number % 7 else None
        made = descriptor(number, quality(number))
        place_id = place_map.add(
            Frame(image=np.zeros((1, 1)), name=f"{number}", t_mono_s=0.0, t_utc_s=None, position=position), made
        )
        growing.add(place_id, position, made.coarse)


def grow(place_map, budget_bytes=10**6, room=2000):
    return GrowingIndex(place_map=place_map, technique=Signs(), budget_bytes=budget_bytes, room=room)


@pytest.fixture
def empty_map(tmp_path):
    with PlaceMap.create(tmp_path / "m.gpkg", Signs.spec) as place_map:
        yield place_map


def assert_same(index, fresh):
    for name in ("place_ids", "lat_deg", "lon_deg", "heading_deg", "rows", "mean"):
        np.testing.assert_array_equal(getattr(index, name), getattr(fresh, name))


def assert_packed_alike(index, parts):
    """Every row is packed by the mean that the index has."""
    for slot, place_id in enumerate(index.place_ids.tolist()):
        np.testing.assert_array_equal(index.rows[slot], Signs().pack(parts[place_id], index.mean))


def test_an_index_that_began_empty_is_what_a_fresh_load_gives_whenever_it_has_doubled(empty_map):
    growing = grow(empty_map)
    assert len(growing.index) == 0
    learn(empty_map, growing, range(127))
    fresh = load_index(empty_map, Signs(), 10**6)
    assert not np.array_equal(growing.index.mean, fresh.mean), "the mean of 64 places until there are 128"
    learn(empty_map, growing, [127])
    fresh = load_index(empty_map, Signs(), 10**6)
    assert_same(growing.index, fresh)
    for number in (0, 64, 127):
        ours = rank(Signs(), descriptor(number), empty_map, growing.index)
        theirs = rank(Signs(), descriptor(number), empty_map, fresh)
        assert ours.slots[0] == theirs.slots[0] == number
        np.testing.assert_array_equal(ours.scores, theirs.scores)


@pytest.mark.slow
def test_the_budget_holds_at_every_moment_of_growing(empty_map):
    places = 2048  # all are packed anew at the last of them
    each = bytes_per_place(Signs.spec)
    tracemalloc.start()
    growing = grow(empty_map, places * each, room=10**6)
    empty_map.db.execute("PRAGMA synchronous = OFF")  # two thousand syncs would only take time
    learn(empty_map, growing, range(places - 1))
    tracemalloc.reset_peak()
    learn(empty_map, growing, range(places - 1, places + 10))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(growing.index) == places, "what comes later is in the file only"
    assert len(empty_map) == places + 10
    assert growing.index.nbytes <= places * each
    # Packing takes the ids once more; a second copy of the rows would not fit under this.
    assert peak_bytes < places * each + 80 * places + 200_000


def test_a_map_larger_than_the_budget_begins_with_its_best_places_and_keeps_them(empty_map):
    learn(empty_map, grow(empty_map), range(60))
    growing = grow(empty_map, 20 * bytes_per_place(Signs.spec), room=100)
    fresh = load_index(empty_map, Signs(), 20 * bytes_per_place(Signs.spec))
    assert_same(growing.index, fresh)
    learn(empty_map, growing, range(60, 130))  # its mean is that of 120 places by then
    np.testing.assert_array_equal(growing.index.place_ids, fresh.place_ids)
    assert not np.array_equal(growing.index.mean, fresh.mean)
    assert_packed_alike(growing.index, {place_id: part for place_id, *_, part in empty_map.coarse_parts()})


def test_a_file_that_fails_while_all_is_packed_anew_leaves_rows_of_one_mean(empty_map, monkeypatch):
    growing = grow(empty_map)
    empty_map.db.execute("PRAGMA synchronous = OFF")
    learn(empty_map, growing, range(1023))
    parts = {place_id: part for place_id, *_, part in empty_map.coarse_parts()}
    parts[1024] = descriptor(1023).coarse
    mean, read = growing.index.mean, PlaceMap.coarse_parts

    def card_is_pulled(place_map):
        for count, part in enumerate(read(place_map)):
            if count == 600:  # the mean has been read, and half of the places
                raise MapError("the card is gone")
            yield part

    monkeypatch.setattr(PlaceMap, "coarse_parts", card_is_pulled)
    with pytest.raises(MapError, match="gone"):
        learn(empty_map, growing, [1023])
    assert 500 < len(growing.index) < 600
    assert not np.array_equal(growing.index.mean, mean)
    assert_packed_alike(growing.index, parts)


def test_a_place_damaged_since_it_was_read_is_left_out_when_all_is_packed_anew(empty_map):
    growing = grow(empty_map)
    learn(empty_map, growing, range(15))
    parts = {place_id: part for place_id, *_, part in empty_map.coarse_parts()}
    parts[16] = descriptor(15).coarse
    empty_map.db.execute("UPDATE places SET coarse = x'00' WHERE place_id = 3")
    assert not empty_map.left_out
    learn(empty_map, growing, [15])
    assert empty_map.left_out == {3: "its coarse part has a wrong size"}
    assert growing.index.place_ids.tolist() == [1, 2, *range(4, 17)]
    assert_packed_alike(growing.index, parts)
    assert growing.index.lat_deg[2] == pytest.approx(50.0003), "what stays has its own position"
    again = grow(empty_map)
    assert_same(again.index, growing.index)
    learn(empty_map, again, [16])
    assert again.index.place_ids.tolist() == [1, 2, *range(4, 18)]


def track(east_m):
    lon_deg = np.asarray(east_m, float) / 111_195
    return np.zeros(len(lon_deg)), lon_deg


def test_gaps_stay_even_however_densely_a_stretch_was_mapped():
    crowded = np.concatenate((np.arange(0, 100, 10), 100 + np.arange(0, 10, 0.1), np.arange(120, 220, 10)))
    lat, lon = track(crowded)
    kept = best_places(lat, lon, np.ones(len(crowded)), 22)
    gaps = np.diff(crowded[kept])
    assert len(kept) == 22
    assert gaps.max() <= 21
    assert gaps.min() > 4


def test_of_two_places_side_by_side_the_one_that_says_more_stays():
    lat, lon = track([0, 50, 51, 100])
    assert 1 in best_places(lat, lon, np.array([1, 0.9, 0.2, 1]), 3)
    assert 2 in best_places(lat, lon, np.array([1, 0.2, 0.9, 1]), 3)


@pytest.mark.parametrize("capacity", [1, 2, 7])
def test_places_without_positions_are_thinned_along_their_order(capacity):
    nowhere = np.full(20, np.nan)
    kept = best_places(nowhere, nowhere, np.ones(20), capacity)
    assert len(kept) == capacity
    if capacity > 2:
        assert np.diff(kept).max() <= 8


def test_nearest_m_measures_over_the_date_line_and_passes_over_places_left_out(empty_map):
    growing = grow(empty_map)
    assert growing.nearest_m(Position(0.0, 0.0)) == np.inf
    for place_id, lon_deg in enumerate((179.99999, 170.0), start=1):
        frame = Frame(image=np.zeros((1, 1)), name="a", t_mono_s=0.0, position=Position(0.0, lon_deg))
        empty_map.add(frame, descriptor(place_id))
        growing.add(place_id, frame.position, descriptor(place_id).coarse)
    assert growing.nearest_m(Position(0.0, -179.99999)) == pytest.approx(2.22, abs=0.01)
    empty_map.left_out[1] = "gone"
    assert growing.nearest_m(Position(0.0, 179.99999)) > 1e6
