"""`edgevpr profile` as a user meets it: before the flight, and on which board."""

from dataclasses import replace

import pytest
from commands import expect_refusal, run, run_json
from example_costs import REGIONS, VECTOR, make_accuracy
from pictures import draw_texture, write_flight

from edgevpr import techniques
from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board, list_boards
from edgevpr.runtime.preflight import choose, trial

COSTS = replace(REGIONS, disk_bytes_per_place=31_776, candidates=40, scan_per_place=StageCost(1e-6, 1e-6))
HOG = replace(VECTOR, ram_bytes_per_place=285_794, disk_bytes_per_place=285_768)


@pytest.fixture(autouse=True)
def no_stored_figures(monkeypatch, tmp_path):
    """Nobody's stored figures."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))


@pytest.fixture
def trials(monkeypatch):
    """What was tried, by trials that take no time."""
    asked = []

    def answer(wanted, threads):
        for offer in wanted:
            asked.append(offer.label)
            if offer.label == "calc":
                yield replace(offer, problem="There is no model `calc`.")
            elif offer.name != "calc":
                yield replace(offer, costs=HOG if offer.name == "hog" else COSTS)

    monkeypatch.setattr(trial, "run_trials", answer)
    monkeypatch.setattr(techniques, "list_techniques", lambda: ("cohog", "hog", "seqslam", "calc"))
    recalls = {"cohog": 0.9, "hog": 0.4, "hog 8bit": 0.4, "hog 1bit": 0.3, "seqslam": 0.5}
    table = {label: make_accuracy(recall) for label, recall in recalls.items()}
    monkeypatch.setattr(choose, "_read_accuracies", lambda: {"forward": table, "nadir": {}})
    return asked


@pytest.mark.process
@pytest.mark.slow
def test_profile_tries_the_real_techniques(capsys, monkeypatch):
    monkeypatch.setattr(techniques, "list_techniques", lambda: ("cohog", "hog"))
    monkeypatch.setattr(Board, "is_this_machine", lambda board: True)
    found = run_json(capsys, "profile", "--board", "rpi-zero-2w", "--places", 10_000)
    rows = {row["option"]["label"]: row for row in found["techniques"]}
    assert list(rows) == ["cohog", "hog", "hog 8bit", "hog 1bit"]
    assert "RAM" in rows["hog"]["option"]["misfit"], "286 KB a place is 2.9 GB"
    assert (found["times"], found["unknown"]) == ("measured", [])
    assert 0 < rows["cohog"]["flight_marginal_mah"] < rows["cohog"]["flight_mah"]
    assert rows["cohog"]["query"]["u_encode"] <= 1
    assert found["recommended"] == "cohog"


def test_profile_recommends_first_and_lists_every_technique(capsys, trials):
    assert run("profile", "--board", "rpi-4b", "--places", 20) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("Recommended: cohog: ")
    assert trials == ["cohog", "hog", "hog 8bit", "hog 1bit", "seqslam", "calc", "calc 8bit", "calc 1bit"]
    assert {"cohog", "hog 1bit", "seqslam", "calc"} <= {line.split("  ")[0] for line in said}
    assert max(map(len, said)) <= 120


def test_profile_list_names_every_board_and_this_machine(capsys):
    assert run("profile", "--list") == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["this", *list_boards()]


def test_profile_of_a_map_tries_only_its_forms(capsys, tmp_path, trials):
    path = tmp_path / "valley.gpkg"
    write_flight(tmp_path / "flight", [draw_texture(number) for number in range(3)])
    assert run("map", "build", path, "--images", tmp_path / "flight", "--technique", "hog") == 0
    found = run_json(capsys, "profile", "--map", path)
    assert found["plan"]["places"] == 3
    assert found["recommended"] == "hog"
    assert trials == ["hog", "hog 8bit", "hog 1bit"]


@pytest.mark.parametrize(
    ("argv", "code", "sentence"),
    [
        (["--places", "50", "--battery", "4X"], 2, "`4X`"),
        (["--map", "nowhere.gpkg"], 1, "nowhere.gpkg"),
        (["--places", "50", "--rate-hz", "0"], 2, "the command line: `source.rate_hz` is 0"),
        (["--places", "50", "--board", "rpi4"], 2, "`rpi4`"),
    ],
)
def test_profile_refuses_a_wrong_request_before_any_work(capsys, monkeypatch, tmp_path, trials, argv, code, sentence):
    monkeypatch.chdir(tmp_path)
    assert sentence in expect_refusal(capsys, "profile", *argv, code=code)
    assert not trials, "said before the measuring"
