"""A map file that cannot be read in flight: locked, gone, replaced. Every query is refused with the reason and none
waits; as soon as the file is whole again it is used again."""

import os
import shutil
import sqlite3
from functools import partial

import pytest
from flights import PLACES, fly_acts, noop, select
from map_writer import write_sql

from edgevpr.places.geopackage import encode_point
from edgevpr.places.mapfile import PlaceMap

ANNOUNCED = [(4, "edgevpr: map cannot be read, see the log"), (6, "edgevpr: map can be read again")]


@pytest.mark.slow
def test_locked_map_refuses_queries_until_it_is_free(place_map, tmp_path, monkeypatch):
    other, waits_ms = sqlite3.connect(place_map, isolation_level=None), []  # of another program
    lock = partial(other.execute, "BEGIN EXCLUSIVE")

    def look():
        waits_ms.append(maps[-1].db.execute("PRAGMA busy_timeout").fetchone()[0])

    maps, opened = [], PlaceMap.open
    monkeypatch.setattr(PlaceMap, "open", lambda path: maps.append(opened(path)) or maps[-1])
    queries, lines, flight = fly_acts(place_map, tmp_path / "log", [look, lock, *[noop] * 8, other.close, look, look])
    assert waits_ms == [50, 50, 50], "no query waits for longer, also when the file has been opened anew"
    assert [line["accepted"] for line in queries] == [True, *[False] * 9, True, True, True]
    assert all(line["reason"]["code"] == "MAP_UNREADABLE" for line in queries[1:10])
    assert flight.link.texts() == ANNOUNCED
    assert [line["note"]["code"] for line in select(lines, "map")] == ["MAP_LOST", "MAP_BACK"]
    assert flight.end["left_out"] == 0


@pytest.mark.parametrize("technique", ["cohog", "hog"])
@pytest.mark.parametrize("how", ["deleted", "truncated", "emptied", "noise", "a pipe", "a folder"])
def test_missing_map_refuses_queries_until_it_is_back(recording, tmp_path, technique, how):
    place_map = tmp_path / "m.gpkg"
    shutil.copy(recording / f"{technique}.gpkg", place_map)
    whole = place_map.read_bytes()

    def lose():
        if how == "deleted":
            place_map.unlink()
        elif how == "truncated":
            place_map.write_bytes(whole[: len(whole) // 2])
        elif how == "emptied":
            place_map.write_bytes(b"")
        elif how == "noise":
            place_map.write_bytes(bytes(range(256)) * (len(whole) // 256))
        else:
            place_map.unlink()
            os.mkfifo(place_map) if how == "a pipe" else place_map.mkdir()

    def restore():
        if place_map.is_dir():
            place_map.rmdir()
        elif how == "a pipe":
            place_map.unlink()
        place_map.write_bytes(whole)

    queries, _, flight = fly_acts(place_map, tmp_path / "log", [noop, lose, noop, noop, restore, noop])
    assert [line["accepted"] for line in queries] == [True, False, False, False, True, True], queries[-1]["reason"]
    assert all(line["reason"]["code"] == "MAP_UNREADABLE" for line in queries[1:4])
    assert flight.link.texts() == ANNOUNCED
    assert flight.end["left_out"] == 0, "no place is lost for good with the file"


@pytest.mark.parametrize("technique", ["cohog", "hog"])
@pytest.mark.parametrize("by", ["copying", "renaming"])
def test_replaced_map_is_refused_and_reported_once(recording, tmp_path, technique, by, caplog):
    """The same pictures, so that every place is found; but the positions are others."""
    place_map, other = tmp_path / "m.gpkg", tmp_path / "other.gpkg"
    shutil.copy(recording / f"{technique}.gpkg", place_map)
    shutil.copy(place_map, other)
    for place in range(1, PLACES + 1):
        write_sql(other, f"UPDATE places SET geom = x'{encode_point(10.0, place).hex()}' WHERE place_id = {place}")
    write_sql(other, "UPDATE edgevpr_map SET value = '\"another\"' WHERE key = 'map_id'")

    def replace():
        if by == "copying":
            place_map.write_bytes(other.read_bytes())
        else:
            other.rename(place_map)

    queries, _, flight = fly_acts(place_map, tmp_path / "log", [noop, replace, *[noop] * 4])
    assert [line["accepted"] for line in queries] == [True, *[False] * 5]
    assert all(line["reason"]["code"] == "MAP_UNREADABLE" for line in queries[1:])
    assert flight.link.texts() == ANNOUNCED[:1]
    assert len([each for each in caplog.records if "another map" in each.message]) == 1
