"""Several flights over the same generated ground: what becomes one place, what fades, and what has changed."""

import numpy as np
import pyogrio
import pytest
from overflown import DAY_S, FOOTPRINT_M, FOV_DEG, fly, ground

from edgevpr.core.config import load_config
from edgevpr.core.geodesy import distance_m
from edgevpr.mapmaking.making import FlownPictures, MapOrder, make_map
from edgevpr.mapmaking.passes import FADES_AFTER, SPOT, read_history
from edgevpr.places.examine import check, select
from edgevpr.places.history import drop_places, read_counts, write_history
from edgevpr.places.mapfile import PlaceMap

pytestmark = pytest.mark.slow

START_S = 1_700_000_000.0
SAME, OTHER = [ground(1)] * 4, [*[ground(1)] * 3, ground(2)]  # at the last spot other ground
CONFIG = {"source.fov_deg": FOV_DEG, "source.camera": "nadir"}


def flown(folder, *flights, days=True):
    """Fly over each of the grounds, a day after the one before; return the folder of each picture by its name."""
    folders = {}
    for number, grounds in enumerate(flights):
        fly(folder, grounds, number, START_S + number * DAY_S if days else None)
        folders |= {f"{number}{spot}.png": f"/of/flight{number}" for spot in range(4)}
    return folders


def named(names):
    """Choose the places of pictures with these names."""
    return lambda place_map: {place.place_id for place in place_map.places() if place.source_image in names}


def compared(tmp_path, folders, inside=None, camera="nadir"):
    """Make a map of the pictures, compare its passes, and write what is left as the fleet does."""
    config, path = load_config(None, CONFIG | {"source.camera": camera}), tmp_path / "all.gpkg"
    order = MapOrder(
        path=str(path),
        pictures=FlownPictures(source=str(tmp_path / "p")),
        technique="cohog",
        parameters={"camera": camera},
        refine=False,
        calibrate=False,
    )
    make_map(order, config, print, lambda items, *_: items)
    history = read_history(path, order.pictures, config, folders, named(folders if inside is None else inside))
    out = tmp_path / "m.gpkg"
    select(path, out, named(folders.keys() - history.removed.keys()))
    with PlaceMap.open_for_adding(out) as place_map:
        write_history(place_map, history)
    return history, out


def left(path):
    """The pictures of the places of a map."""
    with PlaceMap.open(path) as place_map:
        return sorted(place.source_image for place in place_map.places())


def spots(names):
    """The numbers of the spots of pictures."""
    return sorted(name[-5] for name in names)


def require_near(path, history):
    """Every place is part of one whose picture shows the same spot."""
    with PlaceMap.open(path) as place_map:
        places = list(place_map.places())
    position = {each: place.position for place in places for each in (place.place_id, place.source_image)}
    for name, place_id in history.removed.items():
        one, other = position[name], position[place_id]
        assert distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg) < SPOT * FOOTPRINT_M


def test_the_same_ground_becomes_one_place_and_what_is_left_is_as_it_was(tmp_path):
    folders = flown(tmp_path / "p", SAME, SAME, SAME)
    history, path = compared(tmp_path, folders)
    assert spots(left(path)) == list("0123")
    assert ([each.name for each in history.passes], history.changes) == (["flight0", "flight1", "flight2"], ())
    assert check(path).is_whole
    with PlaceMap.open(tmp_path / "all.gpkg") as whole, PlaceMap.open(path) as kept:
        places = {place.place_id: place for place in whole.places()}
        assert all(places[place.place_id] == place for place in kept.places())
        kept_ids = {place.place_id for place in kept.places()}
    assert {*history.removed.values()} <= kept_ids
    require_near(tmp_path / "all.gpkg", history)
    pictures = FlownPictures(source=str(tmp_path / "p"))
    assert read_history(tmp_path / "all.gpkg", pictures, load_config(None, CONFIG), folders, named(folders)) == history


def test_changed_ground_stays_with_both_its_places_and_is_shown_as_a_layer(tmp_path):
    history, path = compared(tmp_path, flown(tmp_path / "p", SAME, SAME, OTHER, OTHER))
    assert spots(left(path)) == list("01233")
    (change,) = history.changes
    assert (change.from_image, change.to_image) == ("13.png", "23.png")
    info = pyogrio.read_info(path, layer="changes")
    assert (info["geometry_type"], info["crs"], info["features"]) == ("Point", "EPSG:4326", 1)
    assert info["total_bounds"] == pytest.approx([change.position.lon_deg, change.position.lat_deg] * 2, abs=1e-9)
    meta, _, geometry, columns = pyogrio.raw.read(path, layer="changes")
    row = {name: column[0] for name, column in zip(meta["fields"], columns, strict=True)}
    assert row["from_time"] == np.datetime64(round(1000 * (START_S + DAY_S + 15)), "ms")
    assert row["to_time"] == np.datetime64(round(1000 * (START_S + 2 * DAY_S + 15)), "ms")
    assert (row["from_image"], row["to_image"]) == ("13.png", "23.png")
    assert 0 <= row["confidence"] < 0.9
    assert len(geometry) == 1


def test_what_nobody_finds_again_fades_after_so_many_flights_and_the_newer_places_stay(tmp_path):
    for count, spots_left in ((FADES_AFTER - 1, "01233"), (FADES_AFTER, "0123")):
        folder = tmp_path / str(count)
        history, path = compared(folder, flown(folder / "p", OTHER, *[SAME] * count))
        assert spots(left(path)) == list(spots_left)
        faded = [name for name, part_of in history.removed.items() if part_of is None]
        assert faded == (["03.png"] if count == FADES_AFTER else [])


@pytest.mark.parametrize(("pause_s", "passes", "places"), [(600.0, 0, 8), (4 * 3600.0, 2, 4)])
def test_one_flight_is_not_compared_and_a_pause_of_hours_makes_two(tmp_path, pause_s, passes, places):
    fly(tmp_path / "p", SAME, 0, START_S)
    fly(tmp_path / "p", SAME, 1, START_S + pause_s)
    _, path = compared(tmp_path, {f"{seed}{spot}.png": "/card" for seed in range(2) for spot in range(4)})
    assert len(left(path)) == places
    with PlaceMap.open(path) as place_map:
        assert (read_counts(place_map).get("passes", 0), len(drop_places(place_map))) == (passes, 8 - places)


def test_only_places_inside_are_judged_and_those_around_are_asked(tmp_path):
    folders = flown(tmp_path / "p", SAME, SAME)
    inside = {"00.png", "10.png", "01.png"}
    history, _ = compared(tmp_path, folders, inside)
    (name,) = history.removed
    assert name in ("00.png", "10.png")
