"""The map file: what is confirmed is there, other tools read it, and a wrong map is refused with a reason."""

import contextlib
import dataclasses
import math
import re
import shutil

import numpy as np
import pytest
from map_writer import SPEC, frame, make_descriptor, make_map, write_sql

from edgevpr.core.contract import PartSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.geodesy import offset_position
from edgevpr.core.types import Position
from edgevpr.places.examine import merge_maps, repair_map, shrink_map
from edgevpr.places.geopackage import encode_point
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import connect
from edgevpr.places.mapinfo import describe_map, read_identity


@pytest.fixture(scope="module")
def valley(tmp_path_factory):
    return make_map(tmp_path_factory.mktemp("valley") / "valley.gpkg", 10)


@pytest.fixture
def map_path(valley, tmp_path):
    return shutil.copy(valley, tmp_path / valley.name)


def test_place_map_returns_what_was_added(map_path):
    with PlaceMap.open(map_path) as place_map:
        assert place_map.spec == SPEC
        for number, place in enumerate(list(place_map.read_places())):
            added = frame(number)
            assert place.source_image == added.name
            assert place.t_utc_s == pytest.approx(added.t_utc_s, abs=1e-3)
            assert place.heading_deg == added.heading_deg
            assert place.position == added.position
            np.testing.assert_array_equal(place_map.read_fine_part(place.place_id)[0], make_descriptor(number).fine)
        for number, (_, position, _, coarse) in enumerate(place_map.read_coarse_parts()):
            np.testing.assert_array_equal(coarse, make_descriptor(number).coarse)
            assert (position is None) == (frame(number).position is None)
        info = describe_map(place_map)
    assert (info.places, info.with_position) == (10, 8)
    np.testing.assert_allclose(info.extent, (50.0001, 8.0, 50.0009, 8.0))


def test_closed_map_is_one_file_for_a_read_only_card(map_path):
    assert [entry.name for entry in map_path.parent.iterdir()] == [map_path.name]
    card = map_path.parent / "card"
    card.mkdir()
    shutil.move(map_path, card / "map.gpkg")
    (card / "map.gpkg").chmod(0o444)
    card.chmod(0o555)
    with PlaceMap.open(card / "map.gpkg") as place_map:
        assert len(place_map) == 10


def test_gdal_reads_the_places(map_path):
    pyogrio = pytest.importorskip("pyogrio", reason="pyogrio (GDAL) is not installed")
    assert {name for name, _ in pyogrio.list_layers(map_path)} == {"places", "edgevpr_map"}
    meta, fids, geometry, fields = pyogrio.raw.read(map_path, layer="places", return_fids=True)
    assert meta["crs"] == "EPSG:4326"
    assert meta["geometry_type"] == "Point"
    columns = dict(zip(meta["fields"], fields, strict=True))
    assert list(fids) == list(range(1, 11))
    assert list(columns["source_image"]) == [frame(n).name for n in range(10)]
    assert columns["time"][3] == np.datetime64("2023-11-14T22:13:23.000")
    assert geometry[0] is None
    np.testing.assert_allclose(np.frombuffer(geometry[3][-16:], "<f8"), (8.0, 50.0003))
    np.testing.assert_array_equal(np.frombuffer(columns["coarse"][4], "<f2"), make_descriptor(4).coarse)


def test_add_asks_for_disk_space_if_sqlite_is_full(map_path):
    place_map = PlaceMap.open_for_writing(map_path)
    (pages,) = place_map.db.execute("PRAGMA page_count").fetchone()
    place_map.db.execute(f"PRAGMA max_page_count = {pages + 1}")
    with pytest.raises(MapError, match="disk"):
        [place_map.add(frame(number), make_descriptor(number)) for number in range(10, 20)]
    place_map.db.execute("PRAGMA max_page_count = 100000")
    place_map.add(frame(20), make_descriptor(20))  # room again: it goes on
    place_map.close()
    with PlaceMap.open(map_path) as again:
        assert len(again) >= 11


def test_require_technique_refuses_another_technique_or_parameter_by_name(map_path):
    with PlaceMap.open(map_path) as place_map:
        with pytest.raises(MapError, match="seed"):
            place_map.require_technique(dataclasses.replace(SPEC, parameters={"seed": 2}))
        with pytest.raises(MapError, match="hog"):
            place_map.require_technique(dataclasses.replace(SPEC, name="hog"))
        with pytest.raises(MapError, match="abc"):
            place_map.require_technique(dataclasses.replace(SPEC, model_sha256="abc"))
        with pytest.raises(MapError, match="12x12x8"):
            place_map.require_technique(dataclasses.replace(SPEC, coarse=PartSpec((12, 12, 8), "<f2")))
        place_map.require_technique(SPEC)


def test_open_reads_a_prerelease_map_and_refuses_another_format(map_path):
    for version, is_read in ((1, True), (4, True), (2, False), (5, False)):
        write_sql(map_path, f"UPDATE edgevpr_map SET value = '{version}' WHERE key = 'format_version'")
        with contextlib.nullcontext() if is_read else pytest.raises(MapError, match=f"format {version}"):
            PlaceMap.open(map_path).close()


def test_create_never_overwrites_an_existing_map(map_path):
    before = map_path.read_bytes()
    with pytest.raises(MapError, match="exists already"):
        PlaceMap.create(map_path, SPEC)
    assert map_path.read_bytes() == before


def test_merge_maps_copies_new_places_and_refuses_other_techniques(map_path, tmp_path):
    with PlaceMap.create(tmp_path / "other.gpkg", SPEC) as other:
        for number in (8, 9, 10, 11):
            other.add(frame(number), make_descriptor(number))
    assert merge_maps([map_path, other.path], tmp_path / "both.gpkg") == ([(10, 0), (2, 2)], False)
    with PlaceMap.open(tmp_path / "both.gpkg") as both:
        assert len(both) == 12
        assert describe_map(both).extent[2] == pytest.approx(50.0011)
        np.testing.assert_array_equal(both.read_fine_part(12)[0], make_descriptor(11).fine)
    with PlaceMap.create(tmp_path / "third.gpkg", dataclasses.replace(SPEC, parameters={"seed": 3})) as third:
        pass
    with pytest.raises(MapError, match="seed"):
        merge_maps([third.path, map_path], tmp_path / "none.gpkg")
    assert not (tmp_path / "none.gpkg").exists()


@pytest.mark.parametrize("value", ["''", "'7'", "'null'", "'{'", f"'{'[' * 100_000}'", "x'ff'"], ids=range(6))
def test_open_tolerates_damaged_metadata(map_path, value):
    with PlaceMap.open_for_writing(map_path) as place_map:
        assert (place_map.mask_sha256, place_map.calibration) == (None, None)
        place_map.record_mask("m")
        place_map.record_calibration("how sure")
        place_map.add(frame(30), make_descriptor(30))
        assert place_map.calibration is None, "it does not know the new place"
        place_map.record_calibration("how sure")
    with PlaceMap.open(map_path) as place_map:
        assert (place_map.mask_sha256, place_map.calibration) == ("m", "how sure")
    write_sql(map_path, f"UPDATE edgevpr_map SET value = {value} WHERE key IN ('mask_sha256', 'calibration')")
    with PlaceMap.open(map_path) as place_map:
        assert (place_map.mask_sha256, place_map.calibration) == (None, None)
        assert len(list(place_map.read_places())) == 11


def test_repair_map_keeps_place_ids_and_metadata(map_path, tmp_path):
    with PlaceMap.open_for_writing(map_path) as place_map:
        place_map.record_mask("m")
        place_map.record_lens("/camera/lens.yaml")
        place_map.record_calibration("how sure")
        for owner in ("Survey X", None, "City Y", "Survey X"):
            place_map.add_attribution(owner)
    assert shrink_map(map_path, tmp_path / "small.gpkg", 4) == 4
    write_sql(map_path, "UPDATE places SET coarse = x'00' WHERE place_id = 2")
    repair_map(map_path)
    with PlaceMap.open(map_path) as repaired, PlaceMap.open(tmp_path / "small.gpkg") as small:
        for each in (repaired, small):
            assert (each.mask_sha256, each.lens, each.calibration) == ("m", "lens.yaml", "how sure")
            assert each.attribution == "Survey X; City Y"
            for place in each.read_places():
                assert place.source_image == f"{place.place_id - 1:05d}.jpg"
        assert len(repaired) == 9


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("geom = x'4750000100'", "geometry"),
        ("geom_crc32 = geom_crc32 + 1", "position .*checksum"),
        (f"geom = x'{encode_point(50.0, 8.0).hex().replace('e6100000', '110f0000')}'", " 3857"),
        (f"coarse = x'{'00' * 126}007c', coarse_crc32 = NULL", "coarse part .*finite"),
        (f"coarse = x'{'00' * 128}'", "coarse part .*checksum"),
        ("coarse = x'00'", "coarse part .*size"),
        ("coarse = 1e18", "coarse part .*size"),
        ("heading_deg = 'north'", "its heading_deg is 'north'"),
        ("alt_m = 9e999", "its alt_m is inf"),
        ("alt_m = 1e18", "its alt_m is 1e[+]18"),
        ("quality = 1.5", "quality is 1.5"),
        ("source_image = CAST('a.jpg' AS BLOB)", "source_image"),
        ("source_image = CAST(x'ff41' AS TEXT)", "source_image"),
    ],
)
def test_open_names_what_another_program_has_damaged(map_path, change, says):
    write_sql(map_path, f"UPDATE places SET {change} WHERE place_id = 3")
    with PlaceMap.open(map_path) as place_map:
        assert [place_id for place_id, *_ in place_map.read_coarse_parts()] == [1, 2, *range(4, 11)]
        assert list(place_map.left_out) == [3]
        assert re.search(says, place_map.left_out[3])
        if "coarse" not in change:
            with pytest.raises(PlaceError, match=f"place 3 .*{says}"):
                list(place_map.read_places())


def test_read_places_treats_a_time_in_another_format_as_unknown(map_path):
    write_sql(map_path, "UPDATE places SET time = '2016/06/23 10:00'")
    with PlaceMap.open(map_path) as place_map:
        assert {place.t_utc_s for place in place_map.read_places()} == {None}


def test_has_descriptor_tolerates_last_bits_but_not_another_image(map_path):
    rng = np.random.default_rng(4)
    with PlaceMap.open(map_path) as place_map:
        ids = [place_id for found in place_map.select_ids("source_image").values() for place_id in found]
        for place_id in ids:
            coarse = next(part for number, _, _, part in place_map.read_coarse_parts() if number == place_id)
            for off, same in ((0.0, True), (1e-4, True), (0.5, False)):
                direction = rng.normal(0, 1, coarse.shape)
                other = coarse + off * np.linalg.norm(coarse) * direction / np.linalg.norm(direction)
                assert place_map.has_descriptor(place_id, other) is same
        assert not place_map.has_descriptor(10**6, coarse)


def test_has_descriptor_tolerates_a_few_different_bytes(tmp_path):
    spec = dataclasses.replace(SPEC, coarse=PartSpec((100,), "|u1"), packed=None)
    there = np.random.default_rng(1).integers(0, 256, 100, np.uint8)
    with PlaceMap.create(tmp_path / "bytes.gpkg", spec) as place_map:
        place_id = place_map.add(frame(1), dataclasses.replace(make_descriptor(1), coarse=there))
        for others, same in ((0, True), (3, True), (30, False)):
            again = there.copy()
            again[:others] += 128
            assert place_map.has_descriptor(place_id, again) is same


def test_merge_maps_keeps_all_attributions(tmp_path):
    paths = [tmp_path / f"{owner}.gpkg" for owner in ("Y", "None", "X")]
    for path in paths:
        with PlaceMap.create(path, SPEC) as place_map:
            assert place_map.attribution is None
            place_map.add_attribution(None if path.stem == "None" else path.stem)
    merge_maps(list(map(str, paths)), tmp_path / "all.gpkg")
    with PlaceMap.open(tmp_path / "all.gpkg") as merged:
        assert merged.attribution == "Y; X"


def identity(map_path):
    with PlaceMap.open(map_path) as place_map:
        return read_identity(place_map)


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE places SET quality = 0.5 WHERE place_id = 2",
        "UPDATE places SET fine_crc32 = fine_crc32 + 1 WHERE place_id = 2",
        "UPDATE places SET up_deg = 3.0 WHERE place_id = 2",
        "UPDATE places SET source_image = 'other' WHERE place_id = 2",
        "UPDATE places SET geom = (SELECT geom FROM places WHERE place_id = 3) WHERE place_id = 2",
        "INSERT INTO edgevpr_map (key, value) VALUES ('calibration', '\"0\"')",
        "UPDATE places SET place_id = 90 WHERE place_id = 10",
    ],
)
def test_read_identity_is_equal_for_a_copy_until_a_change(map_path, tmp_path, change):
    before = identity(map_path)
    assert identity(shutil.copy(map_path, tmp_path / "copy.gpkg")) == before
    assert (before["places"], len(before["map_id"])) == (10, 32)
    with contextlib.closing(connect(map_path, "rw")) as db:
        db.execute(change)
    assert identity(map_path)["sha256"] != before["sha256"]


@pytest.mark.parametrize(
    ("courses_deg", "one_way_deg"),
    [([90.0] * 4, 90.0), ([90.0, 270.0] * 2, None), ([0.0, 90.0, 180.0, 270.0], None), ([80.0, 100.0] * 2, 90.0)],
)
@pytest.mark.parametrize(("has_times", "repeats"), [(True, 1), (False, 1), (False, 3)])
def test_describe_map_reports_the_course_of_a_map_flown_in_one_direction(
    tmp_path, courses_deg, one_way_deg, has_times, repeats
):
    spec = dataclasses.replace(SPEC, parameters={"camera": "nadir"})
    with PlaceMap.create(tmp_path / "map.gpkg", spec) as place_map:
        for line, course_deg in enumerate(courses_deg):
            for nth in range(8 * repeats):
                step_m = 20.0 * (nth // repeats) * np.exp(1j * math.radians(90.0 - course_deg)) + 40j * line
                lat_deg, lon_deg = offset_position(50.0, 8.0, step_m.real, step_m.imag)
                # The way back to the next line is flown without pictures. The first picture has no time.
                taken_s = 1.7e9 + 60.0 * line + nth if has_times and (line, nth) > (0, 0) else None
                added = dataclasses.replace(frame(nth), position=Position(lat_deg, lon_deg), t_utc_s=taken_s)
                place_map.add(dataclasses.replace(added, name=f"{line}-{nth}"), make_descriptor(nth % 8))
        info = describe_map(place_map)
    assert info.one_way_deg == (None if one_way_deg is None else pytest.approx(one_way_deg, abs=1.0))
