"""Many rows on many sets: plans, real workers that are killed and started again, and the files and the page."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from generated_sets import COHOG, HOG, make_set, without_costs

from edgevpr.cli.main import main
from edgevpr.core.errors import UsageError
from edgevpr.core.text import progress
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate, iterate_silently
from edgevpr.lab.evaluate.many import measure
from edgevpr.lab.evaluate.plan import EvaluationPlan, RowPlan, SetPlan, read_plan

ONLY_HOG = {"hog 8bit": RowPlan(technique="hog", parameters=HOG, form="8bit")}
LABEL = "<script>alert(1)</script><img src=http://example.test/x.png>"
PLAN = f"""
sets:
  meadow: {{folder: meadow}}
  "{LABEL}": {{folder: meadow, camera: nadir}}
rows:
  cohog: {{technique: cohog, parameters: {{w1: 208}}}}
  "cohog, exact": {{technique: cohog, parameters: {{w1: 208}}, exact: true}}
  "cohog, followed": {{technique: cohog, parameters: {{w1: 208}}, follow: true}}
  "hog|{LABEL}": {{technique: hog, parameters: {{w1: 64}}, form: 1bit}}
  seqslam of 2: {{technique: seqslam, sequence: 2}}
"""
LONG_FLAGS = ["--techniques", "cohog,hog", "--param", "cohog.w1=208", "--exact", "--workers", "2"]


def run(*argv):
    return main(["eval", *map(str, argv)])


def plan_of(*folders):
    return EvaluationPlan({folder.name: SetPlan(folder=str(folder)) for folder in folders}, ONLY_HOG)


def list_results(folder):
    return {path: path.stat().st_mtime_ns for path in (folder / "measured").glob("*.json")}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A folder with the results of two sets by five rows."""
    folder = tmp_path_factory.mktemp("results")
    make_set(folder / "meadow")
    (folder / "plan.yaml").write_text(PLAN)
    assert run("--sets", folder / "plan.yaml", "--out", folder / "out", "--workers", "1") == 0
    return folder / "out"


@pytest.mark.process
@pytest.mark.slow
def test_measure_gives_each_row_as_by_itself_with_its_origin(out):
    meadow = out.parent / "meadow"
    content = json.loads((out / "results.json").read_text())
    assert [row["row"] for row in content["results"][:5]] == list(read_plan(out.parent / "plan.yaml").rows)
    alone = evaluate("cohog", load_dataset(meadow / "query", meadow / "ref", meadow / "ground_truth.csv"), COHOG)
    row = content["results"][0]
    assert (row["recall_at_1"], row["auc"], row["accepted"]) == (alone.recall_at_1, alone.auc, alone.accepted)
    for row in content["results"]:
        assert row["made"]["machine"]["cpu"] == content["machine"]["cpu"]
        assert row["made"]["versions"]["edgevpr"] == content["versions"]["edgevpr"]
        assert row["queries"] == 5
        assert row["recall_at_k"][0] == row["recall_at_1"]
        assert row["recall_at_k"] == sorted(row["recall_at_k"])
        assert row["pcu"] > 0


@pytest.mark.process
@pytest.mark.slow
def test_format_page_shows_curves_and_the_worst_matches_and_runs_no_script(out):
    page = (out / "index.html").read_text()
    scores = re.findall(r'<div class="match wrong"><p>.*?score ([\d.e-]+)', page.split("<details")[1])
    assert scores
    assert list(map(float, scores)) == sorted(map(float, scores), reverse=True)
    first = re.search(r'<div class="match wrong">.*?</div></div>', page)[0]
    assert re.findall(r'src="data:image/jpeg;base64,[^"]+"><figcaption>(\w+): ', first) == ["query", "found", "right"]
    assert page.count("Precision over recall") == 4  # of two sets: the caption, and the label of the drawing
    assert "<script" not in page


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.parametrize("change", [None, "query", "truth"])
def test_measure_repeats_only_what_has_changed(tmp_path, change):
    meadow = make_set(tmp_path / "meadow")
    first = measure(plan_of(meadow), tmp_path, 1, iterate_silently)
    before = list_results(tmp_path)
    if change == "query":
        (meadow / "query" / "q3.png").write_bytes((meadow / "query" / "q0.png").read_bytes())
    elif change == "truth":
        truth = meadow / "ground_truth.csv"
        truth.write_text(truth.read_text().replace("q5.png,r0.png", "q5.png,r5.png"))
    second = measure(plan_of(meadow), tmp_path, 2, iterate_silently)
    assert before.items() <= list_results(tmp_path).items()
    assert len(list_results(tmp_path)) == (1 if change is None else 2)
    assert (second.rows == first.rows) == (change is None)
    answers = {answer.query: answer for answer in second.rows[0].answers}
    assert answers["q3.png"].found == ("r0.png" if change == "query" else "r3.png")
    assert answers["q5.png"].is_right == (change == "truth")


def workers_of(pid):
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.process
@pytest.mark.slow
def test_measure_resumes_a_run_that_was_killed(tmp_path):
    long, out = make_set(tmp_path / "long", places=24), tmp_path / "out"
    flags = ["--data", str(long), *LONG_FLAGS]
    process = subprocess.Popen(
        [sys.executable, "-m", "edgevpr", "eval", "--out", str(out), *flags],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    while not list_results(out):  # then another is at work
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    workers = workers_of(process.pid)
    process.kill()
    assert "Traceback" not in process.communicate()[1].decode()
    assert workers
    while any(map(is_running, workers)):
        time.sleep(0.01)
    assert not (out / "results.json").exists()
    kept = list_results(out)
    for folder in (out, tmp_path / "whole"):  # the second is not interrupted
        assert run("--out", folder, *flags) == 0
    assert kept.items() <= list_results(out).items()
    resumed, whole = (json.loads((folder / "results.json").read_text()) for folder in (out, tmp_path / "whole"))
    assert without_costs(resumed) == without_costs(whole)


@pytest.mark.process
@pytest.mark.slow
def test_measure_fails_only_the_rows_of_a_set_with_a_broken_picture(tmp_path, capsys):
    broken = make_set(tmp_path / "broken")
    (broken / "ref" / "r1.png").write_bytes(b"")
    flags = ["--techniques", "hog", "--param", "hog.w1=64", "--workers", "1"]
    assert run("--data", broken, make_set(tmp_path / "meadow"), "--out", tmp_path / "out", *flags) == 1
    assert "broken, hog" in capsys.readouterr().err
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [row["set"] for row in content["results"]] == ["meadow"]
    assert [row["set"] for row in content["failed"]] == ["broken"]
    assert "r1.png" in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--data", "SET", "SET"], "--out"),
        (["--sets", "plan.yaml"], "--out"),
        (["--data", "SET", "--workers", "2"], "--out"),
        (["--out", "out"], "--data"),
        (["--data", "SET", "--out", "out", "--ground-truth", "truth.csv"], "--ground-truth goes with"),
        (["--sets", "plan.yaml", "--data", "SET", "--out", "out"], "--rate-hz"),
        (["--data", "gone", "--out", "out"], "gone"),
        (["--data", "SET", "--out", "out", "--techniques", "cohogg"], "cohogg"),
        (["--data", "SET", "--out", "out", "--salience"], "--salience"),
    ],
)
def test_eval_refuses_a_wrong_request_in_one_sentence(tmp_path, monkeypatch, capsys, argv, said):
    monkeypatch.chdir(tmp_path)
    meadow = str(make_set(tmp_path / "meadow"))
    assert run(*[meadow if word == "SET" else word for word in argv]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


def test_read_plan_starts_paths_at_the_folder_of_the_file(tmp_path):
    make_set(tmp_path / "meadow")
    (tmp_path / "plan.yaml").write_text(
        "sets:\n  meadow: {folder: meadow, camera: nadir}\n  same: {query: meadow/query, ref: meadow/ref,"
        " ground_truth: meadow/ground_truth.csv, within_m: 10}\n"
        "rows:\n  fast: {technique: cohog, parameters: {w1: 208}, candidates: 5, follow: true}\n"
        "  byte: {technique: hog, form: 8bit, exact: true}\n"
    )
    plan = read_plan(tmp_path / "plan.yaml")
    assert [len(set_plan.open(tmp_path, progress).queries) for set_plan in plan.sets.values()] == [5, 5]
    assert plan.rows["fast"].settings("nadir") == {"camera": "nadir", "w1": "208"}
    assert plan.rows["byte"].settings("nadir") == {"form": "8bit"}
    assert (plan.rows["fast"].candidates, plan.rows["fast"].follow, plan.rows["byte"].exact) == (5, True, True)


SETS = "sets: {meadow: {folder: meadow}}\n"
ROWS = "rows: {hog: {technique: hog}}\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SETS, "`rows` needs at least one name"),
        ("set: {a: {folder: a}}\n" + ROWS, "did you mean `sets`?"),
        ("sets: {a: folder}\n" + ROWS, "`sets` needs at least one name"),
        ("sets: {a: {folders: a}}\n" + ROWS, "unknown key `sets.a.folders` (did you mean `folder`?)"),
        ("sets: {a: {}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {query: b}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {folder: b, ground_truth: c}}\n" + ROWS, "needs either `folder`, which has its own"),
        ("sets: {a: {folder: b, within_m: -1}}\n" + ROWS, "`sets.a.within_m` is -1; it must be between"),
        (SETS + "rows: {a: {technique: hog, exact: 1}}", "must be true or false"),
    ],
)
def test_read_plan_refuses_a_wrong_plan_in_one_sentence(tmp_path, text, said):
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(UsageError) as wrong:
        read_plan(tmp_path / "plan.yaml")
    assert said in str(wrong.value)
    assert "\n" not in str(wrong.value)
