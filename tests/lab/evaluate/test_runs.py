"""Several rows on several sets: what is measured, what is written, and runs that are killed and started again."""

import csv
import json
import subprocess
import sys
import time

import pytest
from generated_sets import make_set, without_costs

from edgevpr.cli.main import main

HOG = ["--techniques", "hog", "--param", "hog.w1=64"]


def run(*argv):
    return main(["eval", *map(str, argv)])


def list_results(folder):
    return {path: path.stat().st_mtime_ns for path in (folder / "measured").glob("*.json")}


def read_answers(folder):
    """The answers of the newest result, by query."""
    newest = max((folder / "measured").glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    return {answer["query"]: answer for answer in json.loads(newest.read_text())["answers"]}


@pytest.mark.slow
def test_eval_writes_every_row_of_every_set_with_its_origin(tmp_path, capsys):
    sets = [make_set(tmp_path / name) for name in ("meadow", "town")]
    flags = ["--techniques", "hog,cohog", "--form", "float,1bit", "--param", "hog.w1=64", "--param", "cohog.w1=208"]
    assert run("--data", *sets, "--out", tmp_path / "out", *flags, "--json") == 0
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    assert content == json.loads(capsys.readouterr().out)
    rows = ["hog", "hog 1bit", "cohog"]
    assert [(row["set"], row["row"]) for row in content["results"]] == [
        (on, row) for on in ("meadow", "town") for row in rows
    ]
    for row in content["results"]:
        assert row["made"]["machine"]["cpu"] == content["machine"]["cpu"]
        assert row["made"]["versions"]["numpy"] == content["versions"]["numpy"]
        assert (row["queries"], row["queries_off_map"], row["unscored"]) == (5, 1, 1)
        assert row["pcu"] > 0
    with open(tmp_path / "out" / "results.csv") as handle:
        lines = list(csv.DictReader(handle))
    assert [line["row"] for line in lines] == rows * 2
    for line, row in zip(lines, content["results"], strict=True):
        assert float(line["with_match.recall_at_1"]) == row["with_match"]["recall_at_1"]


@pytest.mark.slow
@pytest.mark.parametrize("change", [None, "query", "truth"])
def test_eval_measures_again_only_what_has_changed(tmp_path, change):
    meadow, out = make_set(tmp_path / "meadow"), tmp_path / "out"
    assert run("--data", meadow, "--out", out, *HOG) == 0
    before = list_results(out)
    if change == "query":
        (meadow / "query" / "q3.png").write_bytes((meadow / "query" / "q0.png").read_bytes())
    elif change == "truth":
        truth = meadow / "ground_truth.csv"
        truth.write_text(truth.read_text().replace("q0.png,r0.png", "q0.png,r5.png"))
    assert run("--data", meadow, "--out", out, *HOG) == 0
    assert before.items() <= list_results(out).items()
    assert len(list_results(out)) == (1 if change is None else 2)
    answers = read_answers(out)
    assert answers["q3.png"]["found"] == ("r0.png" if change == "query" else "r3.png")
    assert (answers["q0.png"]["first_right"] == 0) == (change != "truth")


@pytest.mark.process
@pytest.mark.slow
def test_eval_resumes_a_run_that_was_killed(tmp_path):
    out, flags = tmp_path / "out", ["--data", str(make_set(tmp_path / "long", places=24)), "--techniques", "hog,cohog"]
    with subprocess.Popen(
        [sys.executable, "-m", "edgevpr", "eval", "--out", str(out), *flags], stderr=subprocess.PIPE
    ) as process:
        while not list_results(out):  # then the second row is at work
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.005)
        process.kill()
    assert not (out / "results.json").exists()
    kept = list_results(out)
    for folder in (out, tmp_path / "whole"):  # the second is not interrupted
        assert run("--out", folder, *flags) == 0
    assert kept.items() <= list_results(out).items()
    resumed, whole = (json.loads((folder / "results.json").read_text()) for folder in (out, tmp_path / "whole"))
    assert without_costs(resumed) == without_costs(whole)


@pytest.mark.slow
def test_eval_fails_only_the_rows_of_a_set_with_a_broken_picture(tmp_path, capsys):
    broken = make_set(tmp_path / "broken")
    (broken / "ref" / "r1.png").write_bytes(b"")
    assert run("--data", broken, make_set(tmp_path / "meadow"), *HOG, "--json") == 1
    said = capsys.readouterr()
    assert "broken, hog" in said.err
    content = json.loads(said.out)
    assert [row["set"] for row in content["results"]] == ["meadow"]
    assert [row["set"] for row in content["failed"]] == ["broken"]
    assert run("--data", broken, *HOG) == 1, "nothing was measured"
    assert "r1.png" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--out", "out"], "--data"),
        (["--data", "SET", "--ground-truth", "truth.csv"], "--ground-truth goes with"),
        (["--data", "gone"], "gone"),
        (["--data", "SET", "--techniques", "cohogg"], "cohogg"),
        (["--data", "SET", "--form", "2bit"], "2bit"),
        (["--data", "SET", "--param", "calc.model=x"], "with a technique of --techniques"),
    ],
)
def test_eval_refuses_a_wrong_request_in_one_sentence(tmp_path, monkeypatch, capsys, argv, said):
    monkeypatch.chdir(tmp_path)
    meadow = str(make_set(tmp_path / "meadow"))
    assert run(*[meadow if word == "SET" else word for word in argv]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
