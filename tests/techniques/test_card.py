"""Cards: what a good one says, and one sentence for everything that a bad one may."""

import numpy as np
import pytest
from pictures import draw_texture
from tiny_networks import CARD, write_card, write_network

from edgevpr import techniques
from edgevpr.core.errors import EdgevprError, ModelError, UsageError
from edgevpr.core.files import find_shipped, list_model_folders
from edgevpr.techniques.card import load_card, read_card
from edgevpr.techniques.session import open_backbone

SHA256 = "0" * 64


def test_load_card_prefers_the_users_card_to_the_shipped_one(tmp_path, monkeypatch):
    monkeypatch.delenv("EDGEVPR_MODELS", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert list_model_folders() == (tmp_path / "edgevpr" / "models", find_shipped("models"))
    write_network(tmp_path / "edgevpr" / "models", "calc", card={"title": "My own"})
    assert load_card("calc").title == "My own"


def test_fingerprint_changes_with_everything_that_affects_a_descriptor(models):
    whole = {"file": "tiny.onnx", "sha256": SHA256}
    found = {
        read_card(write_card(models / "tiny.yaml", {**whole, **changes})).fingerprint
        for changes in (
            {},
            {"sha256": "1" * 64},
            {"input": {**CARD["input"], "equalise": True}},
            {"outputs": {"descriptor": "other", "features": "features"}},
        )
    }
    assert len(found) == 4
    assert read_card(write_card(models / "tiny.yaml", {**whole, "title": "Better named"})).fingerprint in found


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"sha256": "abc"}, r"`sha256` .* 64 .*`sha256sum tiny.onnx`"),
        ({"file": "../tiny.onnx"}, "same folder"),
        ({"file": "tiny.yaml"}, "`file` is `tiny.yaml`, which"),
        ({"file": "a\0.onnx"}, r"tiny.yaml: `file` contains a character"),
        ({"outputs": {}}, "`outputs` must name"),
        ({"input": {**CARD["input"], "colour": "gray"}}, "`input.colour` is `gray`.* rgb"),
        ({"input": {**CARD["input"], "layout": "CHW"}}, "`input.layout` is `CHW`.* NCHW"),
        ({"input": {**CARD["input"], "mean": [1.0, 2.0]}}, "`input.mean` is "),
        ({"input": {**CARD["input"], "std": [0.0]}}, "`input.std` is .* all above 0"),
        ({"input": {**CARD["input"], "height": 4}}, "`input.height` is 4,"),
        ({"lisence": "MIT"}, "unknown key `lisence`.*did you mean `licence`"),
        ({"path": "/etc"}, "`path` must be"),
    ],
)
def test_load_card_refuses_an_invalid_card_in_one_sentence(models, changes, says):
    path = write_card(models / "tiny.yaml", {"file": "tiny.onnx", "sha256": SHA256, **changes})
    with pytest.raises(EdgevprError, match=says) as raised:
        load_card("tiny")
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_load_card_reports_a_missing_key_and_a_missing_card(models):
    path = write_card(models / "tiny.yaml", {"sha256": SHA256})
    path.write_text(path.read_text().replace("licence", "#"))
    with pytest.raises(ModelError, match="licence"):
        load_card("tiny")
    with pytest.raises(ModelError, match=r"`tinny`.*`tiny`"):
        load_card("tinny")
    with pytest.raises(ModelError, match=r"`\.\./tiny`"):
        load_card("../tiny")


def test_create_makes_a_technique_from_a_card(models):
    write_network(models, "mine")
    assert "mine" in techniques.list_techniques()
    assert techniques.read_parameters("mine") == {"form": "float", "threads": 1}
    technique = techniques.create("mine")
    assert (technique.spec.name, technique.spec.parameters) == ("mine", {})
    image = draw_texture(1)
    expected = open_backbone("mine", "descriptor").run(image)
    found = technique.encode(image).coarse.astype(np.float32)
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-3)
    for form in ("float", "8bit", "1bit"):  # nobody has measured it
        assert techniques.create("mine", {"form": form}).min_margin > 1


def test_list_techniques_excludes_backbones_and_survives_a_broken_card(models):
    write_network(models, "mine", card={"outputs": {"features": "features"}})
    write_card(models / "broken.yaml", {"sha256": "no"})
    write_network(models, "good")
    assert {"mine", "broken"}.isdisjoint(techniques.list_techniques())
    assert "good" in techniques.list_techniques()
    with pytest.raises(UsageError, match="`mine`"):
        techniques.create("mine")
    with pytest.raises(ModelError, match=r"broken\.yaml"):
        techniques.create("broken")


def test_list_techniques_accepts_a_card_named_like_a_technique(models):
    write_network(models, "calc")
    assert techniques.list_techniques().count("calc") == 1
    assert techniques.create("calc").spec.parameters == {"model": "calc"}
