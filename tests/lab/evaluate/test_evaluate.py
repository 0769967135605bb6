"""The whole measurement on a small generated set, and the tables."""

import json
from dataclasses import asdict

import cv2
import pytest
from generated_sets import COHOG, HOG, make_set
from pictures import textured

from edgevpr.core.errors import ImageError
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate
from edgevpr.lab.evaluate.metrics import compare, from_json
from edgevpr.lab.evaluate.tables import results_text
from edgevpr.runtime.preflight.probe import probe
from edgevpr.techniques import create


@pytest.fixture
def folder(tmp_path):
    """Eight places; each query is its place, darker. The last query's truth is wrong on purpose."""
    make_set(tmp_path, places=8)
    rows = [f"q{place}.png,r{place if place < 7 else 0}.png," for place in range(8)]
    (tmp_path / "truth.csv").write_text("\n".join(["query_file,ref_files,ref_files_loose", *rows]))
    return tmp_path


def load(folder):
    return load_dataset(folder / "query", folder / "ref", folder / "truth.csv")


@pytest.mark.parametrize(("name", "parameters"), [("hog", HOG), ("cohog", COHOG)])
def test_evaluate_measures_recall_costs_and_sizes(folder, name, parameters):
    (result,) = compare([evaluate(name, load(folder), parameters)])
    assert (result.queries, result.references) == (8, 8)
    assert result.recall_at_1 == 7 / 8
    assert result.recall_at_10 == 1
    assert result.precision_at_100_recall >= result.recall_at_1
    assert result.pcu == pytest.approx(result.precision_at_100_recall)  # the slowest of one
    assert (result.accepted, result.accepted_wrong, result.accepted_elsewhere) == (8, 1, 1)
    assert result.t_encode_s > 0
    assert result.t_match_per_ref_s == pytest.approx(result.t_match_s / 8)
    assert 0 < result.u_encode <= 1
    assert result.ah_total > 0
    assert "4S5200" in result.ah_assumes
    sizes = {"hog": 7 * 7 * 36 * 2 + 26, "cohog": 144 + 26}  # with number, position and heading
    assert result.descriptor_bytes == sizes[name]


def test_evaluate_ignores_a_loose_reference_and_counts_the_next(folder):
    # The only query looks exactly like r0, which is neither right nor wrong; r1 would be wrong, all others right.
    others = " ".join(f"r{place}.png" for place in range(2, 8))
    (folder / "truth.csv").write_text(f"query_file,ref_files,ref_files_loose\nq0.png,{others},r0.png {others}\n")
    cv2.imwrite(str(folder / "ref" / "r2.png"), cv2.blur(textured(0), (3, 3)))
    result = evaluate("hog", load(folder), HOG)
    assert result.recall_at_1 == 1
    assert (result.accepted, result.accepted_wrong) == (1, 0)


def test_from_json_gives_the_same_tables(folder):
    results = compare([evaluate("hog", load(folder), HOG), evaluate("cohog", load(folder), COHOG)])
    for result in results:
        read_back = json.loads(json.dumps(asdict(result), allow_nan=False))
        assert results_text([from_json({**read_back, "other": 1})]) == results_text([result])


def test_evaluate_stops_at_a_broken_image(folder):
    dataset = load(folder)
    (folder / "ref" / "r3.png").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"r3\.png"):
        evaluate("hog", dataset, HOG)


@pytest.mark.parametrize(("name", "settings"), [("hog", {"form": "1bit"}), ("cohog", {"camera": "nadir", "w1": 208})])
def test_evaluate_counts_as_many_bytes_a_place_as_probe(folder, name, settings):
    result, costs = evaluate(name, load(folder), settings), probe(create(name, settings))
    assert (result.descriptor_bytes, result.fine_bytes) == (costs.ram_bytes_per_place, costs.disk_bytes_per_place)
