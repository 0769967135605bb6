"""CALC: with the original weights, the figures that were published for it; with any, a technique like the others."""

import os
from pathlib import Path

import pytest
from tiny_networks import write_card

from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate

pytestmark = [pytest.mark.data, pytest.mark.slow]

SHARED = Path(__file__).resolve().parents[3] / "shared"
DATA = Path(os.environ.get("EDGEVPR_DATA") or SHARED / "data")
ORIGINAL = SHARED / "models" / "calc" / "model.onnx"
ORIGINAL_CARD = {
    "file": "original.onnx",
    "sha256": "85b2d913d1b8f587b2a0542fa695367962ab150bd7f37646f10de6b390d48585",
    "input": {
        "layout": "NCHW", "height": 120, "width": 160, "colour": "grey", "equalise": True, "resize": "cubic",
        "scale": 1 / 255, "mean": [0.0],
    },
    "outputs": {"descriptor": "descriptor"},
}  # fmt: skip


@pytest.fixture
def models(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path))
    return tmp_path


def test_the_original_weights_find_as_many_places_as_published(models):
    corridor = DATA / "corridor"
    if not (ORIGINAL.is_file() and corridor.is_dir()):
        pytest.skip(f"needs the original weights in {ORIGINAL} and the image set {corridor} (EDGEVPR_DATA)")
    (models / "original.onnx").symlink_to(ORIGINAL)
    write_card(models / "original.yaml", ORIGINAL_CARD)
    dataset = load_dataset(corridor / "query", corridor / "ref", corridor / "ground_truth.csv")
    result = evaluate("calc", dataset, {"model": "original"})
    assert result.recall_at_1 == pytest.approx(0.324, abs=0.01)
    assert result.auc == pytest.approx(0.760, abs=0.01)
    assert result.ep == pytest.approx(0.611, abs=0.01)
    assert result.weights.startswith("original: ")
