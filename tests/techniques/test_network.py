"""A card alone makes a technique, with every head that a card may name."""

import numpy as np
import pytest
from pictures import textured
from tiny_networks import CARD, FEATURES, write_card, write_network

from edgevpr import techniques
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques import pooling
from edgevpr.techniques.session import open_backbone

CHANNELS, HIGH, WIDE = FEATURES
HEADS = {
    "flatten": ({}, CHANNELS * HIGH * WIDE, lambda f: f.ravel()),
    "max": ({}, CHANNELS, lambda f: f.max(axis=(1, 2))),
    "gem": ({"p": 3}, CHANNELS, lambda f: pooling.gem(f, 3.0)),
    "grid": ({"rows": 2, "columns": 3, "how": "mean"}, 6 * CHANNELS, lambda f: pooling.grid(f, 2, 3, "mean")),
    "pyramid": ({"levels": [1, 2]}, 5 * CHANNELS, lambda f: pooling.pyramid(f, (1, 2))),
    "projection": (
        {"length": 64, "seed": 5},
        64,
        lambda f: pooling.gaussian_projection(f.size, 64, 5)(f),
    ),
    "rmac": ({}, CHANNELS, lambda f: pooling.regional_vectors(f, pooling.square_regions(HIGH, WIDE)).sum(axis=0)),
}


@pytest.mark.parametrize("name", HEADS)
def test_each_head_makes_a_technique_of_the_cards_name(models, name):
    parameters, length, literal = HEADS[name]
    write_network(models, "mine", card={"head": {"name": name, **parameters}})
    assert "mine" in techniques.names()
    assert techniques.parameters("mine") == {"form": "float", "threads": 1}
    technique = techniques.create("mine")
    assert (technique.spec.name, technique.spec.parameters) == ("mine", {})
    assert technique.spec.coarse.shape == (length,)
    image = textured(1)
    expected = literal(open_backbone("mine", "features").run(image))
    found = technique.encode(image).coarse.astype(np.float32)
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-3)


def test_a_vlad_head_counts_the_words_learned_on_its_network(models):
    write_network(models, "mine", card={"head": {"name": "vlad", "words": 5}})
    with pytest.raises(ModelError, match="mine_vlad5"):
        techniques.create("mine")
    words = np.random.default_rng(0).random((5, CHANNELS)).astype(np.float16)
    sha256 = open_backbone("mine", "features").sha256
    np.savez(models / "mine_vlad5.npz", words=words, model_sha256=sha256)
    first = techniques.create("mine").spec
    assert first.coarse.shape == (5 * CHANNELS,)
    np.savez(models / "mine_vlad5.npz", words=words[::-1], model_sha256=sha256)
    assert techniques.create("mine").spec.model_sha256 != first.model_sha256


def test_what_changes_the_vector_changes_what_a_map_asks_for(models):
    hashes = set()
    for changes in (
        {},
        {"similarity": "l2"},
        {"head": {"name": "max"}},
        {"head": {"name": "gem", "p": 3}},
        {"head": {"name": "gem", "p": 4}},
    ):
        write_network(models, "mine", card=changes)
        hashes.add(techniques.create("mine").spec.model_sha256)
    assert len(hashes) == 5


def test_a_feature_map_too_small_for_the_head_is_said_before_take_off(models):
    write_network(models, "mine", card={"head": {"name": "grid", "rows": 20, "columns": 2, "how": "max"}})
    with pytest.raises(ModelError, match="20x2"):
        techniques.create("mine")


def test_a_backbone_is_no_technique_and_a_broken_card_hides_nothing_else(models):
    write_network(models, "mine", card={"outputs": {"features": "features"}})
    write_card(models / "broken.yaml", {"sha256": "no"})
    write_network(models, "good")
    assert {"mine", "broken"}.isdisjoint(techniques.names())
    assert "good" in techniques.names()
    with pytest.raises(UsageError, match="`mine`"):
        techniques.create("mine")
    with pytest.raises(ModelError, match=r"broken\.yaml"):
        techniques.create("broken")


def test_numbers_beyond_half_precision_are_said_before_take_off(models):
    rule = {**CARD["input"], "scale": 1e6}
    write_network(models, "mine", card={"input": rule, "similarity": "l2"})
    with pytest.raises(ModelError, match="half precision"):
        techniques.create("mine")
    write_network(models, "mine", card={"input": rule})
    assert techniques.create("mine").encode(textured(1)).quality == 1


def test_nothing_is_accepted_of_a_network_that_nobody_has_measured(models):
    write_network(models, "mine")
    for form in ("float", "8bit", "1bit"):
        assert techniques.create("mine", {"form": form}).min_margin > 1


def test_a_card_may_be_called_like_a_technique(models):
    write_network(models, "calc")
    assert techniques.names().count("calc") == 1
    assert techniques.create("calc").spec.parameters == {"model": "calc"}
