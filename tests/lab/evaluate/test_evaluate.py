"""The whole measurement on a small generated set."""

from unittest.mock import Mock

import cv2
import pytest
from generated_sets import make_set
from pictures import draw_texture

from edgevpr.core.errors import UsageError
from edgevpr.core.text import iterate_silently
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import MatchOptions, answer_queries, summarise
from edgevpr.lab.evaluate.metrics import add_pcu
from edgevpr.lab.evaluate.tables import format_results
from edgevpr.mapmaking import finishing
from edgevpr.runtime.preflight.probe import measure_costs
from edgevpr.techniques import create

HOG = {"w1": 64}
COHOG = {"w1": 208}


@pytest.fixture
def folder(tmp_path):
    """Seven places; each query is its place, darker. The truth of q6 is wrong on purpose, and q7 is off the map."""
    make_set(tmp_path, places=8)
    rows = [f"q{place}.png,r{place if place < 6 else 0}.png," for place in range(7)]
    (tmp_path / "truth.csv").write_text("\n".join(["query_file,ref_files,ref_files_loose", *rows, "q7.png,,"]))
    return tmp_path


def evaluate(folder, name, parameters):
    dataset = load_dataset(folder / "query", folder / "ref", folder / "truth.csv")
    technique, options = create(name, parameters), MatchOptions()
    answers, not_done = answer_queries(technique, dataset, options, iterate_silently)
    return summarise(technique, dataset, answers, options, not_done)


@pytest.mark.parametrize(("name", "parameters"), [("hog", HOG), ("cohog", COHOG)])
def test_evaluate_measures_recall_costs_and_sizes(folder, name, parameters):
    (result,) = add_pcu([evaluate(folder, name, parameters)])
    assert (result.queries, result.queries_off_map, result.references) == (8, 1, 8)
    assert (result.recall_at_1, result.with_match.recall_at_1) == (6 / 8, 6 / 7)
    assert (result.recall_at_10, result.with_match.recall_at_10) == (7 / 8, 1)
    assert result.pcu == pytest.approx(result.precision_at_100_recall)  # the slowest of one
    assert result.accepted == 7 + result.accepted_off_map
    assert result.accepted_wrong == 1 + result.accepted_off_map
    assert result.t_encode_s > 0
    assert result.t_match_per_ref_s == pytest.approx(result.t_match_s / 8)
    assert 0 < result.u_encode <= 1
    assert result.ah_total > 0
    assert "4S5200" in result.ah_assumes
    sizes = {"hog": 7 * 7 * 36 * 2 + 26, "cohog": 144 + 26}  # with number, position and heading
    assert result.descriptor_bytes == sizes[name]


def test_evaluate_counts_a_match_accepted_off_the_map(folder):
    # Its twin is in the map, and the truth has no place for it.
    cv2.imwrite(str(folder / "ref" / "r7.png"), draw_texture(7))
    result = evaluate(folder, "cohog", COHOG)
    assert (result.accepted_off_map, result.accepted_wrong, result.accepted_elsewhere) == (1, 2, 2)


def test_evaluate_ignores_a_loose_reference_and_counts_the_next(folder):
    # The only query looks exactly like r0, which is neither right nor wrong; r1 would be wrong, all others right.
    others = " ".join(f"r{place}.png" for place in range(2, 8))
    (folder / "truth.csv").write_text(f"query_file,ref_files,ref_files_loose\nq0.png,{others},r0.png {others}\n")
    cv2.imwrite(str(folder / "ref" / "r2.png"), cv2.blur(draw_texture(0), (3, 3)))
    result = evaluate(folder, "hog", HOG)
    assert (result.recall_at_1, result.with_match, result.unscored) == (1, None, 7)
    assert (result.accepted, result.accepted_wrong) == (1, 0)


def test_evaluate_reports_failed_steps_of_the_map(folder, monkeypatch):
    monkeypatch.setattr(finishing, "calibrate_map", Mock(side_effect=UsageError("no SciPy")))
    result = evaluate(folder, "cohog", COHOG)
    (note,) = result.not_done
    assert "no SciPy" in note
    assert note in format_results(add_pcu([result]))
    assert evaluate(folder, "hog", HOG).not_done == (), "it has no confidence to calibrate"


@pytest.mark.parametrize(("name", "settings"), [("hog", {"form": "1bit"}), ("cohog", {"camera": "nadir", "w1": 208})])
def test_evaluate_counts_as_many_bytes_a_place_as_probe(folder, name, settings):
    result, costs = evaluate(folder, name, settings), measure_costs(create(name, settings))
    assert (result.descriptor_bytes, result.fine_bytes) == (costs.ram_bytes_per_place, costs.disk_bytes_per_place)
