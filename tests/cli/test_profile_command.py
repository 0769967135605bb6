"""`edgevpr profile` as a user meets it: before the flight, and on which board."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from example_costs import REGIONS, VECTOR

from edgevpr import techniques
from edgevpr.cli.main import main
from edgevpr.core.types import StageCost
from edgevpr.power import speed
from edgevpr.power.boards import list_boards
from edgevpr.runtime.preflight import choose, trial

COSTS = replace(REGIONS, disk_bytes_per_place=31_776, candidates=40, scan_per_place=StageCost(1e-6, 1e-6))
HOG = replace(VECTOR, ram_bytes_per_place=285_794, disk_bytes_per_place=285_768)


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    """Nobody's stored figures, and a micro-benchmark without patience."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(speed, "_MIN_TIME_S", 0.01)


@pytest.fixture
def tried(monkeypatch):
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
    counts = {"sets": 2, "queries": 90, "asked": 90, "accepted": 9, "accepted_wrong": 0, "accepted_elsewhere": 0}
    recalls = {"cohog": 0.9, "hog": 0.4, "hog 8bit": 0.4, "hog 1bit": 0.3, "seqslam": 0.5}
    table = {label: {"recall_at_1": recall, **counts} for label, recall in recalls.items()}
    monkeypatch.setattr(choose, "_read_accuracies", lambda: {"forward": table, "nadir": {}})
    return asked


def run(capsys, *argv):
    assert main(["profile", *map(str, argv)]) == 0
    return capsys.readouterr()


def refused(capsys, *argv):
    code = main(["profile", *map(str, argv)])
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("edgevpr: ")]
    assert "Traceback" not in "".join(said)
    return code, said[-1].removeprefix("edgevpr: ")


def a_map(tmp_path, technique="hog"):
    folder = tmp_path / "flight"
    folder.mkdir()
    for number in range(3):
        image = np.random.default_rng(number).integers(0, 256, (96, 128), np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), image)
    path = tmp_path / "valley.gpkg"
    assert main(["map", "build", str(path), "--images", str(folder), "--technique", technique]) == 0
    return path


@pytest.mark.process
@pytest.mark.slow
def test_profile_tries_the_real_techniques(capsys, monkeypatch):
    monkeypatch.setattr(techniques, "list_techniques", lambda: ("cohog", "hog"))
    found = json.loads(run(capsys, "--board", "rpi-zero-2w", "--places", 10_000, "--json").out)
    rows = {row["option"]["label"]: row for row in found["techniques"]}
    assert list(rows) == ["cohog", "hog", "hog 8bit", "hog 1bit"]
    assert "RAM" in rows["hog"]["option"]["fit"]["misfit"], "286 KB a place is 2.9 GB"
    assert found["times"] == "scaled"
    assert 0 < rows["cohog"]["flight_marginal_mah"] < rows["cohog"]["flight_mah"]
    assert rows["cohog"]["query"]["u_encode"] <= 1
    assert found["recommended"] == "cohog"


def test_profile_recommends_first_and_lists_every_technique(capsys, tried):
    said = run(capsys, "--board", "rpi-4b", "--places", 20).out.splitlines()
    assert said[0].startswith("Recommended: cohog: ")
    assert tried == ["cohog", "hog", "hog 8bit", "hog 1bit", "seqslam", "calc", "calc 8bit", "calc 1bit"]
    assert {"cohog", "hog 1bit", "seqslam", "calc"} <= {line.split("  ")[0] for line in said}
    assert max(map(len, said)) <= 120


def test_profile_list_names_every_board_and_this_machine(capsys):
    said = [line.split()[0] for line in run(capsys, "--list").out.splitlines()]
    assert said == ["this", *list_boards()]


def test_profile_of_a_map_tries_only_its_forms(capsys, tmp_path, tried):
    path = a_map(tmp_path)
    capsys.readouterr()
    found = json.loads(run(capsys, "--map", path, "--board", "rpi-4b", "--json").out)
    assert found["plan"]["places"] == 3
    assert found["recommended"] == "hog"
    assert tried == ["hog", "hog 8bit", "hog 1bit"]


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--places", "50", "--battery", "4X"], "The battery pack `4X` cannot be read: write its cells in series"),
        (["--map", "nowhere.gpkg"], "There is no map"),
        (["--places", "50", "--rate-hz", "0"], "the command line: `source.rate_hz` is 0"),
        (["--places", "50", "--board", "rpi4"], "There is no board `rpi4`"),
    ],
)
def test_profile_refuses_a_wrong_request_before_any_work(capsys, monkeypatch, tmp_path, tried, argv, sentence):
    monkeypatch.chdir(tmp_path)
    code, said = refused(capsys, *argv)
    assert code in (1, 2)
    assert said.startswith(sentence)
    assert not tried, "said before the measuring"
