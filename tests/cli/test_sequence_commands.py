"""Sequences as a user asks for them: `match`, `run` and `eval` with --sequence, and seqslam without it."""

import json

import cv2
import pytest
from pictures import textured

from edgevpr.cli.main import main

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
