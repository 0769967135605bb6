"""The techniques that take the feature map of a network, on the backbone that edgevpr ships."""

import numpy as np
import pytest
from pictures import textured
from tiny_networks import CARD, write_network

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques import create
from edgevpr.techniques.regions import describe, find_regions
from edgevpr.techniques.session import open_backbone
from edgevpr.techniques.words import local_descriptors

SETTINGS = {
    "alexnet": {"dims": 256},
    "amosnet": {"levels": 3},
    "hybridnet": {},
    "netvlad": {"words": 8},
    "rmac": {},
    "region_vlad": {"words": 12, "regions": 50},
    "cross_region_bow": {"words": 40, "regions": 60},
}


@pytest.fixture(scope="module", autouse=True)
def few_words(tmp_path_factory):
    """Words for the shipped backbone, some descriptors of pictures as they are: learning is tested elsewhere."""
    folder = tmp_path_factory.mktemp("models")
    backbone = open_backbone("calc", "features")
    features = [backbone.run(textured(seed)) for seed in (20, 21, 22)]
    local = np.concatenate([local_descriptors(each) for each in features])
    found = np.concatenate([describe(each, find_regions(each, 60)) for each in features])
    for kind, points, count in (("vlad", local, 8), ("vlad", local, 9), ("regions", found, 12), ("bow", found, 40)):
        words = points[np.random.default_rng(0).permutation(len(points))[:count]]
        np.savez(folder / f"calc_{kind}{count}.npz", words=words.astype(np.float16), model_sha256=backbone.sha256)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EDGEVPR_MODELS", str(folder))
        yield


def technique(name, **settings):
    return create(name, {**SETTINGS[name], **settings})


@pytest.mark.parametrize("name", SETTINGS)
def test_masked_pixels_do_not_count(name):
    it = technique(name)
    image, mask = textured(5), np.ones((120, 160), bool)
    mask[70:] = False
    changed = np.where(mask, image, textured(6))
    assert (changed != image).any()
    assert it.encode(image, mask).coarse.tobytes() == it.encode(changed, mask).coarse.tobytes()
    assert it.encode(image, mask).coarse.tobytes() != it.encode(image).coarse.tobytes()


@pytest.mark.parametrize(
    ("name", "settings", "error", "says"),
    [
        ("alexnet", {"dims": 0}, UsageError, "dims must be 8"),
        ("alexnet", {"seed": -1}, UsageError, "seed 0 or more"),
        ("alexnet", {"dims": 60_000}, ModelError, "cannot be projected to 60000"),
        ("amosnet", {"levels": 0}, UsageError, "amosnet: levels is 0"),
        ("hybridnet", {"levels": 40}, ModelError, "too small for a grid"),
        ("netvlad", {"assignment": "fuzzy"}, UsageError, "use soft or hard"),
        ("netvlad", {"words": 7}, ModelError, "train_words.py --images DIR --model calc --kind vlad --count 7"),
        ("region_vlad", {"regions": 0}, UsageError, "region_vlad: regions is 0"),
        ("region_vlad", {"words": 7}, ModelError, "--kind regions --count 7"),
        ("cross_region_bow", {"words": 7}, ModelError, "--kind bow --count 7"),
        ("rmac", {"form": "2bit"}, UsageError, "rmac has no form `2bit`"),
        ("rmac", {"model": "kalc"}, ModelError, "did you mean `calc`"),
    ],
)
def test_what_cannot_be_is_said_before_take_off(name, settings, error, says):
    with pytest.raises(error, match=says):
        technique(name, **settings)


def test_a_picture_without_any_region_says_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path))
    write_network(tmp_path, "dim", fault="below zero in the dark", card={"input": {**CARD["input"], "mean": [0.0]}})
    sha256 = open_backbone("dim", "features").sha256
    for kind, count in (("regions", 12), ("bow", 40)):
        words = np.random.default_rng(0).random((count, 4)).astype(np.float16)
        np.savez(tmp_path / f"dim_{kind}{count}.npz", words=words, model_sha256=sha256)
    for name in ("region_vlad", "cross_region_bow"):
        it = technique(name, model="dim")
        night, day = it.encode(np.zeros((32, 32), np.uint8)), it.encode(textured(1))
        assert (night.quality, day.quality) == (0, 1)
        scores, _ = it.coarse_scores(night, np.stack([day.coarse, night.coarse]), None)
        assert scores.tolist() == [0, 0]
        if it.spec.fine:
            assert it.match(night, day.fine).score == it.match(day, night.fine).score == 0
