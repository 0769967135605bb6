"""Work that is kept: whole or not there."""

import os
import time

import pytest

from edgevpr.core.errors import EdgevprError
from edgevpr.lab.evaluate.cache import Cache, key_of


def test_what_is_kept_is_made_once_and_nothing_else_is_taken_for_it(tmp_path):
    cache, made = Cache(tmp_path / "cache"), []

    def make(path):
        made.append(path)
        path.write_text("content")

    for _ in range(2):
        assert cache.keep("maps", key_of("a", {"b": 1.5}), make).read_text() == "content"
    assert len(made) == 1
    cache.keep("maps", key_of("a", {"b": 1.50001}), make)
    assert len(made) == 2


def test_a_folder_that_another_program_has_kept_meanwhile_is_taken(tmp_path):
    cache = Cache(tmp_path)

    def make(path):
        path.mkdir()
        (path / "ours.png").touch()
        theirs = cache.path("videos", "key")
        theirs.mkdir(parents=True)
        (theirs / "theirs.png").touch()

    assert [each.name for each in cache.keep("videos", "key", make).iterdir()] == ["theirs.png"]


def test_what_could_not_be_made_leaves_nothing(tmp_path):
    def fail(path):
        path.write_bytes(b"half a m")
        raise EdgevprError("the reason")

    with pytest.raises(EdgevprError, match="reason"):
        Cache(tmp_path).keep("maps", "key", fail)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_made_or_written_gets_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(EdgevprError, match="cache"):
        Cache(tmp_path / "file" / "cache")
    cache = Cache(tmp_path / "cache")
    (tmp_path / "cache" / "maps").write_text("in the way")
    with pytest.raises(EdgevprError, match="--cache"):
        cache.keep("maps", "key", lambda path: path.touch())


def test_what_a_killed_program_has_left_goes_after_a_day(tmp_path):
    for name, age_s in ((".unfinished-old", 100_000), (".unfinished-new", 0)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    Cache(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".unfinished-new"]
