"""Many rows on many sets: real workers, killed and started again, with a cache that is damaged or shared."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from generated_sets import COHOG, HOG, make_set, without_costs

from edgevpr.cli.main import main
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate
from edgevpr.lab.evaluate.kept import Kept
from edgevpr.lab.evaluate.many import measure
from edgevpr.lab.evaluate.output import as_json
from edgevpr.lab.evaluate.plan import Plan, RowPlan, SetPlan

ROWS = {
    "cohog": RowPlan(technique="cohog", parameters=COHOG),
    "cohog, exact": RowPlan(technique="cohog", parameters=COHOG, exact=True),
    "cohog, followed": RowPlan(technique="cohog", parameters=COHOG, follow=True),
    "hog 8bit": RowPlan(technique="hog", parameters=HOG, form="8bit"),
    "seqslam of 2": RowPlan(technique="seqslam", sequence=2),
}


def shown(items, total, label):
    return items


def plan_of(*folders, rows=ROWS):
    return Plan({folder.name: SetPlan(folder=str(folder)) for folder in folders}, rows)


def entries(cache, kind):
    return {path: path.stat().st_mtime_ns for path in (cache / kind).rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def meadow(tmp_path_factory):
    return make_set(tmp_path_factory.mktemp("sets") / "meadow")


@pytest.fixture(scope="module")
def measured(meadow, tmp_path_factory):
    """The outcome on the meadow with one worker, and its cache."""
    cache = tmp_path_factory.mktemp("cache")
    return measure(plan_of(meadow), cache, 1, shown), cache


def test_a_row_is_measured_as_by_itself(measured, meadow):
    outcome, _ = measured
    dataset = load_dataset(meadow / "query", meadow / "ref", meadow / "ground_truth.csv")
    alone = evaluate("cohog", dataset, COHOG)
    found = outcome.found[0].result
    for name in (
        "recall_at_1",
        "recall_at_5",
        "auc",
        "ep",
        "accepted",
        "accepted_wrong",
        "precision_recall",
        "queries",
    ):
        assert getattr(found, name) == getattr(alone, name), name
    assert found.technique == "cohog"
    assert [each.label for each in outcome.found] == list(ROWS)


def test_only_what_is_scored_counts_and_a_loose_hit_counts_neither_way(measured):
    outcome, _ = measured
    answers = {each.query: each for each in outcome.found[0].answers}
    assert set(answers) == {"q0.png", "q1.png", "q3.png", "q4.png", "q5.png"}
    assert answers["q1.png"].found != "r1.png", "the loose one"
    assert answers["q5.png"].found == "r5.png"
    assert not answers["q5.png"].is_right
    assert answers["q0.png"].is_right


def test_several_workers_find_the_same(measured, meadow, tmp_path):
    outcome, _ = measured
    again = measure(plan_of(meadow), tmp_path / "cache", 3, shown)
    assert without_costs(as_json(again)) == without_costs(as_json(outcome))
    assert {each.made.workers for each in again.found} == {3}


def test_what_is_kept_is_not_measured_now_and_says_so(measured, meadow):
    outcome, cache = measured
    before = entries(cache, "pairs")
    again = measure(plan_of(meadow), cache, 2, shown)
    assert not any(each.made.was_kept for each in outcome.found)
    for each, first in zip(again.found, outcome.found, strict=True):
        assert each.made.was_kept
        assert each.made.workers == 1, "as when it was measured"
        assert each.result == first.result, "its costs are those of then"
    assert entries(cache, "pairs") == before
    assert entries(cache, "answers") == {}, "they stand in the result"


def test_a_changed_query_costs_what_it_must(measured, tmp_path):
    """A copy of the set is the same set; with one picture changed, all but that one are known."""
    _, cache = measured
    copy = make_set(tmp_path / "copy")
    rows = {"hog 8bit": ROWS["hog 8bit"]}
    assert measure(plan_of(copy, rows=rows), cache, 1, shown).found[0].made.was_kept
    before = entries(cache, "descriptors")
    picture = copy / "query" / "q3.png"
    picture.write_bytes((copy / "query" / "q0.png").read_bytes())
    found = measure(plan_of(copy, rows=rows), cache, 1, shown).found[0]
    assert not found.made.was_kept
    assert {each.query: each.found for each in found.answers}["q3.png"] == "r0.png"
    assert entries(cache, "descriptors") == before


def test_a_changed_truth_is_another_result(measured, tmp_path):
    _, cache = measured
    copy = make_set(tmp_path / "copy")
    truth = copy / "ground_truth.csv"
    truth.write_text(truth.read_text().replace("q5.png,r0.png", "q5.png,r5.png"))
    found = measure(plan_of(copy, rows={"hog 8bit": ROWS["hog 8bit"]}), cache, 1, shown).found[0]
    assert not found.made.was_kept
    assert {each.query: each.is_right for each in found.answers}["q5.png"]


@pytest.mark.parametrize("kind", ["pairs", "maps", "maps-files", "descriptors"])
def test_a_damaged_cache_is_noticed_and_made_anew(meadow, tmp_path, kind):
    plan = plan_of(meadow, rows={"cohog": ROWS["cohog"]})
    first = measure(plan, tmp_path, 1, shown)
    for path in entries(tmp_path, kind):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    if kind != "pairs":  # else nobody looks at it
        for path in entries(tmp_path, "pairs"):
            path.unlink()
    if kind == "descriptors":
        for path in entries(tmp_path, "maps"):
            path.unlink()
    again = measure(plan, tmp_path, 1, shown)
    assert again.damaged > 0
    assert again.failed == {}
    assert without_costs(as_json(again)) == without_costs(as_json(first))
    assert measure(plan, tmp_path, 1, shown).damaged == 0


def arguments(folder, out, *flags):
    return [str(each) for each in ("eval", "--data", folder, "--out", out, "--techniques", "cohog,hog", *flags)]


def command(folder, out, *flags, **more):
    argv = [sys.executable, "-m", "edgevpr", *arguments(folder, out, *flags)]
    return subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, **more)


def children_of(pid):
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def read(path):
    """The content of an entry, behind its mark and its checksum."""
    return json.loads(path.read_bytes()[len(b"edgevpr kept 1\n") + 32 :])


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path, how):
    folder, flags = make_set(tmp_path / "long", places=40), ["--param", "cohog.w1=208", "--exact", "--workers", "2"]
    process = command(folder, tmp_path / "out", *flags)
    cache = tmp_path / "out" / "cache"
    while len(entries(cache, "answers")) < 3:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    workers = children_of(process.pid)
    process.send_signal(how)
    process.wait()
    said = process.stderr.read().decode()
    process.stderr.close()
    assert workers
    while any(map(is_running, workers)):
        time.sleep(0.01)
    assert "Traceback" not in said
    assert not (tmp_path / "out" / "results.json").exists()
    kept = {kind: entries(cache, kind) for kind in ("answers", "descriptors", "maps")}
    assert len(kept["answers"]) >= 3

    # What was kept is taken as it is, with the costs of then.
    given = [read(path)[0] for path in kept["answers"]]
    assert main(arguments(folder, tmp_path / "out", *flags)) == 0
    told = [answer for path in entries(cache, "pairs") for answer in read(path)["answers"]]
    assert [answer for answer in given if answer not in told] == []
    for kind in ("descriptors", "maps"):
        now = entries(cache, kind)
        assert {path: now.get(path) for path in kept[kind]} == kept[kind]
    whole = tmp_path / "whole"
    assert main(arguments(folder, whole, *flags)) == 0
    results = [json.loads((each / "results.json").read_text()) for each in (tmp_path / "out", whole)]
    assert without_costs(results[0]) == without_costs(results[1])


def test_answers_that_are_kept_are_not_asked_again(meadow, tmp_path):
    plan = plan_of(meadow, rows={"cohog": ROWS["cohog"]})

    class Stop(Exception):
        pass

    def stopped(items, total, label):
        for _ in zip(items, range(2 * 6 + 1), strict=False):  # encoded, mapped, and the first answer that is told of
            pass
        raise Stop
        yield

    with pytest.raises(Stop):
        measure(plan, tmp_path, 1, lambda items, total, label: stopped(items, total, label))
    before = entries(tmp_path, "answers")
    assert before or entries(tmp_path, "maps")
    units = []
    measure(plan, tmp_path, 1, lambda items, total, label: units.append(total) or items)
    assert units in ([5 - len(before)], []), "nothing but what is missing"


@pytest.mark.parametrize("is_finished", [True, False])
def test_a_row_that_another_run_has_asked_meanwhile_is_not_lost(meadow, tmp_path, monkeypatch, is_finished):
    rows = {name: ROWS[name] for name in ("cohog", "cohog, followed", "seqslam of 2")}
    plan = plan_of(meadow, rows=rows)

    def overtaken(items, total, label):
        with monkeypatch.context() as patched:
            if not is_finished:
                patched.setattr(Kept, "drop", lambda *args: None)
            measure(plan, tmp_path, 1, shown)
        if not is_finished:
            shutil.rmtree(tmp_path / "pairs")
        return items

    outcome = measure(plan, tmp_path, 1, overtaken)
    assert ([each.label for each in outcome.found], outcome.failed) == (list(rows), {})


def test_two_runs_at_once_do_not_harm_each_other(meadow, tmp_path):
    flags = ["--param", "cohog.w1=208", "--workers", "2", "--cache", tmp_path / "cache"]
    processes = [command(meadow, tmp_path / name, *flags) for name in ("one", "other")]
    said = [process.communicate()[1].decode() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    one, other = (json.loads((tmp_path / name / "results.json").read_text()) for name in ("one", "other"))
    assert without_costs(one) == without_costs(other)


def test_a_picture_that_cannot_be_used_fails_its_set_only(meadow, tmp_path):
    broken = make_set(tmp_path / "broken")
    (broken / "ref" / "r2.png").write_bytes(b"")
    outcome = measure(
        plan_of(broken, meadow, rows={"hog": RowPlan(technique="hog", parameters=HOG)}), tmp_path, 2, shown
    )
    assert [each.set_name for each in outcome.found] == ["meadow"]
    (why,) = outcome.failed.values()
    assert "r2.png is empty" in why


def test_a_broken_query_fails_its_rows_and_not_the_map(tmp_path):
    broken = make_set(tmp_path / "broken")
    (broken / "query" / "q3.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    outcome = measure(plan_of(broken, rows={"hog": RowPlan(technique="hog", parameters=HOG)}), tmp_path / "c", 1, shown)
    assert outcome.found == ()
    assert "q3.png" in outcome.failed["broken", "hog"]
    assert len(entries(tmp_path / "c", "maps")) == 1


def test_a_worker_that_was_killed_ends_the_run_with_a_sentence(tmp_path):
    folder = make_set(tmp_path / "long", places=40)
    process = command(folder, tmp_path / "out", "--exact", "--param", "cohog.w1=208", "--workers", "2")
    while len(entries(tmp_path / "out" / "cache", "answers")) < 3:
        assert process.poll() is None
        time.sleep(0.005)
    for pid in children_of(process.pid):
        os.kill(pid, signal.SIGKILL)
    said = process.communicate()[1].decode()
    assert process.returncode == 1
    assert "A worker has ended (it was killed by signal 9" in said
    assert "Traceback" not in said
