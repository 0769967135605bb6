"""A power cut while a map is written: its write-ahead log ends at any byte, or what it should hold is zeros."""

import contextlib
import random
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import map_writer
import numpy as np
import pytest
from map_writer import SPEC, frame, make_descriptor, make_map

from edgevpr.places.mapfile import PlaceMap

pytestmark = pytest.mark.slow

FIRST = 2  # of an earlier flight, and added to them
PLACES = 8
HEADER = 32  # of SQLite's write-ahead log: its header, and each page with its own
FRAME = 24 + 4096


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A map as a program leaves it that is killed while it adds places: the file, and the log beside it."""
    path = make_map(tmp_path_factory.mktemp("killed") / "killed.gpkg", FIRST)
    words = [sys.executable, map_writer.__file__, str(path), str(FIRST)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as writer:
        for _ in range(PLACES):
            writer.stdout.readline()
        writer.kill()
    return path


@pytest.mark.parametrize("rest", ["missing", "zeros"])
def test_open_for_writing_recovers_complete_places_from_a_truncated_log(killed, tmp_path, rest):
    log = killed.with_name("killed.gpkg-wal").read_bytes()
    ends = {end + off for end in range(HEADER + FRAME, len(log), FRAME) for off in (-1, 0, 1)}
    kept = {}
    for cut in sorted({*range(HEADER + 2), *ends, *random.Random(1).sample(range(len(log)), 50), len(log)}):
        path = copy_map(killed, tmp_path / str(cut), log[:cut] + bytes(len(log) - cut if rest == "zeros" else 0))
        kept[cut] = count_places(path)
        if cut % 10 == 0:
            with PlaceMap.open_for_writing(path) as place_map:
                place_map.add(frame(kept[cut]), make_descriptor(kept[cut]))
            assert count_places(path) == kept[cut] + 1
    assert list(kept.values()) == sorted(kept.values()), "what is longer holds no less"
    assert kept[len(log)] >= FIRST + PLACES, "all that was confirmed"
    assert kept[0] == FIRST


def copy_map(killed: Path, folder: Path, log: bytes) -> Path:
    folder.mkdir()
    path = shutil.copy(killed, folder / killed.name)
    path.with_name(f"{path.name}-wal").write_bytes(log)
    return path


def count_places(path: Path) -> int:
    """How many places a map has, each as it was added; the log is merged, and SQLite finds the file whole."""
    with PlaceMap.open(path) as place_map:
        assert place_map.spec == SPEC
        places = list(place_map.read_places())
        assert [place.source_image for place in places] == [frame(number).name for number in range(len(places))]
        for place in places:
            fine, _ = place_map.read_fine_part(place.place_id)
            np.testing.assert_array_equal(fine, make_descriptor(place.place_id - 1).fine)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    with contextlib.closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    return len(places)
