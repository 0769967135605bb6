"""A card that names a descriptor makes a technique."""

import numpy as np
import pytest
from pictures import textured
from tiny_networks import write_card, write_network

from edgevpr import techniques
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.session import open_backbone


def test_a_card_makes_a_technique_of_its_name(models):
    write_network(models, "mine")
    assert "mine" in techniques.names()
    assert techniques.parameters("mine") == {"form": "float", "threads": 1}
    technique = techniques.create("mine")
    assert (technique.spec.name, technique.spec.parameters) == ("mine", {})
    image = textured(1)
    expected = open_backbone("mine", "descriptor").run(image)
    found = technique.encode(image).coarse.astype(np.float32)
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-3)
    for form in ("float", "8bit", "1bit"):  # nobody has measured it
        assert techniques.create("mine", {"form": form}).min_margin > 1


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


def test_a_card_may_be_called_like_a_technique(models):
    write_network(models, "calc")
    assert techniques.names().count("calc") == 1
    assert techniques.create("calc").spec.parameters == {"model": "calc"}
