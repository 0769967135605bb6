"""Files that are no map, or a map that was tampered with: one sentence, no traceback, and reading always ends."""

import contextlib
import dataclasses
import os
import shutil
import subprocess
import sys

import map_writer
import numpy as np
import pytest
from map_writer import SPEC, frame, make_descriptor, make_map, write_sql

from edgevpr.core.errors import MapError, UsageError
from edgevpr.places.examine import check_places
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import describe_map
from edgevpr.places.rows import escape_name

PLACES = 40


@pytest.fixture(scope="module")
def valley(tmp_path_factory):
    return make_map(tmp_path_factory.mktemp("valley") / "valley.gpkg", PLACES)


@pytest.fixture
def map_path(valley, tmp_path):
    return shutil.copy(valley, tmp_path / valley.name)


@pytest.mark.parametrize("name", ["", "a\0b.gpkg", "\ud800.gpkg", "/"])
@pytest.mark.parametrize("use", [PlaceMap.open, PlaceMap.open_for_writing, lambda path: PlaceMap.create(path, SPEC)])
def test_place_map_refuses_an_invalid_file_name(use, name):
    with pytest.raises(UsageError):
        use(name)


def test_place_map_accepts_a_name_that_is_not_utf_8(tmp_path):
    path = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.gpkg")
    PlaceMap.create(path, SPEC).close()
    with PlaceMap.open(path) as place_map:
        assert len(place_map) == 0


@pytest.mark.parametrize("end", ["", "-wal", "-journal"])
@pytest.mark.parametrize("use", [PlaceMap.open, PlaceMap.open_for_writing])
def test_place_map_refuses_a_pipe_and_does_not_wait_for_it(map_path, use, end):
    path = map_path.with_name(map_path.name + end)
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    with pytest.raises(MapError, match=path.name):
        use(map_path)


ENDLESS = "WITH RECURSIVE n(place_id) AS (SELECT 1 UNION ALL SELECT place_id + 1 FROM n)"
COLUMNS = "geom, time, alt_m, heading_deg, source_image, quality, geom_crc32, coarse_crc32, fine_crc32, coarse, fine"
TAMPERED = {
    f"ALTER TABLE places RENAME TO old; CREATE VIEW places AS {ENDLESS} SELECT n.place_id, {COLUMNS} FROM n, old": (
        "not a place map"
    ),
    "DROP TABLE places; CREATE VIRTUAL TABLE places USING rtree(id, a, b)": "not a place map",
    "DROP TABLE places": "not a place map",
    "ALTER TABLE places RENAME COLUMN fine TO fein": "lacks required columns .fine.",
    "ALTER TABLE places DROP COLUMN fine; ALTER TABLE places ADD COLUMN fine AS (zeroblob(1000000000))": (
        "lacks required columns .fine."
    ),
    "ALTER TABLE places RENAME COLUMN geom_crc32 TO other": "lacks required columns .geom_crc32.",
    "DELETE FROM edgevpr_map": "edgevpr_map is damaged",
    "UPDATE edgevpr_map SET value = CAST(x'ff' AS TEXT) WHERE key = 'fine'": "edgevpr_map is damaged",
}
WRONG_VALUES = [
    ("format_version", '"2"'),
    ("technique", "[1]"),
    ("parameters", "7"),
    ("parameters", '{"seed": [1]}'),
    ("parameters", '{"seed": 1e999}'),
    ("coarse", "null"),
    ("fine", "[]"),
    ("fine", '{"shape": [9], "dtype": "O"}'),
    ("fine", '{"shape": [9], "dtype": "(2,"}'),
    ("fine", '{"shape": [-9], "dtype": "<f4"}'),
    ("fine", '{"shape": [1000000, 1000000], "dtype": "<f4"}'),
    ("fine", "[" * 100_000),
]
for _key, _value in WRONG_VALUES:
    TAMPERED[f"UPDATE edgevpr_map SET value = '{_value}' WHERE key = '{_key}'"] = "edgevpr_map is damaged"


@pytest.mark.parametrize(("change", "says"), TAMPERED.items(), ids=range(len(TAMPERED)))
def test_place_map_refuses_a_manipulated_map_in_one_sentence(map_path, change, says):
    write_sql(map_path, change)
    for use in (PlaceMap.open, PlaceMap.open_for_writing):
        with pytest.raises(MapError, match=says) as caught:
            use(map_path)
        assert len(str(caught.value)) < 1500


def test_describe_map_reports_what_is_readable(map_path):
    write_sql(
        map_path,
        "UPDATE gpkg_contents SET min_x = NULL, max_y = 'north'",
        "UPDATE places SET time = 1, footprint_m = 'wide'",
    )
    with PlaceMap.open(map_path) as place_map:
        info = describe_map(place_map)
    assert (info.places, info.extent, info.first_time) == (PLACES, None, None)


def test_place_map_reads_a_header_with_bits_flipped_or_refuses_it(map_path):
    rng, whole = np.random.default_rng(1), map_path.read_bytes()
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, 100, rng.integers(1, 4)):
            data[at] ^= 1 << int(rng.integers(8))
        map_path.write_bytes(data)
        # A file that is still a map is read; any other is a MapError, and nothing else.
        with contextlib.suppress(MapError), PlaceMap.open(map_path) as place_map:
            describe_map(place_map)
            for place_id, *_ in list(place_map.read_coarse_parts()):
                place_map.read_fine_part(place_id)


def test_check_places_misses_only_the_places_on_a_damaged_page(map_path):
    page_bytes, data, lost = 4096, map_path.read_bytes(), []
    for page in range(1, len(data) // page_bytes):
        damaged = bytearray(data)
        damaged[page * page_bytes : (page + 1) * page_bytes] = b"\xa5" * page_bytes
        map_path.write_bytes(damaged)
        try:
            with PlaceMap.open(map_path) as place_map:
                found = list(check_places(place_map))
        except MapError:
            continue  # a page that every map needs
        whole = [each for each in found if not each.problem]
        for each in whole:
            assert each.content["fine"] == make_descriptor(each.place_id - 1).fine.tobytes()
        lost.append(PLACES - len(whole))
        assert len(whole) + len([each for each in found if each.problem]) >= PLACES - 8 or not whole
    assert lost.count(1) > PLACES, "most pages hold a part of one place"
    assert sorted(lost)[len(lost) * 9 // 10] <= 8


def test_place_map_skips_a_place_with_too_large_a_value(map_path):
    if sys.version_info < (3, 11):
        pytest.skip("this Python cannot ask SQLite for it")
    write_sql(map_path, "UPDATE places SET source_image = CAST(zeroblob(300000) AS TEXT) WHERE place_id = 3")
    with PlaceMap.open(map_path) as place_map:
        assert [place_id for place_id, *_ in place_map.read_coarse_parts()] == [1, 2, *range(4, PLACES + 1)]
        assert list(place_map.left_out) == [3]


def test_place_map_keeps_a_place_whose_name_and_time_cannot_be_written(map_path):
    odd = dataclasses.replace(frame(41), name=os.fsdecode(b"\xff\xfe.jpg"), t_utc_s=1.7e12)
    later = dataclasses.replace(frame(42), name="\ud800.jpg", t_utc_s=1e308)
    with PlaceMap.open_for_writing(map_path) as place_map:
        for number, each in ((41, odd), (42, later)):
            place_map.add(each, make_descriptor(number))
            (place_id,) = place_map.select_ids("source_image")[(escape_name(each.name),)]
            assert place_map.has_descriptor(place_id, make_descriptor(number).coarse)
        *_, first, second = place_map.read_places()
    assert (first.source_image, first.t_utc_s) == ("\\udcff\\udcfe.jpg", None)
    assert (second.source_image, second.t_utc_s) == ("\\ud800.jpg", None)


def test_open_for_writing_admits_one_program_at_a_time(map_path):
    with PlaceMap.open_for_writing(map_path) as place_map:
        command = [sys.executable, map_writer.__file__, str(map_path), "1"]
        second = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert "MapBusyError" in second.stderr
        with PlaceMap.open(map_path) as reader:  # to look is allowed
            assert len(reader) == len(place_map) == PLACES
    with PlaceMap.open_for_writing(map_path) as again:
        again.add(frame(41), make_descriptor(41))


def test_open_for_writing_serves_the_triggers_of_a_spatial_index(map_path):
    write_sql(
        map_path,
        "CREATE TABLE boxes (x DOUBLE, y DOUBLE)",
        "CREATE TRIGGER indexed AFTER INSERT ON places WHEN NOT ST_IsEmpty(NEW.geom) BEGIN "
        "INSERT INTO boxes VALUES (ST_MinX(NEW.geom), ST_MaxY(NEW.geom)); END",
    )
    with PlaceMap.open_for_writing(map_path) as place_map:
        place_map.add(frame(41), make_descriptor(41))
        place_map.add(frame(45), make_descriptor(45))  # without a position
        assert place_map.db.execute("SELECT * FROM boxes").fetchall() == [(8.0, pytest.approx(50.0041))]
