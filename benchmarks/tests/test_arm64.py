"""edgevpr on an emulated ARM board: what needs no emulator."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from arm64 import compare, glibc, suite
from arm64.page import page, wrongs

ROOT = Path(__file__).parents[1]


def test_without_its_tools_a_sentence_says_what_to_install():
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "on_arm64.py")],
        env={**os.environ, "PATH": ""},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr == "on_arm64: as root, install debootstrap, qemu-user-static and gcc.\n"


def test_each_file_of_tests_runs_there_or_is_left_out_with_a_reason():
    files = suite.files(ROOT)
    assert len(files) == len(set(files))
    for path in (ROOT / "tests").rglob("test_*.py"):
        name = str(path.relative_to(ROOT))
        left_out = [each for each in suite.LEFT_OUT if name == each or name.startswith(f"{each}/")]
        assert (name in files) != bool(left_out), name
    for name in (*suite.CORE, *suite.LEFT_OUT):
        assert (ROOT / name).exists(), name


def test_the_tests_of_a_file_are_counted(tmp_path):
    (tmp_path / "test_a.py").write_text(
        "import pytest\n"
        "def test_right(): pass\n"
        "def test_wrong(): assert False\n"
        "def test_skipped(): pytest.skip('no camera')\n"
        "def test_error(none_such): pass\n"
    )
    found = suite.run_tests(Path(sys.executable), tmp_path, "test_a.py", os.environ, "this")
    assert found.passed == 1
    assert found.failed == ["test_a.test_wrong", "test_a.test_error"]
    assert found.skipped == {"test_a.test_skipped": "no camera"}


def test_a_python_that_crashes_counts_as_a_failure(tmp_path):
    (tmp_path / "test_a.py").write_text("import os\ndef test_crash(): os.abort()\n")
    found = suite.run_tests(Path(sys.executable), tmp_path, "test_a.py", os.environ, "this")
    assert found.passed == 0
    assert len(found.failed) == 1


def test_what_a_change_of_the_code_could_change_is_run_again(tmp_path):
    (tmp_path / "edgevpr").mkdir()
    (tmp_path / "edgevpr" / "a.py").write_text("A = 1\n")
    before = suite.code_of(tmp_path)
    (tmp_path / "README.md").write_text("A page.\n")
    assert suite.code_of(tmp_path) == before
    (tmp_path / "edgevpr" / "a.py").write_text("A = 2\n")
    assert suite.code_of(tmp_path) != before


def test_two_maps_of_the_same_pictures(tmp_path):
    paths = []
    for number, fine in enumerate(([1, 2, 3, 4], [1, 2, 5, 4])):
        paths.append(tmp_path / f"{number}.gpkg")
        with sqlite3.connect(paths[-1]) as database:
            database.execute("CREATE TABLE places (place_id, coarse, fine)")
            words = np.array([1023, 7], "<u2").tobytes()
            for place in (2, 1):
                last = bytes(fine) if place == 2 else bytes(4)
                database.execute("INSERT INTO places VALUES (?, ?, ?)", (place, words, last))
    row = compare.maps_row(*paths, "nadir", 1, "fine")
    assert (row.numbers, row.differ, row.most) == (8, 1, 2)
    row = compare.maps_row(*paths, "nadir", 1, "coarse")
    assert (row.numbers, row.differ, row.most) == (4, 0, 0)


def told(place: int, accepted: bool, lat_deg: float | None, reason: str = "x") -> dict:
    where = {"lat_deg": lat_deg, "lon_deg": 8.0} if lat_deg else None
    return {
        "place": place,
        "accepted": accepted,
        "reason": reason,
        "score": place / 10,
        "confidence": None,
        "position": {"lat_deg": 51.0, "lon_deg": 8.0},
        "located": where,
    }


def test_two_flights_of_the_same_pictures():
    one = [told(1, True, 50.0), told(2, True, 50.0), told(3, False, None)]
    other = [told(1, True, 50.0 + 1e-8), told(2, False, None), told(5, False, None, "y")]
    row = compare.flights_row(one, other, "nadir", 1, "aarch64")
    assert (row.queries, row.accepted, row.other_decision, row.other_words) == (3, 2, 1, 1)
    assert (row.other_place, row.other_refused) == (0, 1)
    assert row.score == pytest.approx(0.2)
    assert row.located_mm == pytest.approx(1.11, abs=0.01)


def test_another_place_that_only_one_refuses_is_another_decision_about_it():
    row = compare.flights_row([told(1, True, 50.0)], [told(2, False, None)], "nadir", 1, "aarch64")
    assert (row.other_decision, row.other_place, row.other_refused) == (1, 1, 0)


def test_a_place_that_only_one_locates_counts_with_its_own_position():
    row = compare.flights_row([told(1, True, 50.0)], [told(1, True, None)], "nadir", 1, "aarch64")
    assert row.located_mm > 1e8


@pytest.mark.parametrize(
    ("file", "least"),
    [
        ("av-18.1.0-cp311-abi3-manylinux_2_28_aarch64.whl", (2, 28)),
        ("numpy-2.4.6-cp311-cp311-manylinux_2_27_aarch64.manylinux_2_28_aarch64.whl", (2, 27)),
        ("protobuf-7.36.2-cp310-abi3-manylinux2014_aarch64.whl", (2, 17)),
        ("psutil-7.2.2-cp36-abi3-manylinux2010_x86_64.manylinux_2_12_x86_64.whl", (2, 12)),
        ("exifread-3.5.1-py3-none-any.whl", (0, 0)),
    ],
)
def test_the_name_of_a_wheel_tells_its_glibc(file, least):
    assert glibc._least(file) == least


def test_the_lock_of_one_python_has_each_package_once():
    lock = (ROOT / "deploy" / "requirements.lock").read_text("utf-8")
    for python in ("3.10", "3.11", "3.12", "3.13"):
        pins = glibc._pins(lock, "aarch64", python).splitlines()
        names = [pin.partition("==")[0] for pin in pins]
        assert len(names) == len(set(names)) > 10
        assert all("--hash=sha256:" in pin and ";" not in pin for pin in pins)


def found(**changed: object) -> dict:
    """What is found where all is as here, but for `changed`."""
    maps = [
        {"camera": "nadir", "seed": 1, "part": part, "numbers": 10**6, "differ": 0, "most": 0}
        for part in ("coarse", "fine")
    ]
    flight = {
        "camera": "nadir",
        "seed": 1,
        "map_made_on": "aarch64",
        "queries": 21,
        "accepted": 11,
        "other_place": 0,
        "other_decision": 0,
        "other_refused": 0,
        "other_words": 0,
        "score": 0.0,
        "confidence": 1e-7,
        "located_mm": 0.2,
    }
    tests = {"file": "tests/belief/test_belief.py", "commit": "this", "passed": 9, "took_s": 4.0}
    tests |= {"failed": changed.get("failed", []), "skipped": {"a.b": "no camera"}}
    if "fine" in changed or "coarse" in changed:
        maps = [each | {"differ": changed.get(each["part"], 0)} for each in maps]
    return {
        "system": {
            "date": "today",
            "commit": "this",
            "machine": {"cores": 2, "cpu": "one", "python": "3.11.7", "numpy": "2.4", "opencv": "5.0"},
            "qemu": "qemu 7.2",
            "cpu": "cortex-a53",
            "release": "bookworm",
            "python": "3.11.2",
            "glibc": "2.36",
            "packages": {"numpy": "2.4.6"},
        },
        "made": {name: {"date": "today", "commit": "this"} for name in ("wheels", "flights", "tests", "demo")},
        "wheels": {"named": {"aarch64": {"3.10": {"av": [2, 28]}, "3.11": {"av": [2, 28]}}}, "asked": {"av": [2, 28]}},
        "flights": {
            "every": 6,
            "maps": maps,
            "flights": [
                flight | {key: changed[key] for key in flight if key in changed},
                *([flight | {"camera": "forward"}] if changed.get("flown_ahead", True) else []),
            ],
        },
        "tests": {"code": "x", "files": [tests["file"], *changed.get("not_run", [])], "rows": [tests]},
        "demo": {
            each: {"accepted_wrong": changed.get("accepted_wrong", 0), "wall_s": 9.0, "not_sent": {"too old": 2}}
            for each in ("x86-64", "aarch64")
        },
    }


def test_the_page_names_the_oldest_system():
    text = page(found(fine=9))  # that few last bits are other roundings
    assert "**Nothing differs in what was tried.**" in text
    assert "So the oldest system is Debian 10" in text
    assert "* 1: no camera" in text
    assert "* 2: too old" in text


def test_what_was_not_tried_is_said():
    some = found()
    del some["demo"], some["tests"]
    assert "**Nothing differs in what was tried. Not tried: tests, demo.**" in page(some)


def test_a_camera_that_was_not_flown_is_named():
    assert "**Nothing differs in what was tried. Not flown: forward.**" in page(found(flown_ahead=False))


def test_files_that_were_not_run_are_named():
    text = page(found(not_run=["tests/belief/test_motion.py"]))
    assert "**Nothing differs in what was tried. Not run: 1 of 2 files of tests.**" in text
    assert "\n* tests/belief/test_motion.py\n" in text
    assert "| tests/belief | 1 of 2 | 9 | 0 | 1 | 4 | this |" in text


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"failed": ["a.test_b"]}, "tests/belief/test_belief.py: a.test_b failed."),
        ({"coarse": 1}, "1 values of coarse differ"),
        ({"fine": 11}, "11 values of fine differ"),
        ({"other_place": 1}, "1 other places accepted"),
        ({"other_decision": 2}, "2 other decisions"),
        ({"located_mm": 2.5}, "2.500 mm apart"),
        ({"accepted_wrong": 1}, "1 matches of the demonstration were wrong."),
    ],
)
def test_what_is_not_as_here_is_said(changed, said):
    (sentence,) = wrongs(found(**changed))
    assert said in sentence
