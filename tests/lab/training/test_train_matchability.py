"""`edgevpr train matchability`: labels without truth, two kinds of network, and the file of the better one."""

import json
from pathlib import Path

import numpy as np
import pytest

from edgevpr.cli.main import main
from edgevpr.frames.images import cv2
from edgevpr.lab.training import labels
from edgevpr.lab.training.labels import changed, label_site

pytestmark = pytest.mark.slow  # networks are fitted


def ground(seed, height=96, width=128):
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.random((2**size, 2**size)), (width, height)) / size for size in range(2, 6)]
    return cv2.normalize(sum(layers), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def site(folder, seed, count=9, empty=()):
    """A site of `count` places that are unlike each other, but for the empty ones."""
    (folder / "ref").mkdir(parents=True)
    for number in range(count):
        picture = np.full((96, 128), 90, np.uint8) if number in empty else ground(100 * seed + number)
        cv2.imwrite(str(folder / "ref" / f"{number}.png"), picture)
    return folder


def silent(items, total, label):
    return items


def test_a_place_is_found_again_unless_there_is_nothing_to_see(tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "TECHNIQUES", ("cohog",))
    found = label_site(site(tmp_path / "a", 1, 12, empty=(0, 6)), False, 1, silent)
    assert len(found) == 12 * labels.CHANGES
    seen = [each for each in found if each.question.path.stem not in ("0", "6")]
    empty = [each for each in found if each.question.path.stem in ("0", "6")]
    assert np.mean([each.found for each in seen]) > 0.5
    assert not any(each.found for each in empty)
    assert np.mean([each.alike for each in seen]) < min(each.alike for each in empty)


def test_a_label_is_of_the_changed_picture_and_the_network_sees_that_one(tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "TECHNIQUES", ("cohog",))
    found = label_site(site(tmp_path / "a", 1), False, 1, silent)
    pictures = [each.question.picture() for each in found[: labels.CHANGES]]
    assert {each.question.path for each in found[: labels.CHANGES]} == {tmp_path / "a" / "ref" / "0.png"}
    assert len({picture.tobytes() for picture in pictures}) == labels.CHANGES
    known = np.array([each.found for each in found]).reshape(9, labels.CHANGES)
    assert (known.max(axis=1) > known.min(axis=1)).any()  # one change of a place is recognised, another is not


def test_queries_are_labelled_by_their_truth(tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "TECHNIQUES", ("cohog",))
    folder = site(tmp_path / "a", 1)
    (folder / "query").mkdir()
    cv2.imwrite(str(folder / "query" / "right.png"), ground(104))
    cv2.imwrite(str(folder / "query" / "wrong.png"), ground(107))
    (folder / "ground_truth.csv").write_text("query_file,ref_files\nright.png,4.png\nwrong.png,0.png\n")
    asked = label_site(folder, False, 1, silent)
    found = {each.question.path.name: each.found for each in asked if each.question.change is None}
    assert (found["right.png"], found["wrong.png"]) == (1.0, 0.0)


@pytest.mark.parametrize("turns", [False, True])
def test_a_changed_picture_has_the_form_of_the_picture_and_follows_from_the_seed(turns):
    for picture in (ground(1), cv2.cvtColor(ground(1), cv2.COLOR_GRAY2BGR)):
        once, again = (changed(picture, np.random.default_rng(3), turns) for _ in range(2))
        assert once.shape == picture.shape
        assert once.dtype == np.uint8
        assert np.array_equal(once, again)
        assert np.abs(once.astype(int) - picture).mean() > 3


@pytest.mark.parametrize(
    ("sites", "out", "complaint"),
    [
        (("a", "b"), "m.onnx", "2 data sets are too few"),
        (("a", "b", "c"), "m.bin", "ends in .onnx"),
        (("a", "b", "few"), "m.onnx", "too few images"),
        (("a", "b", "nowhere"), "m.onnx", "does not exist"),
    ],
)
def test_what_cannot_be_trained_is_refused_before_the_work(sites, out, complaint, tmp_path, capsys):
    for name, count in {"a": 9, "b": 9, "c": 9, "few": 3}.items():
        site(tmp_path / name, 1, count)
    folders = [str(tmp_path / name) for name in sites]
    assert main(["train", "matchability", "--data", *folders, "--out", str(tmp_path / out)]) != 0
    assert complaint in capsys.readouterr().err


def test_the_command_writes_a_network_that_the_gate_can_use(tmp_path, monkeypatch, capsys):
    torch = pytest.importorskip("torch", reason="training needs torch (pip install 'edgevpr[train]')")
    pytest.importorskip("onnxscript", reason="training needs onnxscript (pip install 'edgevpr[train]')")
    from edgevpr.lab.training import matchability
    from edgevpr.runtime.recognise.memorability import memorability_of
    from edgevpr.techniques.card import read_card

    torch.set_num_threads(1)
    monkeypatch.setattr(labels, "TECHNIQUES", ("cohog",))
    for kind in matchability.KINDS.values():
        monkeypatch.setattr(kind, "STEPS", 60)
    folders = [str(site(tmp_path / name, seed, empty=(0, 4, 8))) for seed, name in enumerate("abc")]
    out = tmp_path / "m.onnx"
    assert main(["train", "matchability", "--data", *folders, "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["frames"] == sum(result["classes"].values()) == 27 * labels.CHANGES
    assert set(result["unseen"]) == set(matchability.KINDS)
    assert set(result["unseen"]["statistics"]["generated"]) == {"a", "b", "c"}
    assert set(result["unseen"]["statistics"]["real"].values()) == {None}  # these sites have no queries
    assert result["largest_difference"] < 1e-4
    network = memorability_of(read_card(Path(result["card"])))
    assert network.matrix(ground(5)).mean() > network.matrix(np.full((96, 128), 90, np.uint8)).mean()
    assert main(["train", "matchability", "--data", *folders, "--out", str(out)]) != 0
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["statistics", "convolutions"])
def test_the_file_equals_pytorch_for_any_number_of_crops(kind, tmp_path):
    torch = pytest.importorskip("torch", reason="training needs torch (pip install 'edgevpr[train]')")
    pytest.importorskip("onnxscript", reason="training needs onnxscript (pip install 'edgevpr[train]')")
    import onnxruntime

    from edgevpr.lab.training import matchability

    torch.manual_seed(2)
    network = matchability.KINDS[kind]().train()
    crops = np.random.default_rng(2).integers(0, 256, (2, 25, 1, 48, 64), np.uint8)
    network(torch.from_numpy(crops[0]) / 255)  # the normalisation has seen something
    network.eval()
    site = matchability.TrainingSite("a", crops, np.zeros(2, np.float32), np.zeros(2, bool))
    file, largest = matchability.write_network(network, tmp_path / "m.onnx", "", "", site)
    assert largest < 1e-5
    session = onnxruntime.InferenceSession(str(file.path))
    for number in (1, 7):
        (found,) = session.run(None, {"crops": site.inputs(1).numpy()[:number]})
        with torch.no_grad():
            np.testing.assert_allclose(found, network(site.inputs(1)[:number]).numpy(), atol=1e-5)
