"""`edgevpr models`: what is listed, added and refused."""

import errno
import hashlib
import os
from pathlib import Path

import pytest
from tiny_networks import write_card, write_network

from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.runtime.preflight.networks import add, list_models, run_network
from edgevpr.techniques.card import load_card


def listed(name):
    return next(each for each in list_models() if each.name == name)


def test_list_models_says_whose_weights_and_what_uses_them(models):
    write_network(models, "mine")
    mine = listed("mine")
    assert (mine.problem, mine.licence, mine.source) == (None, "MIT", "made by a test")
    assert (mine.outputs, mine.techniques) == (("descriptor", "features"), ("mine",))
    write_network(models, "calc")
    assert {"calc", "alexnet", "netvlad", "rmac", "region_vlad", "cross_region_bow"} <= set(listed("calc").techniques)
    write_network(models, "calc", card={"outputs": {"descriptor": "descriptor"}})
    assert listed("calc").techniques == ("calc",)


def test_run_network_returns_the_shapes_of_its_outputs(models):
    write_network(models, "backbone", card={"outputs": {"features": "features"}})
    assert run_network(load_card("backbone")) == {"features": (4, 10, 14)}


def test_list_models_goes_on_after_a_wrong_card_or_file(models):
    write_network(models, "good")
    write_network(models, "other", card={"sha256": "0" * 64})
    write_card(models / "gone.yaml", {"sha256": "0" * 64, "file": "gone.onnx"})
    write_card(models / "broken.yaml", {"sha256": "0" * 64, "titel": "x"})
    assert not listed("good").problem
    for name, named in (("other", "SHA-256"), ("gone", "gone.onnx"), ("broken", "`titel`")):
        assert named in listed(name).problem


@pytest.fixture
def download(tmp_path):
    """A network and its card somewhere else, as they come from the net."""
    folder = tmp_path / "download"
    write_network(folder, "mine")
    return folder


def test_add_copies_a_network_with_its_card_as_it_is(models, download):
    (download / "mine.yaml").write_text((download / "mine.yaml").read_text() + "# mine, and nobody else's\n")
    (download / "mine.onnx").rename(download / "v2-final.onnx")
    added = add(download / "v2-final.onnx", download / "mine.yaml")
    assert (added.shapes, added.vector_length) == ({"descriptor": (16,), "features": (4, 10, 14)}, 16)
    assert added.card == str(models / "mine.yaml")
    assert Path(added.card).read_text().endswith("# mine, and nobody else's\n")
    assert not listed("mine").problem
    assert sorted(path.name for path in models.iterdir()) == ["mine.onnx", "mine.yaml"]
    add(download / "v2-final.onnx", download / "mine.yaml")  # again: nothing to do


@pytest.mark.parametrize("missing", ["sha256: null\n", ""])
def test_add_completes_a_card_without_a_hash(models, download, missing):
    lines = (download / "mine.yaml").read_text().splitlines(keepends=True)
    (download / "mine.yaml").write_text("".join(line for line in lines if not line.startswith("sha256")) + missing)
    add(download / "mine.onnx", download / "mine.yaml")
    assert load_card("mine").sha256 == hashlib.sha256((download / "mine.onnx").read_bytes()).hexdigest()
    assert load_card("mine").input == load_card("mine").input


@pytest.mark.parametrize(
    ("card", "fault", "says"),
    [
        ({"sha256": "0" * 64}, None, "SHA-256"),
        ({"outputs": {"features": "conv9"}}, None, "conv9"),
        ({}, "nan", "finite"),
    ],
)
def test_add_refuses_what_would_not_fly(models, tmp_path, card, fault, says):
    folder = tmp_path / "download"
    write_network(folder, "mine", fault, card)
    with pytest.raises(EdgevprError, match=says) as raised:
        add(folder / "mine.onnx", folder / "mine.yaml")
    assert "\n" not in str(raised.value)
    assert not list(models.iterdir())


def test_add_overwrites_no_other_network(models, download):
    write_network(models, "mine", card={"title": "An older one"})
    with pytest.raises(ModelError, match=r"mine\.yaml"):
        add(download / "mine.onnx", download / "mine.yaml")
    write_network(models, "other", fault="dynamic batch")
    (models / "mine.yaml").unlink()
    write_network(download, "mine", card={"file": "other.onnx"})
    with pytest.raises(ModelError, match=r"other\.onnx"):
        add(download / "mine.onnx", download / "mine.yaml")


def test_add_refuses_devices_pipes_and_huge_files(models, tmp_path):
    os.mkfifo(tmp_path / "pipe.onnx")
    write_network(tmp_path / "download", "mine", card={"sha256": ""})
    for file in (Path("/dev/zero"), tmp_path / "pipe.onnx"):
        with pytest.raises(ModelError, match="regular file"):
            add(file, tmp_path / "download" / "mine.yaml")
    (tmp_path / "vast.onnx").touch()
    os.truncate(tmp_path / "vast.onnx", 2**31 + 1)
    with pytest.raises(ModelError, match=r"2,147\.5 MB"):
        add(tmp_path / "vast.onnx", tmp_path / "download" / "mine.yaml")


def test_add_leaves_nothing_half_written_on_a_full_disk(models, download, monkeypatch):
    def full(_source, target):
        target.write_bytes(b"the first half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("edgevpr.runtime.preflight.networks.shutil.copyfile", full)
    with pytest.raises(OSError, match="No space"):
        add(download / "mine.onnx", download / "mine.yaml")
    assert not list(models.iterdir())
