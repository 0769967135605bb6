"""Some dozen maps damaged from a seed: the short form of `benchmarks/hostile_maps.py`."""

import sqlite3
from contextlib import closing

import hostile_maps
import pytest
from hostile_maps import KINDS, damaged_maps, make_whole_map, run


def test_no_damaged_map_gives_a_traceback_or_a_wrong_position_or_loses_a_place():
    rows = run(4 * len(KINDS), seed=11)
    assert [row.kind for row in rows] == list(KINDS)
    for row in rows:
        assert (row.tried, row.tracebacks, row.wrong_positions, row.places_lost) == (4, 0, 0, 0), row.kind


def test_the_same_seed_damages_in_the_same_way_and_another_in_another(tmp_path):
    whole = make_whole_map(tmp_path / "whole.gpkg")

    def damaged(name, seed):
        (tmp_path / name).mkdir()
        return [(kind, path.read_bytes()) for kind, path in damaged_maps(tmp_path / name, whole, len(KINDS), seed)]

    once = damaged("once", 1)
    again, other = damaged("again", 1), damaged("other", 2)
    assert [kind for kind, _ in once] == list(KINDS)
    # Files that SQLite writes have a count of changes that depends on nothing else.
    assert once == again
    assert sum(one != two for one, two in zip(once, other, strict=True)) > len(KINDS) // 2
    assert all(data != whole.read_bytes() for _, data in once)


def test_a_map_that_says_a_wrong_position_is_seen(tmp_path, monkeypatch):
    """The generator itself must be able to find something: without checksums it does."""
    monkeypatch.setattr("edgevpr.places.rows._hold", lambda blob, checksum, name: None)
    monkeypatch.setattr(hostile_maps, "KINDS", {"bits of a position flipped": KINDS["bits of a position flipped"]})
    (found,) = run(2, seed=1)
    assert found.wrong_positions > 0


@pytest.mark.parametrize("kind", ["cut", "pages overwritten"])
def test_what_is_damaged_is_damaged(tmp_path, kind):
    whole = make_whole_map(tmp_path / "whole.gpkg")
    (path,) = [path for each, path in damaged_maps(tmp_path, whole, len(KINDS), 5) if each == kind]
    with closing(sqlite3.connect(path)) as db, pytest.raises((sqlite3.DatabaseError, AssertionError)):
        assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
