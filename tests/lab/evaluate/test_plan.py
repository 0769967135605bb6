"""Plans of many sets and rows are read strictly."""

import pytest
from generated_sets import make_set

from edgevpr.core.errors import UsageError
from edgevpr.core.text import progress
from edgevpr.lab.evaluate.plan import read_plan


def plan(tmp_path, text):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    return read_plan(path)


SETS = "sets: {meadow: {folder: meadow}}\n"
ROWS = "rows: {hog: {technique: hog}}\n"


def test_a_plan_names_sets_beside_its_file_and_rows(tmp_path):
    make_set(tmp_path / "meadow")
    found = plan(
        tmp_path,
        "sets:\n  meadow: {folder: meadow, camera: nadir}\n  same: {query: meadow/query, ref: meadow/ref,"
        " ground_truth: meadow/ground_truth.csv, within_m: 10}\n"
        "rows:\n  fast: {technique: cohog, parameters: {w1: 208}, candidates: 5, follow: true}\n"
        "  byte: {technique: hog, form: 8bit, exact: true}\n",
    )
    assert [len(each.open(tmp_path, progress).queries) for each in found.sets.values()] == [5, 5]
    assert found.rows["fast"].settings("nadir") == {"camera": "nadir", "w1": "208"}
    assert found.rows["byte"].settings("nadir") == {"form": "8bit"}
    assert (found.rows["fast"].candidates, found.rows["fast"].follow) == (5, True)
    assert found.rows["byte"].exact


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SETS, "`rows` needs at least one name"),
        (SETS + "rows: []", "`rows` needs at least one name"),
        ("set: {a: {folder: a}}\n" + ROWS, "did you mean `sets`?"),
        ("sets: {a: folder}\n" + ROWS, "`sets` needs at least one name"),
        ("sets: {a: {folders: a}}\n" + ROWS, "unknown key `sets.a.folders` (did you mean `folder`?)"),
        ("sets: {a: {}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {query: b}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {folder: b, ref: c}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {folder: b, ground_truth: c}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {folder: b, camera: nadirr}}\n" + ROWS, "write nadir or forward"),
        ("sets: {a: {folder: b, within_m: -1}}\n" + ROWS, "`sets.a.within_m` is -1; it must be between"),
        (SETS + "rows: {a: {}}", "the key `rows.a.technique` is missing"),
        (SETS + "rows: {a: {technique: hog, exact: 1}}", "must be true or false"),
        (SETS + "rows: {a: {technique: hog, candidates: 0}}", "it must be between"),
    ],
)
def test_a_wrong_plan_gets_one_sentence(tmp_path, text, said):
    with pytest.raises(UsageError) as wrong:
        plan(tmp_path, text)
    assert said in str(wrong.value)
    assert "\n" not in str(wrong.value)
