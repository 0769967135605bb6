"""Work that is kept: whole or not there."""

import os

import pytest

from edgevpr.core.errors import EdgevprError
from edgevpr.lab.evaluate.kept import Kept, key_of


def entry(kept):
    (path,) = [path for path in kept.folder.rglob("*") if path.is_file()]
    return path


def test_what_is_kept_comes_back_and_nothing_else(tmp_path):
    kept = Kept(tmp_path / "cache")
    key = key_of("a", {"b": 1.5})
    assert kept.get("things", key) is None
    kept.put_json("things", key, [1, None, "ü"])
    assert Kept(tmp_path / "cache").get_json("things", key) == [1, None, "ü"]
    assert kept.get("things", key_of("a", {"b": 1.50001})) is None
    assert kept.size_bytes() == entry(kept).stat().st_size
    kept.drop("things", key)
    assert kept.get("things", key) is None
    assert kept.damaged == 0


def test_every_flipped_bit_and_every_cut_is_noticed(tmp_path):
    kept, key = Kept(tmp_path), key_of("a")
    kept.put("things", key, b"content")
    path = entry(kept)
    whole = path.read_bytes()
    spoilt = [whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :] for at in range(len(whole))]
    spoilt += [whole[:at] for at in range(len(whole))] + [whole + b"x", b"\0" * len(whole)]
    for content in spoilt:
        path.write_bytes(content)
        assert kept.get("things", key) is None
    assert kept.damaged == len(spoilt)
    path.write_bytes(whole)
    assert kept.get("things", key) == b"content"


def test_an_entry_under_the_name_of_another_is_not_believed(tmp_path):
    kept, one, other = Kept(tmp_path), key_of("one"), key_of("other")
    kept.put("things", one, b"of one")
    kept.put("things", other, b"of other")
    found = {path.name: path for path in tmp_path.rglob("*") if path.is_file()}
    os.replace(found[one], found[other])
    assert kept.get("things", other) is None


def test_a_file_that_was_spoilt_is_not_believed(tmp_path):
    kept, key = Kept(tmp_path), key_of("map")
    kept.put_file("maps", key, lambda path: path.write_bytes(b"a map"))
    path = kept.get_file("maps", key)
    assert path.read_bytes() == b"a map"
    path.write_bytes(b"a nap")
    assert kept.get_file("maps", key) is None
    path.unlink()
    assert kept.get_file("maps", key) is None
    assert kept.damaged == 2
    kept.put_file("maps", key, lambda path: path.write_bytes(b"a map"))
    assert kept.get_file("maps", key).read_bytes() == b"a map"


def test_a_file_that_could_not_be_made_leaves_nothing(tmp_path):
    kept, key = Kept(tmp_path), key_of("map")

    def fail(path):
        path.write_bytes(b"half a m")
        raise EdgevprError("the reason")

    with pytest.raises(EdgevprError, match="the reason"):
        kept.put_file("maps", key, fail)
    assert kept.get_file("maps", key) is None
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_or_written_gets_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(EdgevprError, match="name another folder"):
        Kept(tmp_path / "file" / "cache")
    kept = Kept(tmp_path / "cache")
    (tmp_path / "cache" / "things").write_text("in the way")
    with pytest.raises(EdgevprError, match="all that is done stays"):
        kept.put("things", key_of("a"), b"content")


def test_a_folder_is_kept_whole_and_what_is_damaged_gone_or_added_is_noticed(tmp_path):
    kept, key = Kept(tmp_path), key_of("video")

    def write(folder):
        (folder / "a.png").write_bytes(b"a")
        (folder / "b.png").write_bytes(b"b")

    assert kept.get_folder("videos", key) is None
    path = kept.put_folder("videos", key, write)
    assert kept.get_folder("videos", key) == path
    assert sorted(each.name for each in path.iterdir()) == ["a.png", "b.png"]
    assert kept.put_folder("videos", key_of("same pictures"), write) == path
    for harm in (lambda: (path / "a.png").write_bytes(b"x"), (path / "b.png").unlink, (path / "c.png").touch):
        harm()
        assert kept.get_folder("videos", key) is None
        assert kept.put_folder("videos", key, write) == path
        assert kept.get_folder("videos", key) == path
    assert kept.damaged == 3
    assert sorted(each.name for each in tmp_path.iterdir()) == ["videos", "videos-files"]
