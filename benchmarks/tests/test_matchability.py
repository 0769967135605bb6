"""The fitting of matchability: labels without truth, and the file of a network."""

import numpy as np
import pytest

from edgevpr.frames.images import cv2

pytest.importorskip("torch", reason="fitting needs torch (pip install 'edgevpr[train]')")
pytest.importorskip("onnxscript", reason="fitting needs onnxscript (pip install 'edgevpr[train]')")
import matchability as labels
from matchability import changed, label_site

pytestmark = pytest.mark.slow  # maps are asked


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


def test_a_place_is_found_again_unless_there_is_nothing_to_see(tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "TECHNIQUES", ("cohog",))
    found = label_site(site(tmp_path / "a", 1, 12, empty=(0, 6)), False, 1)
    assert len(found) == 12 * labels.CHANGES
    seen = [each for each in found if each.question.path.stem not in ("0", "6")]
    empty = [each for each in found if each.question.path.stem in ("0", "6")]
    assert np.mean([each.found for each in seen]) > 0.5
    assert not any(each.found for each in empty)


def test_a_label_is_of_the_changed_picture_and_the_network_sees_that_one(tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "TECHNIQUES", ("cohog",))
    found = label_site(site(tmp_path / "a", 1), False, 1)
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
    asked = label_site(folder, False, 1)
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


def test_the_file_equals_pytorch_for_any_number_of_crops(tmp_path):
    import onnxruntime
    import torch

    torch.manual_seed(2)
    network = labels.Statistics().train()
    crops = np.random.default_rng(2).integers(0, 256, (2, 25, 1, 48, 64), np.uint8)
    network(torch.from_numpy(crops[0]) / 255)  # the normalisation has seen something
    network.eval()
    site = labels.TrainingSite("a", crops, np.zeros(2, np.float32), np.zeros(2, bool))
    file, largest = labels.write_network(network, tmp_path / "m.onnx", "", "", site)
    assert largest < 1e-5
    session = onnxruntime.InferenceSession(str(file.path))
    for number in (1, 7):
        (found,) = session.run(None, {"crops": site.inputs(1).numpy()[:number]})
        with torch.no_grad():
            np.testing.assert_allclose(found, network(site.inputs(1)[:number]).numpy(), atol=1e-5)
