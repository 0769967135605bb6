"""`edgevpr profile` as a user meets it: before the flight, on which board, and measured rather than guessed."""

import json
from dataclasses import asdict

import cv2
import numpy as np
import pytest

from edgevpr import techniques
from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import StageCost
from edgevpr.power import calibrate, machine, speed
from edgevpr.power.boards import board_names, load_board
from edgevpr.runtime.preflight import accuracy, trial
from edgevpr.runtime.preflight.probe import TechniqueCosts

COSTS = TechniqueCosts(
    encode=StageCost(0.1, 0.1),
    match_per_place=StageCost(0.004, 0.004),
    ram_bytes_per_place=90,
    disk_bytes_per_place=31_776,
    process_mb=88.0,
    candidates=40,
    scan_per_place=StageCost(1e-6, 1e-6),
)
HOG = TechniqueCosts(
    encode=StageCost(0.01, 0.01),
    match_per_place=StageCost(0.0003, 0.0003),
    ram_bytes_per_place=285_794,
    disk_bytes_per_place=285_768,
    process_mb=88.0,
)


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    """Nobody's stored figures, no meter, and a micro-benchmark without patience."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(speed, "_LEAST_S", 0.01)
    monkeypatch.setattr(calibrate, "find_meters", tuple)


@pytest.fixture
def tried(monkeypatch):
    """What was tried, by trials that take no time."""
    asked = []

    def answer(module, job, limit_s, what):
        asked.append(job["trial"]["label"])
        if job["trial"]["name"] == "calc":
            raise EdgevprError("There is no model `calc`.")
        return {**job["trial"], "costs": asdict(HOG if job["trial"]["name"] == "hog" else COSTS)}

    monkeypatch.setattr(trial, "ask_child", answer)
    monkeypatch.setattr(techniques, "names", lambda: ("cohog", "hog", "seqslam", "calc"))
    counts = {"sets": 2, "queries": 90, "asked": 90, "accepted": 9, "accepted_wrong": 0, "accepted_elsewhere": 0}
    recalls = {"cohog": 0.9, "hog": 0.4, "hog 8bit": 0.4, "hog 1bit": 0.3, "seqslam": 0.5}
    table = {label: {"recall_at_1": recall, **counts} for label, recall in recalls.items()}
    monkeypatch.setattr(accuracy, "_content", lambda: {"forward": table, "nadir": {}})
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
def test_the_real_techniques_are_tried_and_said(capsys, monkeypatch):
    monkeypatch.setattr(techniques, "names", lambda: ("cohog", "hog"))
    found = json.loads(run(capsys, "--board", "rpi-zero-2w", "--places", 10_000, "--hover-w", 90, "--json").out)
    rows = {row["option"]["label"]: row for row in found["techniques"]}
    fewer = ["cohog, 20 candidates", "cohog, 10 candidates"]
    assert list(rows) == ["cohog", *fewer, "hog", "hog 8bit", "hog 1bit"]
    assert any("RAM" in why for why in rows["hog"]["option"]["fit"]["shortfalls"]), "286 KB a place is 2.9 GB"
    assert found["times"] == "scaled"
    assert 0 < rows["cohog"]["lost_marginal_min"] < rows["cohog"]["lost_min"]
    assert rows["cohog"]["query"]["u_encode"] <= 1
    assert found["recommended"] == "cohog"


def test_progress_is_shown_and_the_text_has_both_tables(capsys, tried):
    said = run(capsys, "--board", "rpi-4b", "--places", 20)
    assert "trying techniques" in said.err
    assert said.out.startswith("Raspberry Pi 4B, 64-bit: 20 places, 0.5 Hz")
    assert "\nRecommended: cohog: " in said.out
    assert "no model `calc`" in said.out
    assert all(len(line) <= 120 for line in said.out.splitlines())


def test_the_cheapest_that_finds_enough_is_recommended(capsys, tried):
    found = json.loads(run(capsys, "--board", "rpi-5", "--places", 20, "--min-recall", 0.35, "--json").out)
    assert found["recommended"] == "cohog", "ways to use the board's own technique come first"
    nothing = run(capsys, "--board", "rpi-5", "--places", 20, "--min-recall", 0.95).out
    assert "the most is 0.90" in nothing
    assert refused(capsys, "--board", "rpi-5", "--places", 20, "--min-recall", 2)[1].startswith("`min_recall` is 2:")


def test_with_a_map_its_places_count_and_only_its_forms_are_recommended(capsys, tmp_path, tried):
    path = a_map(tmp_path)
    capsys.readouterr()
    found = json.loads(run(capsys, "--map", path, "--board", "rpi-4b", "--json").out)
    assert found["plan"]["places"] == 3
    assert found["recommended"] == "hog"
    assert "with hog" in found["reason"]
    small = json.loads(run(capsys, "--map", path, "--board", "rpi-4b", "--budget-mb", 0.5, "--json").out)
    assert small["recommended"] is None


@pytest.mark.process
@pytest.mark.slow
def test_what_was_measured_is_kept_used_and_dated(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(techniques, "names", lambda: ("cohog", "seqslam"))
    a_map(tmp_path, "seqslam")
    capsys.readouterr()
    said = run(capsys, "--measure")
    assert "measuring techniques" in said.err
    kept = tmp_path / "data/edgevpr/measured.json"
    assert f"kept in {kept}: `--places N` uses them.\n{calibrate.NO_METER}" in said.out
    fields = json.loads(kept.read_text())
    assert [trial["label"] for trial in fields["trials"]] == ["cohog", "seqslam"]
    assert fields["trials"][0]["costs"]["encode"]["cpu_s"] > 0
    monkeypatch.setattr(trial, "ask_child", lambda *_: pytest.fail("anew"))
    found = json.loads(run(capsys, "--places", 50, "--json").out)
    assert (found["measured_on"], found["times"]) == (fields["date"], "measured")
    assert found["techniques"][0]["query"]["t_encode_s"] == fields["trials"][0]["costs"]["encode"]["wall_s"]
    assert fields["date"] in run(capsys, "--places", 50).out
    other = json.loads(run(capsys, "--places", 50, "--board", "rpi-4b", "--json").out)
    assert other["times"] == "scaled"
    assert other["ratios"]["products"] == pytest.approx(0.056 / fields["score"]["products"])
    mapped = json.loads(run(capsys, "--map", tmp_path / "valley.gpkg", "--json").out)
    assert mapped["techniques"][1]["measured"], "a map of the default settings is what was measured"


def test_figures_of_another_machine_are_refused_and_tried_anew(capsys, tmp_path, tried):
    run(capsys, "--measure")
    kept = tmp_path / "data/edgevpr/measured.json"
    fields = json.loads(kept.read_text())
    fields["identity"]["kernel"] = "2.6.32"
    kept.write_text(json.dumps(fields))
    tried.clear()
    said = run(capsys, "--places", 50, "--json")
    assert "kernel: 2.6.32" in said.err
    assert json.loads(said.out)["measured_on"] is None
    assert tried[0] == "cohog"


def test_figures_are_kept_where_one_says_and_can_be_had_as_json(capsys, tmp_path, tried):
    found = json.loads(run(capsys, "--measure", "--out", tmp_path / "m.json", "--json").out)
    assert found["file"] == str(tmp_path / "m.json")
    assert (found["profile"], found["power"]) == (None, calibrate.NO_METER)
    assert json.loads((tmp_path / "m.json").read_text())["trials"] == found["trials"]
    assert not (tmp_path / "data").exists()


def test_measuring_and_planning_go_together(capsys, tmp_path, tried):
    said = run(capsys, "--measure", "--places", 100)
    assert said.out.index(" kept in ") < said.out.index("100 places")
    assert tried.count("cohog") == 1, "what was just measured is not tried again"
    assert json.loads(run(capsys, "--measure", "--places", 100, "--json").out)["measured_on"]


def test_an_interruption_leaves_the_old_figures_as_they_were(capsys, tmp_path, monkeypatch, tried):
    run(capsys, "--measure")
    folder = tmp_path / "data/edgevpr"
    before = (folder / "measured.json").read_bytes()

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(trial, "ask_child", interrupted)
    assert main(["profile", "--measure"]) == 130
    assert "stopped" in capsys.readouterr().err
    assert (folder / "measured.json").read_bytes() == before
    assert [path.name for path in folder.iterdir()] == ["measured.json"]


def test_it_says_which_board_this_is_and_writes_a_profile_that_can_be_flown(capsys, tmp_path, tried):
    path = tmp_path / "mine.yaml"
    said = run(capsys, "--detect", "--out", path)
    assert "usable cores" in said.out
    assert f"--board {path}" in said.err
    board = load_board(str(path))
    assert (board.machine, board.benchmark_score.verified) == (machine.title(), True)
    assert board.benchmark_score.passes > 0
    before = path.read_bytes()
    assert refused(capsys, "--detect", "--out", path) == (
        2,
        f"{path} is there already: move it away, or choose another name.",
    )
    assert path.read_bytes() == before
    found = json.loads(run(capsys, "--places", 50, "--board", path, "--json").out)
    assert (found["board"], found["times"]) == ("mine", "measured")
    assert set(json.loads(run(capsys, "--detect", "--json").out)) >= {"board", "cpu", "usable_cores", "ram_limit_mb"}


@pytest.mark.process
@pytest.mark.slow
def test_the_picture_is_written(capsys, tmp_path, tried):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    run(capsys, "--places", 50, "--board", "rpi-4b", "--plot", tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 10_000


def test_the_boards_are_listed(capsys):
    assert [line.split()[0] for line in run(capsys, "--list").out.splitlines()] == list(board_names())


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--places", "50", "--hover-w", "0"], "`hover_w` is 0: give a number above 0."),
        (["--places", "50", "--battery", "4X"], "The battery pack `4X` cannot be read: write its cells in series"),
        (["--places", "50", "--plot", "chart.txt"], "chart.txt: a picture's name ends in .png"),
        (["--map", "nowhere.gpkg"], "There is no map"),
        (["--plot", "chart.png", "--measure"], "Say how many places will be flown with"),
        (["--places", "50", "--out", "x.json"], "--out is for --detect and --measure"),
        (["--measure", "--out", "mine.yaml"], "mine.yaml: the name of a file of figures ends in .json"),
        (["--detect", "--places", "50"], "--detect says what this machine is: ask what a flight costs without it."),
        (["--detect", "--out", "mine.json"], "mine.json: a profile's name ends in .yaml"),
        (["--places", "50", "--board", "rpi4"], "There is no board `rpi4`"),
    ],
)
def test_what_makes_no_sense_is_one_sentence_before_any_work(capsys, monkeypatch, tmp_path, tried, argv, sentence):
    monkeypatch.chdir(tmp_path)
    code, said = refused(capsys, *argv)
    assert code in (1, 2)
    assert said.startswith(sentence)
    assert not tried, "said before the measuring"
