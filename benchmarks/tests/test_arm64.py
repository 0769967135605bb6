"""edgevpr on an emulated ARM board: what needs no emulator."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import on_arm64
import pytest
from arm64 import compare
from base import REPOSITORY


def test_without_its_tools_a_sentence_says_what_to_install():
    argv, env = [sys.executable, on_arm64.__file__], {**os.environ, "PATH": "", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(argv, env=env, capture_output=True, text=True)
    assert (done.returncode, done.stderr.partition(":")[0]) == (1, "on_arm64")
    assert "qemu-user-static" in done.stderr


def test_the_core_is_there():
    files = on_arm64.core_files(REPOSITORY)
    assert len(files) == len(set(files)) > 30
    assert all((REPOSITORY / name).exists() for name in (*on_arm64.CORE, *files))


def test_the_tests_of_a_file_are_counted(tmp_path):
    (tmp_path / "test_a.py").write_text(
        "import pytest\n"
        "def test_right(): pass\n"
        "def test_wrong(): assert False\n"
        "def test_skipped(): pytest.skip('no camera')\n"
        "def test_error(none_such): pass\n"
    )
    (tmp_path / "test_b.py").write_text("import os\ndef test_crash(): os.abort()\n")
    found, crashed = (
        on_arm64.run_tests(Path(sys.executable), tmp_path, f"test_{x}.py", dict(os.environ)) for x in "ab"
    )
    assert (found["passed"], found["failed"]) == (1, ["test_a.test_wrong", "test_a.test_error"])
    assert found["skipped"] == {"test_a.test_skipped": "no camera"}
    assert (crashed["passed"], len(crashed["failed"])) == (0, 1)


def test_two_maps_of_the_same_pictures(tmp_path):
    paths = []
    for number, fine in enumerate(([1, 2, 3, 4], [1, 2, 5, 4])):
        paths.append(tmp_path / f"{number}.gpkg")
        with sqlite3.connect(paths[-1]) as database:
            database.execute("CREATE TABLE places (place_id, coarse, fine)")
            words = np.array([1023, 7], "<u2").tobytes()
            for place, last in ((2, bytes(fine)), (1, bytes(4))):
                database.execute("INSERT INTO places VALUES (?, ?, ?)", (place, words, last))
    assert compare.maps_row(*paths, "nadir", "fine") == {"numbers": 8, "differ": 1, "most": 2}
    assert compare.maps_row(*paths, "nadir", "coarse") == {"numbers": 4, "differ": 0, "most": 0}


def told(place: int, accepted: bool, lat_deg: float | None, reason: str = "x") -> dict:
    where = {"lat_deg": lat_deg, "lon_deg": 8.0} if lat_deg else None
    position = {"lat_deg": 51.0, "lon_deg": 8.0}
    seen = {"score": place / 10, "confidence": None, "position": position, "located": where}
    return {"place": place, "accepted": accepted, "reason": reason, **seen}


def test_two_flights_of_the_same_pictures():
    one = [told(1, True, 50.0), told(2, True, 50.0), told(3, False, None)]
    other = [told(1, True, 50.0 + 1e-8), told(2, False, None), told(5, False, None, "y")]
    row = compare.flights_row(one, other)
    names = ("queries", "accepted", "other_decision", "other_words", "other_place", "other_refused")
    assert [row[name] for name in names] == [3, 2, 1, 1, 0, 1]
    assert (row["score"], row["located_mm"]) == (pytest.approx(0.2), pytest.approx(1.11, abs=0.01))
    row = compare.flights_row([told(1, True, 50.0)], [told(2, False, None)])
    assert (row["other_decision"], row["other_place"]) == (1, 1), "that only one refuses"
    assert compare.flights_row([told(1, True, 50.0)], [told(1, True, None)])["located_mm"] > 1e8


@pytest.mark.parametrize(
    ("maps", "flights", "wrong"),
    [
        ({"differ": 9}, {}, 0),  # that few last bits are other roundings
        ({"differ": 11}, {}, 1),
        ({"differ": 1, "part": "coarse"}, {}, 1),
        ({}, {"other_place": 1}, 1),
        ({}, {"other_decision": 2}, 1),
        ({}, {"located_mm": 2.5}, 1),
    ],
)
def test_what_is_not_as_here_is_said(maps, flights, wrong):
    usual = {"camera": "nadir", "map_made_on": "aarch64", "other_place": 0, "other_decision": 0, "located_mm": 0.2}
    found = {
        "maps": [{"camera": "nadir", "part": "fine", "numbers": 10**6, "differ": 0} | maps],
        "flights": [usual | flights],
    }
    assert len(compare.wrongs(found)) == wrong
