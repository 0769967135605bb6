"""Several rows on several sets: what is measured, and what is refused."""

import json

import pytest
from commands import expect_refusal, run, run_json
from generated_sets import make_set

HOG = ["--techniques", "hog", "--param", "hog.w1=64"]


@pytest.mark.slow
def test_eval_prints_every_row_of_every_set_with_its_answers(tmp_path, capsys):
    sets = [make_set(tmp_path / name) for name in ("meadow", "town")]
    flags = ["--techniques", "hog,cohog", "--form", "float,1bit", "--param", "hog.w1=64", "--param", "cohog.w1=208"]
    content = run_json(capsys, "eval", "--data", *sets, *flags)
    assert content["machine"]["cpu"]
    assert content["versions"]["numpy"]
    asked = [(on, row) for on in ("meadow", "town") for row in ("hog", "hog 1bit", "cohog")]
    assert [(row["set"], row["row"]) for row in content["results"]] == asked
    for row in content["results"]:
        assert (row["queries"], row["queries_off_map"], row["unscored"]) == (5, 1, 1)
        assert row["pcu"] > 0
        assert len(row["answers"]) == row["queries"]
        assert sum(answer["first_right"] == 0 for answer in row["answers"]) == row["recall_at_1"] * row["queries"]


@pytest.mark.slow
def test_eval_fails_only_the_rows_of_a_set_with_a_broken_picture(tmp_path, capsys):
    broken = make_set(tmp_path / "broken")
    (broken / "ref" / "r1.png").write_bytes(b"")
    assert run("eval", "--data", broken, make_set(tmp_path / "meadow"), *HOG, "--json") == 1
    said = capsys.readouterr()
    assert "r1.png" in said.err
    content = json.loads(said.out)
    assert [row["set"] for row in content["results"]] == ["meadow"]
    assert [(row["set"], row["row"]) for row in content["failed"]] == [("broken", "hog")]
    assert "r1.png" in expect_refusal(capsys, "eval", "--data", broken, *HOG, code=1), "nothing was measured"


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "--data"),
        (["--data", "SET", "--ground-truth", "truth.csv"], "--ground-truth applies"),
        (["--data", "gone"], "gone"),
        (["--data", "SET", "--techniques", "cohogg"], "cohogg"),
        (["--data", "SET", "--form", "2bit"], "2bit"),
        (["--data", "SET", "--param", "calc.model=x"], "with a technique from --techniques"),
    ],
)
def test_eval_refuses_a_wrong_request_in_one_sentence(tmp_path, monkeypatch, capsys, argv, said):
    monkeypatch.chdir(tmp_path)
    meadow = make_set(tmp_path / "meadow")
    assert said in expect_refusal(capsys, "eval", *[meadow if word == "SET" else word for word in argv])
