"""Stored similarities are measured without any image, and come out as published."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run_json

_DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).parents[4] / "shared" / "data")
_PUBLISHED = _DATA / "vprbench_precomputed"
TRUTH = "query_file,ref_files,ref_files_loose,status\nq2,r2,r10,ok\nq1,r1 r2,,ok\nq3,r1,,moved\n"


@pytest.fixture
def truth(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text(TRUTH)
    return path


@pytest.mark.data
def test_assess_quality_gives_the_published_figures_of_eight_matrices(capsys):
    if not _PUBLISHED.is_dir():
        pytest.skip("the published matrices are not here")
    with open(_PUBLISHED / "corridor_figures.csv") as handle:
        published = {row.pop("technique"): row for row in csv.DictReader(handle)}
    files = [str(_PUBLISHED / f"corridor_{name}.npy") for name in published]
    truth = str(_DATA / "corridor" / "ground_truth.csv")
    found = run_json(capsys, "eval", "--similarity", *files, "--ground-truth", truth)["similarities"]
    ours = {"auc_eq_2_3": "auc_2_3", "auc_scikit_learn": "auc_from_zero"}
    assert len(found) == 8
    for name, row in published.items():
        for figure, value in row.items():
            if not figure.startswith("t_"):
                assert found[f"corridor_{name}"][ours.get(figure, figure)] == pytest.approx(float(value), abs=5e-4)
    calc = found["corridor_CALC"]
    assert calc["recall_at_100_precision_vpr_bench"] == pytest.approx(8 / 36)
    assert calc["recall_at_100_precision_vpr_tutorial"] == pytest.approx(8 / 111)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (np.zeros((2, 3)), "scores for 2 queries and 3 references, but the ground truth has 3 and 3"),
        (np.zeros(3), "one row per query"),
        (np.full((3, 3), np.nan), "without NaN"),
        (np.array([[None]]), "contains no similarities"),
        (b"rubbish", "contains no similarities"),
    ],
)
def test_assess_quality_refuses_inconsistent_input_in_one_sentence(tmp_path, truth, capsys, content, said):
    path = tmp_path / "a.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content, allow_pickle=True)
    assert said in refused(capsys, "eval", "--similarity", path, "--ground-truth", truth, is_alone=True)


def test_assess_quality_counts_queries_off_the_map_and_breaks_ties_by_order(tmp_path, truth, capsys):
    truth.write_text("query_file,ref_files,ref_files_loose\nq1,r1,\nq2,r2,\nq3,,\nq4,,r1 r2\n")
    np.save(tmp_path / "a.npy", [[0.9, 0.1], [0.5, 0.5], [0.7, 0.2], [0.1, 0.8]])
    found = run_json(capsys, "eval", "--similarity", tmp_path / "a.npy", "--ground-truth", truth)["similarities"]["a"]
    assert (found["queries"], found["queries_off_map"], found["recall_at_1"]) == (4, 2, 0.25)
    assert (found["auc_from_zero"], found["roc_auc"]) == (1, 1), "q1 is right and scores best, q4 finds nothing"
    assert (found["with_match"]["queries"], found["with_match"]["recall_at_1"]) == (2, 0.5)


def test_assess_quality_uses_all_images_of_the_folders(tmp_path, truth, capsys):
    for folder, names in (("query", ["q1", "q2", "q3", "q4"]), ("ref", ["r1", "r2", "r10", "r11"])):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / f"{name}.png").touch()
    rows = "query_file,ref_files\n" + "".join(f"q{n}.png,r{n}.png\n" for n in (1, 2))
    truth.write_text(rows)
    np.save(tmp_path / "a.npy", np.eye(4))
    flags = ["--query", str(tmp_path / "query"), "--ref", str(tmp_path / "ref"), "--ground-truth", str(truth)]
    found = run_json(capsys, "eval", "--similarity", tmp_path / "a.npy", *flags)["similarities"]["a"]
    assert (found["queries"], found["references"], found["recall_at_1"], found["unscored"]) == (2, 4, 1.0, 2)
    truth.write_text(rows + "q9.png,r1.png\n")
    assert "`q9.png`, which is not in --query" in refused(capsys, "eval", "--similarity", tmp_path / "a.npy", *flags)
