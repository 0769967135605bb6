"""Many rows on many sets: real workers, killed and started again."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from generated_sets import COHOG, HOG, make_set, without_costs

from edgevpr.cli.main import main
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate
from edgevpr.lab.evaluate.many import measure
from edgevpr.lab.evaluate.page import as_json
from edgevpr.lab.evaluate.plan import EvaluationPlan, RowPlan, SetPlan

pytestmark = [pytest.mark.process, pytest.mark.slow]
ROWS = {
    "cohog": RowPlan(technique="cohog", parameters=COHOG),
    "cohog, exact": RowPlan(technique="cohog", parameters=COHOG, exact=True),
    "cohog, followed": RowPlan(technique="cohog", parameters=COHOG, follow=True),
    "hog 8bit": RowPlan(technique="hog", parameters=HOG, form="8bit"),
    "seqslam of 2": RowPlan(technique="seqslam", sequence=2),
}
ONLY_HOG = {"hog 8bit": ROWS["hog 8bit"]}


def shown(items, total, label):
    return items


def plan_of(*folders, rows=ROWS):
    return EvaluationPlan({folder.name: SetPlan(folder=str(folder)) for folder in folders}, rows)


def content_of(outcome):
    return json.loads(json.dumps(as_json(outcome)))


def results_in(folder):
    return {path: path.stat().st_mtime_ns for path in (folder / "measured").glob("*.json")}


@pytest.fixture(scope="module")
def meadow(tmp_path_factory):
    return make_set(tmp_path_factory.mktemp("sets") / "meadow")


@pytest.fixture(scope="module")
def measured(meadow, tmp_path_factory):
    """The outcome on the meadow with one worker, and the folder of its results."""
    folder = tmp_path_factory.mktemp("out")
    return measure(plan_of(meadow), folder, 1, shown), folder


def test_a_row_is_measured_as_by_itself(measured, meadow):
    outcome, _ = measured
    dataset = load_dataset(meadow / "query", meadow / "ref", meadow / "ground_truth.csv")
    alone = replace(outcome.rows[0], result=evaluate("cohog", dataset, COHOG))
    alone = content_of(replace(outcome, found={"meadow": [alone]}))
    assert without_costs(alone) == without_costs(content_of(outcome))[:1]
    assert [row.label for row in outcome.rows] == list(ROWS)


def test_what_is_there_is_not_measured_now(measured, meadow):
    outcome, folder = measured
    before = results_in(folder)
    assert measure(plan_of(meadow), folder, 2, shown).rows == outcome.rows, "with the costs of then"
    assert results_in(folder) == before
    assert len(before) == len(ROWS)


@pytest.mark.parametrize("change", ["query", "truth"])
def test_what_decides_a_result_is_measured_anew(tmp_path, change):
    own = make_set(tmp_path / "own")
    plan = plan_of(own, rows=ONLY_HOG)
    measure(plan, tmp_path, 1, shown)
    if change == "query":
        (own / "query" / "q3.png").write_bytes((own / "query" / "q0.png").read_bytes())
    else:
        truth = own / "ground_truth.csv"
        truth.write_text(truth.read_text().replace("q5.png,r0.png", "q5.png,r5.png"))
    (found,) = measure(plan, tmp_path, 1, shown).rows
    assert len(results_in(tmp_path)) == 2
    answers = {answer.query: answer for answer in found.answers}
    assert answers["q3.png"].found == ("r0.png" if change == "query" else "r3.png")
    assert answers["q5.png"].is_right == (change == "truth")


def arguments(folder, out, *flags):
    return [str(each) for each in ("eval", "--data", folder, "--out", out, "--techniques", "cohog,hog", *flags)]


def command(folder, out, *flags):
    argv = [sys.executable, "-m", "edgevpr", *arguments(folder, out, *flags)]
    return subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def workers_of(pid):
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(each) for each in children if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()]


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def begun(folder, out):
    """A run of two workers that has written one result and is at work on another."""
    process = command(folder, out, *LONG_FLAGS)
    while not results_in(out):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    return process


LONG_FLAGS = ["--param", "cohog.w1=208", "--exact", "--workers", "2"]


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    return make_set(tmp_path_factory.mktemp("sets") / "long", places=24)


@pytest.fixture(scope="module")
def whole(long, tmp_path_factory):
    """The results on the long set of a run that nobody stopped."""
    out = tmp_path_factory.mktemp("whole")
    assert main(arguments(long, out, *LONG_FLAGS)) == 0
    return json.loads((out / "results.json").read_text())


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path, long, whole):
    out = tmp_path / "out"
    process = begun(long, out)
    workers = workers_of(process.pid)
    process.kill()
    said = process.communicate()[1].decode()
    assert workers
    while any(map(is_running, workers)):
        time.sleep(0.01)
    assert "Traceback" not in said
    assert not (out / "results.json").exists()
    kept = results_in(out)
    assert main(arguments(long, out, *LONG_FLAGS)) == 0
    assert kept.items() <= results_in(out).items()
    assert without_costs(json.loads((out / "results.json").read_text())) == without_costs(whole)


def test_a_picture_that_cannot_be_used_fails_the_rows_of_its_set_only(meadow, tmp_path):
    broken = make_set(tmp_path / "broken")
    (broken / "ref" / "r2.png").write_bytes(b"")
    outcome = measure(plan_of(broken, meadow, rows=ONLY_HOG), tmp_path, 2, shown)
    assert {name: len(rows) for name, rows in outcome.found.items()} == {"broken": 0, "meadow": 1}
    assert "r2.png" in outcome.failed["broken", "hog 8bit"]
