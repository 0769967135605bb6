"""The techniques that take the feature map of a network, on the backbone that edgevpr ships."""

import numpy as np
import pytest
from pictures import draw_texture
from tiny_networks import CARD, write_network

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques import create
from edgevpr.techniques.session import open_backbone


@pytest.mark.parametrize(
    ("name", "settings", "error", "says"),
    [
        ("alexnet", {"dims": 0}, UsageError, "dims .* 8"),
        ("alexnet", {"seed": -1}, UsageError, "seed 0 or more"),
        ("alexnet", {"dims": 60_000}, ModelError, " 60000"),
        ("amosnet", {"levels": 0}, UsageError, "levels is 0"),
        ("hybridnet", {"levels": 40}, ModelError, "a grid"),
        ("netvlad", {"assignment": "fuzzy"}, UsageError, " soft "),
        ("netvlad", {"words": 7}, ModelError, "train_words.py --images DIR --model calc --kind vlad --count 7"),
        ("region_vlad", {"regions": 0}, UsageError, "regions is 0"),
        ("region_vlad", {"words": 7}, ModelError, "--kind regions --count 7"),
        ("cross_region_bow", {"words": 7}, ModelError, "--kind bow --count 7"),
        ("rmac", {"form": "2bit"}, UsageError, "`2bit`"),
        ("rmac", {"model": "kalc"}, ModelError, "did you mean `calc`"),
    ],
)
def test_create_refuses_invalid_settings_before_take_off(name, settings, error, says):
    with pytest.raises(error, match=says):
        create(name, settings)


def test_score_places_is_zero_for_an_image_without_regions(models):
    write_network(models, "dim", fault="below zero in the dark", card={"input": {**CARD["input"], "mean": [0.0]}})
    sha256 = open_backbone("dim", "features").sha256
    for kind, count in (("regions", 12), ("bow", 40)):
        words = np.random.default_rng(0).random((count, 4)).astype(np.float16)
        np.savez(models / f"dim_{kind}{count}.npz", words=words, model_sha256=sha256)
    for name, count in (("region_vlad", 12), ("cross_region_bow", 40)):
        it = create(name, {"model": "dim", "words": count})
        night, day = it.encode(np.zeros((32, 32), np.uint8)), it.encode(draw_texture(1))
        assert (night.quality, day.quality) == (0, 1)
        scores, _ = it.score_places(night, np.stack([day.coarse, night.coarse]), None)
        assert scores.tolist() == [0, 0]
        if it.spec.fine:
            assert it.match(night, day.fine).score == it.match(day, night.fine).score == 0
