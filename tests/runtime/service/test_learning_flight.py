"""`edgevpr run --learn`: it makes maps, and neither a killed process nor a full disk harms."""

import shutil
import socket
import time
from dataclasses import replace

import cv2
import pytest
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flight_process import start, wait_for
from flights import PLACES, Flight, of_kind

from edgevpr.core.geodesy import distance_m
from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate.generated import SCENE_DEPTH_M, SCENE_WIDTH_M, later_flight, mapping_flight, write_flight
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.flight.flightlog import read_log

pytestmark = pytest.mark.process

QUICK = ("--learn", "--technique", "hog", "--rate-hz", "60")


def flown(place_map, source, log, *flags, through=()):
    """A whole flight as a process: (the lines of its log, what it said)."""
    process = start(place_map, source, log, *flags, through=through)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 0, said
    return list(read_log(log)), said


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Two generated flights over the same leg, there and back; their ground is coarser than that of the demo."""
    folder = tmp_path_factory.mktemp("generated")
    scene = make_scene(1, SCENE_WIDTH_M, SCENE_DEPTH_M, metres_per_pixel=0.4)
    first, second = mapping_flight(1), later_flight(1)
    for name, flight in (
        ("first", replace(first, poses=first.poses[42:50])),
        ("second", replace(second, poses=second.poses[:6])),
    ):
        list(write_flight(folder / name, scene, flight))
    return folder


def test_learning_flight_makes_a_map_for_a_second_flight(generated, tmp_path):
    place_map = tmp_path / "m.gpkg"
    flags = ("--learn", "--technique", "cohog", "--camera", "nadir", "--rate-hz", "60")
    lines, said = flown(place_map, generated / "first" / "images", tmp_path / "1.jsonl", *flags)
    assert of_kind(lines, "end")[0]["learnt"] == {"places": 8, "left_out": {}, "stopped": None}
    assert of_kind(lines, "end")[0]["accepted"] == 0, "nothing new is recognised in what was just learnt"
    assert [line["place"] for line in of_kind(lines, "learnt")] == list(range(1, 9))
    assert "8 places learnt" in said
    assert lines[1]["reason"]["code"] == "EMPTY_MAP"

    lines, _ = flown(place_map, generated / "second" / "images", tmp_path / "2.jsonl")
    truth = read_positions(generated / "second" / "positions.csv")
    recognised = [line for line in of_kind(lines, "query") if line["accepted"]]
    assert len(recognised) >= 4
    for line in recognised:
        here = truth[line["query"]].position
        assert distance_m(line["position"]["lat_deg"], line["position"]["lon_deg"], here.lat_deg, here.lon_deg) < 40
    assert not of_kind(lines, "learnt")
    assert "learnt" not in lines[-1], "a flight that does not learn has nothing to say of it"


def test_learning_flight_loses_no_learnt_place_by_kill_9(recording, tmp_path, monkeypatch):
    place_map, log = tmp_path / "m.gpkg", tmp_path / "flight.jsonl"
    source = recording / "seen" / "images"
    process = start(place_map, source, log, "--learn", "--technique", "hog", "--rate-hz", "25")
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
        _, said = flown(place_map, source, tmp_path / "again.jsonl", *QUICK)
        manager.setblocking(False)
        while b"places learnt" not in manager.recv(4096):
            pass
    assert f"{PLACES} in {place_map}" in said
    with PlaceMap.open(place_map) as whole:
        assert sorted(place.source_image for place in whole.places()) == [f"{n:02d}.png" for n in range(PLACES)]


def test_learning_flight_learns_nothing_after_a_fix(recording, tmp_path):
    """The autopilot says to be where no place is; the frames show places of the map."""
    pictures = [cv2.imread(str(path)) for path in sorted((recording / "seen" / "images").iterdir())]

    def fly(log, answer="ACCEPTED", **settings):
        shutil.copy(recording / "cohog.gpkg", tmp_path / "m.gpkg")
        clock = FakeClock()
        link = FakeLink(clock, answer=answer, vehicle=lambda: vehicle_at(51.0, 8.0, clock.now_s))
        settings = {"source.rate_hz": 15.0} | settings
        flight = Flight(tmp_path / "m.gpkg", tmp_path / log, clock, link, learns=True, **settings)
        return flight.fly(FakeSource(pictures, clock)), flight

    lines, flight = fly("fixes")
    assert all(line["accepted"] for line in of_kind(lines, "query"))
    assert flight.learner.totals["places"] == 0
    assert flight.learner.totals["left_out"]["just after a fix"] > 10
    assert flight.link.stats().acks["ACCEPTED"] > 10

    lines, flight = fly("refused", answer="FAILED", **{"match.follow": False})
    assert len(of_kind(lines, "learnt")) == 1, "a fix that was refused is in no position"
    assert flight.link.stats().acks["FAILED"] > 10

    lines, flight = fly("contradicted", **{"mavlink.send_fixes": False})
    assert not of_kind(lines, "learnt"), "the flight so far knows better"
    assert flight.learner.totals["left_out"]["where the flight so far contradicts it"] > 10

    lines, _ = fly("silent", **{"mavlink.send_fixes": False, "match.follow": False})
    (learnt,) = of_kind(lines, "learnt")
    assert (learnt["position"]["lat_deg"], learnt["position"]["lon_deg"]) == (51.0, 8.0)


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="prlimit is not on this machine")
def test_learning_flight_goes_on_where_the_disk_is_full(recording, tmp_path):
    lines, said = flown(
        tmp_path / "m.gpkg",
        recording / "seen" / "images",
        tmp_path / "f.jsonl",
        *("--learn", "--technique", "cohog", "--rate-hz", "60"),
        through=["prlimit", "--fsize=400000"],
    )
    learnt = of_kind(lines, "learnt")
    end = lines[-1]
    assert end["queries"] == PLACES
    assert 2 < len(learnt) == end["learnt"]["places"] < PLACES
    (stopped,) = of_kind(lines, "learning stopped")
    assert end["learnt"]["stopped"] == stopped["note"]["parameters"]["problem"]
    assert "disk" in stopped["note"]["parameters"]["problem"]
    assert said.count("nothing more is learnt") == 1
    with PlaceMap.open(tmp_path / "m.gpkg") as place_map:
        assert {line["place"] for line in learnt} <= {place.place_id for place in place_map.places()}


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="prlimit is not on this machine")
def test_learning_flight_uses_a_map_that_cannot_be_written(recording, tmp_path):
    place_map = shutil.copy(recording / "cohog.gpkg", tmp_path / "m.gpkg")
    images, flags, through = recording / "seen" / "images", ("--learn", "--rate-hz", "60"), ["prlimit", "--fsize=0"]
    _, said = flown(place_map, images, tmp_path / "f.jsonl", *flags, through=through)
    assert f"{PLACES} queries, {PLACES} accepted" in said
    assert said.count("nothing more is learnt") == 1
