"""Stored similarities are measured without any image, and come out as published."""

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

from edgevpr.cli.main import main
from edgevpr.errors import UsageError
from edgevpr.evaluate.similarity import measure, read_similarities
from edgevpr.evaluate.truth import read_truth

_DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).parents[3] / "shared" / "data")
_PUBLISHED = _DATA / "vprbench_precomputed"
TRUTH = "query_file,ref_files,ref_files_loose,status\nq2,r2,r10,ok\nq1,r1 r2,,ok\nq3,r1,,moved\n"
SCORES = np.array([[0.1, 0.2, 0.9], [0.7, 0.3, 0.2], [0.5, 0.5, 0.5]])  # of q2, q1, q3 with r1, r2, r10


@pytest.fixture
def truth(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text(TRUTH)
    return path


def test_eight_published_matrices_come_out_as_published(capsys):
    if not _PUBLISHED.is_dir():
        pytest.skip("the published matrices are not here")
    with open(_PUBLISHED / "corridor_figures.csv") as handle:
        published = {row.pop("technique"): row for row in csv.DictReader(handle)}
    files = [str(_PUBLISHED / f"corridor_{name}.npy") for name in published]
    truth = str(_DATA / "corridor" / "ground_truth.csv")
    assert main(["eval", "--similarity", *files, "--ground-truth", truth, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["similarities"]
    ours = {"auc_eq_2_3": "auc", "auc_scikit_learn": "auc_from_zero"}
    assert len(found) == 8
    for name, row in published.items():
        for figure, value in row.items():
            if not figure.startswith("t_"):
                assert found[f"corridor_{name}"][ours.get(figure, figure)] == pytest.approx(float(value), abs=5e-4)
        low, high = found[f"corridor_{name}"]["recall_at_1_interval"]
        assert low < found[f"corridor_{name}"]["recall_at_1"] < high


def test_every_form_says_the_same_and_loose_hits_and_what_is_not_ok_do_not_count(tmp_path, truth):
    np.save(tmp_path / "a.npy", SCORES)
    names = {"queries": ["q1", "q2", "q3"], "references": ["r10", "r2", "r1"]}
    turned = SCORES[[1, 0, 2]][:, [2, 1, 0]]
    np.savez(tmp_path / "b.npz", similarity=turned, **names)
    lines = [
        ",r10,r2,r1",
        *(f"{q}," + ",".join(map(str, row)) for q, row in zip(names["queries"], turned, strict=True)),
    ]
    (tmp_path / "c.csv").write_text("\n".join(lines))
    (tmp_path / "d.csv").write_text("\n".join(",".join(map(str, row)) for row in SCORES))
    for name in ("a.npy", "b.npz", "c.csv", "d.csv"):
        found = measure(name, read_similarities(tmp_path / name), read_truth(truth))
        assert (found.queries, found.references, found.recall_at_1) == (2, 3, 1.0), name


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (np.zeros((2, 3)), "scores of 2 queries, and the ground truth names 3"),
        (np.zeros((3, 4)), "name the folder of all of them with --ref"),
        (np.zeros(3), "a row for each query"),
        (np.full((3, 3), np.nan), "give each pair a score"),
        (np.array([["a", "b"]]), "a row for each query"),
        (np.array([[None]]), "holds no similarities"),
        (b"rubbish", "holds no similarities"),
        (b"", "holds no similarities"),
    ],
)
def test_what_does_not_fit_is_said_in_a_sentence(tmp_path, truth, capsys, content, said):
    path = tmp_path / "a.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content, allow_pickle=True)
    assert main(["eval", "--similarity", str(path), "--ground-truth", str(truth)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_names_that_do_not_fit_are_refused(tmp_path, truth):
    np.savez(tmp_path / "a.npz", similarity=SCORES, queries=["q1", "q2", "q2"], references=["r1", "r2", "r10"])
    with pytest.raises(UsageError, match="name each once"):
        read_similarities(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", similarity=SCORES, queries=["q1", "q2", "q3"], references=["r1", "r3", "r10"])
    with pytest.raises(UsageError, match="`r2`, of which there are no scores"):
        measure("b", read_similarities(tmp_path / "b.npz"), read_truth(truth))


def test_without_images_and_without_similarities_it_says_what_to_give(truth, capsys):
    assert main(["eval", "--ground-truth", str(truth)]) == 2
    assert "--similarity" in capsys.readouterr().err
