"""`edgevpr map check` and `map repair`, and what `map build` and `map merge` leave behind when they fail."""

import json
import shutil

import pytest
from commands import expect_refusal, run_json
from full_disk import limit_file_size
from map_writer import write_sql
from pictures import draw_texture, write_flight

from edgevpr.cli.main import main
from edgevpr.places.mapfile import PlaceMap


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Six pictures with positions and times."""
    folder = tmp_path_factory.mktemp("flight")
    write_flight(folder / "images", [draw_texture(number, 240, 320) for number in range(6)], start_s=1.7e9)
    return folder


@pytest.fixture(scope="module")
def whole_valley(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "valley.gpkg"
    assert main(list_build_words(path, flight)) == 0
    return path


@pytest.fixture
def valley(whole_valley, tmp_path):
    return shutil.copy(whole_valley, tmp_path / whole_valley.name)


def list_build_words(path, flight):
    return ["map", "build", str(path), "--images", str(flight / "images"), "--technique", "cohog", "--param", "w1=208"]


DAMAGE = (
    "UPDATE places SET fine = zeroblob(length(fine)) WHERE place_id = 2",
    "UPDATE places SET heading_deg = 'north' WHERE place_id = 4",
)


def test_map_repair_leaves_an_intact_map_unchanged(valley, capsys):
    before = valley.read_bytes()
    assert main(["map", "check", str(valley)]) == 0
    said = capsys.readouterr()
    assert [line.split()[0] for line in said.out.splitlines()[1:]] == ["SQLite"]
    assert "checking  6/6  100 %" in said.err
    assert main(["map", "repair", str(valley)]) == 0
    assert "no damage" in capsys.readouterr().out
    assert run_json(capsys, "map", "repair", valley) == {"path": str(valley), "kept": 6, "dropped": 0, "original": None}
    assert valley.read_bytes() == before
    assert [entry.name for entry in valley.parent.iterdir()] == [valley.name]


def test_map_repair_drops_damaged_places_and_keeps_the_original(valley, capsys):
    write_sql(valley, *DAMAGE)
    before = valley.read_bytes()
    assert main(["map", "check", str(valley)]) == 1
    shown = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  damaged ")]
    assert ["heading_deg" in line for line in shown] == [False, True]
    assert main(["map", "check", str(valley), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["places"], found["is_whole"]) == (4, False)
    assert [number for number, _ in found["damaged"]] == [2, 4]
    assert [f"place {number}: {problem}" for number, problem in found["damaged"]] == [line[14:] for line in shown]

    assert main(["map", "repair", str(valley)]) == 0
    original = valley.with_name("valley.gpkg.damaged")
    said = capsys.readouterr()
    assert "2 removed" in said.out
    assert str(original) in said.out
    assert "copying  6/6  100 %" in said.err
    assert original.read_bytes() == before
    with PlaceMap.open(original) as damaged, PlaceMap.open(valley) as repaired:
        kept = list(repaired.read_places())
        assert [place.place_id for place in kept] == [1, 3, 5, 6], "the numbers stay"
        assert kept == list(damaged.read_places([1, 3, 5, 6]))
        for place in kept:
            assert (repaired.read_fine_part(place.place_id)[0] == damaged.read_fine_part(place.place_id)[0]).all()
        repaired.require_technique(damaged.spec)
    assert main(["map", "check", str(valley)]) == 0
    assert sorted(entry.name for entry in valley.parent.iterdir()) == [valley.name, original.name]
    write_sql(valley, "UPDATE places SET fine = x'00' WHERE place_id = 1")
    assert "exists already" in expect_refusal(capsys, "map", "repair", valley, code=1)
    assert original.read_bytes() == before


def test_map_repair_leaves_a_completely_unreadable_map_unchanged(valley, capsys):
    write_sql(valley, "UPDATE places SET coarse = x'00'")
    before = valley.read_bytes()
    assert "restore" in expect_refusal(capsys, "map", "repair", valley, code=1)
    assert valley.read_bytes() == before
    assert [entry.name for entry in valley.parent.iterdir()] == [valley.name]


def run_full(arguments, bytes_at_most):
    """Run a command on a disk that takes files of so many bytes at most."""
    with limit_file_size(bytes_at_most):
        return main(arguments)


@pytest.mark.parametrize("bytes_at_most", [1, 5_000, 45_000])
def test_map_build_leaves_no_empty_map_on_a_full_disk(flight, tmp_path, bytes_at_most, capsys):
    assert run_full(list_build_words(tmp_path / "m.gpkg", flight), bytes_at_most) == 1
    assert "Traceback" not in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_map_merge_and_repair_leave_no_part_on_a_full_disk(valley, tmp_path, capsys):
    out = tmp_path / "out" / "m.gpkg"
    out.parent.mkdir()
    for bytes_at_most in (1, 5_000, 60_000):
        assert run_full(["map", "merge", str(out), str(valley)], bytes_at_most) == 1
        assert not list(out.parent.iterdir())
    write_sql(valley, *DAMAGE)
    before = valley.read_bytes()
    for bytes_at_most in (1, 5_000, 45_000):
        assert run_full(["map", "repair", str(valley)], bytes_at_most) == 1
        assert "Traceback" not in capsys.readouterr().err
        assert valley.read_bytes() == before
        assert [entry.name for entry in tmp_path.glob("valley*")] == [valley.name]
    assert main(["map", "merge", str(out), str(valley)]) == 1, "it is damaged"
    assert not list(out.parent.iterdir())
