"""Sequences as a user asks for them: `match`, `run` and `eval` with --sequence, and seqslam without it."""

import json

import cv2
import pytest
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.places.index import bytes_per_place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.pick import outlook
from edgevpr.runtime.recognise.opening import open_recogniser

PLACES = 24


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Two flights along the same places, the later one darker. Its sixth picture is one of a place far ahead: by
    itself it is taken for that, in a sequence it is not. The truth scores every second picture."""
    folder = tmp_path_factory.mktemp("flight")
    (folder / "ref").mkdir()
    (folder / "query").mkdir()
    truth = ["query_file,ref_files,status"]
    for number in range(PLACES):
        picture = textured(number, 96, 128)
        seen = textured(20, 96, 128) if number == 6 else picture
        cv2.imwrite(str(folder / "ref" / f"{number:02d}.png"), picture)
        cv2.imwrite(str(folder / "query" / f"{number:02d}.png"), cv2.convertScaleAbs(seen, alpha=0.7))
        truth.append(f"{number:02d}.png,{number:02d}.png,{'left out' if number % 2 else 'ok'}")
    # The order of the rows is not that of the flight.
    (folder / "ground_truth.csv").write_text("\n".join([truth[0], *reversed(truth[1:])]) + "\n")
    return folder


@pytest.fixture(scope="module")
def maps(flight, tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    for name, parameters in (("hog", ["--param", "w1=64"]), ("seqslam", [])):
        built = ["map", "build", folder / f"{name}.gpkg", "--images", flight / "ref", "--technique", name, *parameters]
        assert main([str(word) for word in built]) == 0
    return folder


def run_json(capsys, *argv):
    capsys.readouterr()
    assert main([str(word) for word in argv]) == 0
    return json.loads(capsys.readouterr().out)


def evaluated(capsys, flight, *argv):
    data = ["--query", flight / "query", "--ref", flight / "ref", "--ground-truth", flight / "ground_truth.csv"]
    return run_json(capsys, "eval", *data, "--json", *argv)["techniques"]


def places_of(found):
    return [int(each["place"]["image"].removesuffix(".png")) for each in found]


def test_match_follows_the_flight_and_accepts_nothing_before_the_sequence_is_full(capsys, flight, maps):
    alone = run_json(capsys, "match", maps / "hog.gpkg", "--images", flight / "query", "--json")
    assert places_of(alone) == [20 if number == 6 else number for number in range(PLACES)]
    assert alone[0]["accepted"]
    together = run_json(capsys, "match", maps / "hog.gpkg", "--images", flight / "query", "--sequence", 4, "--json")
    assert places_of(together) == list(range(PLACES))
    assert not any(each["accepted"] for each in together[:3])
    assert "3 queries" in together[2]["reason"]
    assert together[3]["accepted"]


def test_seqslam_matches_sequences_of_ten_by_itself(capsys, flight, maps):
    found = run_json(capsys, "match", maps / "seqslam.gpkg", "--images", flight / "query", "--json")
    assert places_of(found)[9:] == list(range(9, PLACES))
    assert [each["accepted"] for each in found].index(True) == 9
    alone = run_json(capsys, "match", maps / "seqslam.gpkg", "--images", flight / "query", "--sequence", 1, "--json")
    assert places_of(alone)[6] == 20
    assert any(each["accepted"] for each in alone[:9])


@pytest.mark.slow
def test_run_takes_the_sequence_and_logs_it(flight, maps, tmp_path):
    log_path = tmp_path / "log.jsonl"
    flown = ["run", "--map", maps / "hog.gpkg", "--source", flight / "query", "--rate-hz", "60", "--log", log_path]
    assert main([str(word) for word in [*flown, "--sequence", "4"]]) == 0
    lines = [json.loads(line) for line in log_path.read_text().splitlines()]
    (start,) = [line for line in lines if line["kind"] == "start"]
    assert start["decided"]["sequence"] == 4
    queries = [line for line in lines if line["kind"] == "query"]
    assert [each["accepted"] for each in queries[:3]] == [False] * 3
    assert queries[3]["accepted"]


@pytest.mark.slow
def test_eval_asks_in_the_order_of_the_flight_and_scores_what_the_truth_names(capsys, flight):
    results = evaluated(capsys, flight, "--techniques", "hog,seqslam", "--param", "hog.w1=64", "--sequence", "4")
    for result in results.values():
        assert (result["sequence"], result["queries"], result["recall_at_1"]) == (4, PLACES / 2, 1.0)
        assert result["accepted"] <= PLACES / 2 - 2  # the first two that are scored come before it is full
    alone = evaluated(capsys, flight, "--techniques", "hog", "--param", "hog.w1=64")["hog"]
    assert (alone["sequence"], alone["recall_at_1"]) == (1, 1 - 2 / PLACES)
    assert evaluated(capsys, flight, "--techniques", "seqslam")["seqslam"]["sequence"] == 10


def test_the_budget_holds_the_sequence_as_well(maps):
    with PlaceMap.open(maps / "seqslam.gpkg") as place_map:
        each = bytes_per_place(place_map.spec)
    budget_mb = 1.0
    config = {"map": str(maps / "seqslam.gpkg"), "memory.budget_mb": budget_mb, "match.sequence": 100}
    config = load_config(None, config)
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert len(recogniser.index) == PLACES
        said = outlook(recogniser, config).reason
    assert f"take {PLACES * (each + 404) / 1e6:.1f} of {budget_mb:.1f} MB" in said
