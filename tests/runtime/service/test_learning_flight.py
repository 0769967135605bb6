"""`edgevpr run --learn` as a process of its own: it makes maps, and neither a killed process nor a full disk harms."""

import json
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import pytest
from flight_process import start, wait_for
from pictures import textured

from edgevpr.cli import main
from edgevpr.frames.positions import read_positions
from edgevpr.geodesy import distance_m
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.simulate.flight import SCENE_DEPTH_M, SCENE_WIDTH_M, later_flight, mapping_flight, write_flight
from edgevpr.simulate.scene import make_scene

PLACES = 30
STEP_DEG = 0.001  # of latitude: 111 m
FAR = "file,lat,lon,time\nstay,51.0,8.0,0\n"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Thirty pictures with positions 111 m apart; the same pictures without any, in `blind`."""
    folder = tmp_path_factory.mktemp("recording")
    for name in ("seen", "blind/images"):
        (folder / name).mkdir(parents=True)
    rows = []
    for number in range(PLACES):
        cv2.imwrite(str(folder / "seen" / f"{number:02d}.png"), textured(number, 240, 320))
        shutil.copy(folder / "seen" / f"{number:02d}.png", folder / "blind" / "images")
        rows.append(f"{number:02d}.png,{50 + number * STEP_DEG:.4f},8.0")
    (folder / "seen" / "positions.csv").write_text("\n".join(["file,lat,lon", *rows]))
    return folder


@pytest.fixture
def autopilot(tmp_path):
    """Start a flight controller that stays where no place is; gives its link, and a call that ends it and asks it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (tmp_path / "track.csv").write_text(FAR)
    command = [
        "simulate",
        "autopilot",
        "--link",
        f"udpin:127.0.0.1:{port}",
        "--track",
        tmp_path / "track.csv",
        "--json",
    ]
    process = subprocess.Popen([sys.executable, "-m", "edgevpr", *map(str, command)], stdout=subprocess.PIPE, text=True)

    def asked():
        process.terminate()
        return json.loads(process.communicate(timeout=20)[0])

    yield f"udpout:127.0.0.1:{port}", asked
    process.kill()
    process.wait()
    process.stdout.close()


def flown(place_map, source, log, *flags, through=()):
    """A whole flight: (the lines of its log, what it said)."""
    process = start(place_map, source, log, *flags, through=through)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 0, said
    return list(read_log(log)), said


def of_kind(lines, kind):
    return [line for line in lines if line["kind"] == kind]


def test_a_first_flight_makes_the_map_in_which_a_second_one_recognises_places(tmp_path):
    scene = make_scene(1, SCENE_WIDTH_M, SCENE_DEPTH_M)
    first, second = mapping_flight(1), later_flight(1)  # the same leg, there and back
    for name, flight in (
        ("first", replace(first, poses=first.poses[42:50])),
        ("second", replace(second, poses=second.poses[:6])),
    ):
        list(write_flight(tmp_path / name, scene, flight))
    place_map = tmp_path / "m.gpkg"
    flags = ("--learn", "--technique", "cohog", "--camera", "nadir", "--rate-hz", "60")
    lines, said = flown(place_map, tmp_path / "first" / "images", tmp_path / "1.jsonl", *flags)
    assert of_kind(lines, "end")[0]["learnt"] == {"places": 8, "left_out": {}, "stopped": None}
    assert of_kind(lines, "end")[0]["accepted"] == 0, "nothing new is recognised in what was just learnt"
    assert [line["place"] for line in of_kind(lines, "learnt")] == list(range(1, 9))
    assert "8 places learnt, 8 in" in said
    assert lines[1]["reason"] == "the map has no place yet"

    lines, _ = flown(place_map, tmp_path / "second" / "images", tmp_path / "2.jsonl")
    truth = read_positions(tmp_path / "second" / "positions.csv")
    recognised = [line for line in of_kind(lines, "query") if line["accepted"]]
    assert len(recognised) >= 4
    for line in recognised:
        here = truth[line["query"]].position
        assert distance_m(line["position"]["lat_deg"], line["position"]["lon_deg"], here.lat_deg, here.lon_deg) < 40
    assert not of_kind(lines, "learnt")
    assert "learnt" not in lines[-1], "a flight that does not learn has nothing to say of it"


def test_kill_9_costs_no_place_that_the_log_calls_learnt_and_the_next_flight_goes_on(recording, tmp_path, monkeypatch):
    place_map, log = tmp_path / "m.gpkg", tmp_path / "flight.jsonl"
    flags = ("--learn", "--technique", "cohog", "--rate-hz", "15")
    process = start(place_map, recording / "seen", log, *flags)
    wait_for("learnt", log, process)
    while len(of_kind(read_log(log), "learnt")) < 4 and process.poll() is None:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    told = {line["place"]: line["query"] for line in of_kind(read_log(log), "learnt")}
    assert 4 <= len(told) < PLACES
    with PlaceMap.open(place_map) as left:
        held = {place.place_id: place.source_image for place in left.places()}
    assert told.items() <= held.items()
    assert len(held) <= len(told) + 1
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        _, said = flown(place_map, recording / "seen", tmp_path / "again.jsonl", *flags)
        manager.setblocking(False)
        while b"places learnt" not in manager.recv(4096):
            pass
    assert f"{PLACES} in {place_map}" in said
    with PlaceMap.open(place_map) as whole:
        assert sorted(place.source_image for place in whole.places()) == [f"{n:02d}.png" for n in range(PLACES)]


def test_a_small_budget_bounds_the_memory_while_the_file_keeps_all(recording, tmp_path):
    flags = ("--learn", "--technique", "hog", "--budget-mb", "1", "--rate-hz", "60")  # 286 KB a place: three of them
    (tmp_path / "m.gpkg.new").write_bytes(b"what was left when the power went while a map was made")
    lines, _ = flown(tmp_path / "m.gpkg", recording / "seen", tmp_path / "f.jsonl", *flags)
    assert not (tmp_path / "m.gpkg.new").exists()
    assert lines[-1]["learnt"]["places"] == PLACES
    with PlaceMap.open(tmp_path / "m.gpkg") as place_map:
        assert len(place_map) == PLACES
    told_mb = [line["costs"]["rss_mb"] for line in of_kind(lines, "query")]
    assert max(told_mb) < told_mb[9] + 3, "twenty places more would be 5.7 MB"


def test_after_a_fix_nothing_is_learnt_from_the_autopilot(recording, autopilot, tmp_path):
    link, asked = autopilot
    place_map = tmp_path / "m.gpkg"
    built = ["map", "build", place_map, "--images", recording / "seen", "--technique", "cohog"]
    assert main([str(word) for word in built]) == 0
    flags = ("--learn", "--link", link, "--rate-hz", "15")
    lines, _ = flown(place_map, recording / "blind" / "images", tmp_path / "fixes.jsonl", *flags)
    assert all(line["accepted"] for line in of_kind(lines, "query"))
    assert lines[-1]["learnt"]["places"] == 0
    assert lines[-1]["learnt"]["left_out"]["just after a fix"] > 10

    (tmp_path / "c.yaml").write_text("mavlink: {send_fixes: false}\n")
    flags += ("--config", tmp_path / "c.yaml")
    lines, _ = flown(place_map, recording / "blind" / "images", tmp_path / "silent.jsonl", *flags)
    (learnt,) = of_kind(lines, "learnt")
    assert (learnt["position"]["lat_deg"], learnt["position"]["lon_deg"]) == (51.0, 8.0)
    assert asked()["fixes_accepted"] > 10


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="prlimit is not on this machine")
def test_a_full_disk_ends_the_learning_and_not_the_flight(recording, autopilot, tmp_path):
    link, asked = autopilot
    flags = ("--learn", "--technique", "cohog", "--rate-hz", "30", "--link", link)
    lines, said = flown(
        tmp_path / "m.gpkg", recording / "seen", tmp_path / "f.jsonl", *flags, through=["prlimit", "--fsize=400000"]
    )
    learnt = of_kind(lines, "learnt")
    end = lines[-1]
    assert end["queries"] == PLACES
    assert 2 < len(learnt) == end["learnt"]["places"] < PLACES
    (stopped,) = of_kind(lines, "learning stopped")
    assert end["learnt"]["stopped"] == stopped["problem"]
    assert "disk" in stopped["problem"]
    assert said.count("nothing more is learnt") == 1
    assert asked()["messages"]["STATUSTEXT"] == 1
    with PlaceMap.open(tmp_path / "m.gpkg") as place_map:
        assert {line["place"] for line in learnt} <= {place.place_id for place in place_map.places()}


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="prlimit is not on this machine")
def test_a_map_that_cannot_be_written_is_flown_with_all_the_same(recording, tmp_path):
    place_map = tmp_path / "m.gpkg"
    built = ["map", "build", place_map, "--images", recording / "seen", "--technique", "cohog"]
    assert main([str(word) for word in built]) == 0
    flags = ("--learn", "--rate-hz", "60")
    _, said = flown(place_map, recording / "seen", tmp_path / "f.jsonl", *flags, through=["prlimit", "--fsize=0"])
    assert f"{PLACES} queries, {PLACES} accepted" in said
    assert said.count("nothing more is learnt") == 1


def test_without_any_position_learning_is_refused_in_one_sentence(recording, tmp_path, capsys):
    words = ["run", "--learn", "--map", tmp_path / "m.gpkg", "--source", recording / "blind" / "images"]
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("edgevpr: There is nothing to learn positions from")
    assert not (tmp_path / "m.gpkg").exists()
