"""Flights that are governed: what a change does, how it is said, and when it is taken back."""

import shutil

import pytest
from fakes import FakeClock, FakeLink, FakeSource
from flights import Flight, flight_meter, of_kind
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.core.errors import MapError
from edgevpr.core.files import shipped
from edgevpr.places.index import bytes_per_place, load_index
from edgevpr.power.boards import load_board
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.aboard import smaller_forms
from edgevpr.runtime.flight.governor import Reading
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.preflight import accuracy
from edgevpr.runtime.recognise.opening import open_learning, open_recogniser
from edgevpr.runtime.recognise.recogniser import Matcher, Recogniser

TURN_S = 4.0  # more than the governor's patience: each reading can bring a change
CALM = Reading(cpu_share=0.01, late_share=0.0, rss_mb=100.0, temperature_c=40.0, throttled=False)
BUSY = Reading(cpu_share=1.0, late_share=0.0, rss_mb=100.0, temperature_c=40.0, throttled=False)


class Scripted(FlightMeter):
    """A meter that reads what stands in a script, a reading a turn, and calm after its end."""

    age_s = 1.0

    def __init__(self, *board, clock, readings):
        super().__init__(*board, clock=clock)
        self._readings, self._begin_s, self._now = readings, clock.mono_s(), clock.mono_s

    def reading(self):
        turn = round((self._now() - self._begin_s) / TURN_S) - 1
        return self._readings[turn] if turn < len(self._readings) else CALM


@pytest.fixture
def trusted(monkeypatch):
    """No form of hog has ever accepted a wrong place, but that of a test's choice."""
    counts = {"recall_at_1": 0.5, "sets": 2, "queries": 90, "asked": 90, "accepted": 9, "accepted_wrong": 0}
    table = {label: {**counts, "accepted_elsewhere": 0} for label in ("hog", "hog 8bit", "hog 1bit")}
    monkeypatch.setattr(accuracy, "_content", lambda: {"forward": table, "nadir": {}})
    return table


def governed(place_map, log, readings, count, fewer_candidates=(), **settings):
    """(changes, all lines, announcements, the flight) of a flight of `count` turns of 4 s."""
    clock = FakeClock()
    flight = Flight(place_map, log, clock, FakeLink(clock), **settings)
    forms = smaller_forms(flight.config, flight.recogniser, None, load_s=0.0)
    source = FakeSource([textured(0, 240, 320)] * count, clock, work=lambda: clock.sleep(TURN_S))
    lines = flight.fly(source, flight_meter(flight, Scripted, readings=readings), forms, fewer_candidates)
    return of_kind(lines, "governor"), lines, flight.link.texts(), flight


def test_a_change_is_logged_and_announced_once_and_taken_back(recording, tmp_path, monkeypatch, caplog):
    statuses = []
    monkeypatch.setattr(systemd, "status", statuses.append)
    script = [BUSY] * 2 + [CALM] * 3
    changes, _, texts, _ = governed(recording / "cohog.gpkg", tmp_path / "log", script, 8, **{"source.rate_hz": 60.0})
    down, back = changes
    asked, half = {"rate_hz": 60.0, "candidates": 42, "form": None}, {"rate_hz": 30.0, "candidates": 42, "form": None}
    assert (down["from"], down["to"], back["from"], back["to"]) == (asked, half, half, asked)
    assert down["why"].startswith("100% of all cores taken, and ")
    assert texts == [(4, "edgevpr: held to 30 of 60 Hz"), (6, "edgevpr: back to what was asked")]
    assert [record.levelname for record in caplog.records if "held to" in record.message] == ["WARNING"]
    assert any("held to 30 of 60 Hz" in status for status in statuses)
    assert "held to" not in statuses[-1]


def test_a_lower_rate_is_kept(recording, tmp_path):
    """By a clock that only sleeping moves: the governor waits for three seconds before each change."""
    clock = FakeClock()
    flight = Flight(recording / "hog.gpkg", tmp_path / "log", clock, **{"source.rate_hz": 20.0})

    class Busy(FlightMeter):
        def reading(self):
            super().reading()
            return BUSY

    lines = flight.fly(FakeSource([textured(0, 240, 320)] * 150, clock), flight_meter(flight, Busy))
    at_s = [line["t_mono_s"] for line in of_kind(lines, "query")]
    assert at_s[2] - at_s[1] == pytest.approx(0.05), "as asked"
    assert at_s[-1] - at_s[-2] == pytest.approx(0.4), "an eighth of it"


def test_fewer_candidates_are_compared_before_the_rate_is_lowered(recording, tmp_path, monkeypatch):
    compared = []
    step = Recogniser.step
    monkeypatch.setattr(
        Recogniser, "step", lambda self, *asked: (compared.append(self.candidates), step(self, *asked))[1]
    )
    changes, _, texts, _ = governed(
        recording / "cohog.gpkg", tmp_path / "log", [BUSY] * 99, 12, (20,), **{"source.rate_hz": 60.0}
    )
    assert [line["to"]["candidates"] for line in changes] == [20] * 5
    assert [line["to"]["rate_hz"] for line in changes] == [60.0, 30.0, 15.0, 7.5, 7.5]
    assert set(compared) == {42, 20}
    assert changes[-1]["from"] == changes[-1]["to"]
    assert changes[-1]["why"].endswith("nothing is left to lower")
    assert texts[-1][1] == "edgevpr: over a limit of its board, see its log"


def full_reading():
    return Reading(
        cpu_share=0.01,
        late_share=0.0,
        rss_mb=0.97 * load_board("this").memory_max_mb,
        temperature_c=40.0,
        throttled=False,
    )


def test_memory_that_runs_short_loads_the_index_in_a_smaller_form_and_places_are_found_as_before(
    recording, tmp_path, monkeypatch, trusted
):
    held = []
    step = Recogniser.step
    monkeypatch.setattr(
        Recogniser, "step", lambda self, *asked: (held.append(self.index.nbytes), step(self, *asked))[1]
    )
    script = [full_reading()] * 4 + [CALM] * 6
    changes, lines, texts, _ = governed(
        recording / "hog.gpkg", tmp_path / "log", script, 12, **{"source.rate_hz": 60.0}
    )
    assert [line["to"]["form"] for line in changes] == ["8bit", "1bit", "8bit", "float"]
    assert changes[0]["to"]["rate_hz"] == 60.0, "memory is no question of the rate"
    assert min(held) < max(held) / 10
    assert texts[1][1] == "edgevpr: held to form 1bit"
    assert [(line["place"], line["accepted"]) for line in of_kind(lines, "query")] == [(1, True)] * 12


def test_an_index_that_cannot_be_loaded_is_tried_again_and_the_flight_goes_on(recording, tmp_path, monkeypatch):
    from edgevpr.runtime.recognise import opening

    load, tries = opening.load_index, []

    def fails_twice(*asked, **more):
        tries.append(1)
        if len(tries) in (1, 2):
            raise MapError("the map is gone: put it back.")
        return load(*asked, **more)

    clock = FakeClock()
    flight = Flight(recording / "hog.gpkg", tmp_path / "log", clock, FakeLink(clock), **{"source.rate_hz": 60.0})
    monkeypatch.setattr(opening, "load_index", fails_twice)
    source = FakeSource([textured(0, 240, 320)] * 12, clock, work=lambda: clock.sleep(TURN_S))
    script = [full_reading()] * 2 + [CALM] * 2
    lines = flight.fly(source, flight_meter(flight, Scripted, readings=script), ("8bit", "1bit"))
    queries = of_kind(lines, "query")
    assert len(queries) == 12
    assert [line["accepted"] for line in queries][:2] == [True] * 2
    assert [line["accepted"] for line in queries][-4:] == [True] * 4, "it came back"
    refused = [line for line in queries if not line["accepted"]]
    assert {line["reason"] for line in refused} == {"the map is gone: put it back."}
    (lost,) = of_kind(lines, "index lost")
    assert (lost["form"], lost["problem"]) == ("8bit", "the map is gone: put it back.")
    assert (4, "edgevpr: its map cannot be read, see its log") in flight.link.texts()


def test_what_a_map_cannot_serve_is_not_offered(recording, tmp_path, trusted):
    def forms(name, learner=None, load_s=0.0, **settings):
        config = load_config(None, {"map": str(recording / f"{name}.gpkg"), **settings})
        recogniser = open_recogniser(config, load_board("this"))
        with recogniser.place_map:
            return smaller_forms(config, recogniser, learner, load_s)

    assert forms("hog") == ("8bit", "1bit")
    assert forms("hog", **{"match.form": "8bit"}) == ("1bit",)
    trusted["hog 8bit"]["accepted_elsewhere"] = 1
    assert forms("hog") == ("1bit",), "a form that accepts wrong places is not taken"
    trusted["hog"]["accepted_elsewhere"] = 1
    assert forms("hog") == ("8bit", "1bit"), "unless the form asked for does too"
    assert forms("hog", **{"match.min_margin": 0.05}) == (), "a margin of one form says nothing of another"
    assert forms("hog", load_s=11.0) == (), "nothing would be recognised for so long"
    assert forms("cohog") == forms("seqslam") == ()
    shutil.copy(recording / "hog.gpkg", tmp_path / "grows.gpkg")
    config = load_config(None, {"map": str(tmp_path / "grows.gpkg")})
    learning, growing = open_learning(config, load_board("this"), None)
    with learning.place_map:
        assert smaller_forms(config, learning, growing, 0.0) == (), "an index that grows does so in one form"


def test_of_a_part_of_a_map_no_smaller_form_is_offered(recording):
    config = load_config(None, {"map": str(recording / "hog.gpkg")})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        technique = recogniser.technique
        part = load_index(recogniser.place_map, technique, 9 * bytes_per_place(technique.spec))
        recogniser.take(Matcher(technique, part, recogniser.rule))
        assert smaller_forms(config, recogniser, None, 0.0) == (), "it is as large as it may be"


def test_a_sequence_is_asked_as_often_as_its_map_was_made(recording, tmp_path):
    changes, _, _, _ = governed(
        recording / "seqslam.gpkg", tmp_path / "log", [BUSY] * 99, 12, **{"source.rate_hz": 60.0}
    )
    (said,) = changes
    assert said["from"] == said["to"] == {"rate_hz": 60.0, "candidates": 1, "form": None}


def working_flight(recording, tmp_path, rate_hz, seconds, work, **settings):
    """A flight by a clock on a machine of as many cores as this one, whose frames take the CPU that `work` says."""
    clock = FakeClock()
    place_map = recording / "hog.gpkg"
    flight = Flight(place_map, tmp_path / "log", clock, FakeLink(clock), **{"source.rate_hz": rate_hz} | settings)
    encode = flight.recogniser.technique.encode
    flight.recogniser.technique.encode = lambda image: (work(clock), encode(image))[1]
    source = FakeSource([textured(0, 240, 320)] * int(rate_hz * seconds), clock)
    return flight.fly(source), flight


def test_the_limits_are_those_of_the_profile(recording, tmp_path):
    """On a board that allows one percent of its cores."""
    profile = tmp_path / "small.yaml"
    shipped_profile = (shipped("profiles") / "generic-x86.yaml").read_text()
    profile.write_text(shipped_profile.replace("cpu_share: 0.5", "cpu_share: 0.01"))
    cores = load_board(str(profile)).cores
    lines, _ = working_flight(
        recording, tmp_path, 9.0, 5.0, lambda clock: clock.work(0.015 / 9 * cores), board=str(profile)
    )
    (change,) = of_kind(lines, "governor")
    assert change["to"]["rate_hz"] == 4.5
    assert change["why"] == "2% of all cores taken, and 1% allowed"


def test_a_flight_that_must_share_its_core_asks_less_often_until_it_has_it_back(recording, tmp_path, caplog):
    """A query needs two thirds of its step; for 20 s another program takes half of the core."""
    rate_hz, begin_s = 10.0, FakeClock().now_s

    def work(clock):
        shared = clock.now_s < begin_s + 20
        wall_s = 0.65 / rate_hz * (2 if shared else 1)
        clock.work(wall_s, cores=0.5 if shared else 1.0, kept_waiting=0.0)

    caplog.set_level("INFO")
    lines, flight = working_flight(recording, tmp_path, rate_hz, 90, work)
    changes = of_kind(lines, "governor")
    assert changes[0]["why"] == "queries come late, kept waiting by other programs or the disk"
    assert changes[0]["to"]["rate_hz"] == pytest.approx(rate_hz / 2, rel=1e-3)
    assert changes[-1]["why"] == "there is room again"
    assert changes[-1]["to"] == changes[0]["from"]
    said = [record.message for record in caplog.records if record.name.endswith("herald")]
    assert len(said) == len(changes) == len(flight.link.texts()), "each is said once"
