"""The map that is left and found again, and the tilt that is too large: told once, and not at every flicker."""

from types import SimpleNamespace

import numpy as np
import pytest
from fakes import FakeClock, FakeLink, FakeSource
from flights import Flight, of_kind
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.frames.level import View
from edgevpr.runtime.flight.camerawatch import TurnWatch
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.flight.watching import Sight


class Seen:
    """A sight with its listeners; `look` shows it pictures, one a second."""

    def __init__(self, folder):
        self.clock, self.log = FakeClock(), folder / "log"
        self.link = FakeLink(self.clock)
        self.sight = Sight(Notifier(FlightLog(self.log, clock=self.clock), self.link))

    def look(self, outcomes: str, every_s: float = 1.0):
        """`+` accepted, `-` not, `L` not and lost, `0` shows nothing, `x` failed, `t` tilted, `n` not worth a search,
        `u` no query."""
        for outcome in outcomes:
            self.clock.now_s += every_s
            self.sight.update(
                SimpleNamespace(
                    is_query=outcome != "u",
                    accepted=outcome == "+",
                    failed=outcome == "x",
                    says_nothing=outcome == "0",
                    worth=SimpleNamespace(reason="grass" if outcome == "n" else None),
                    view=View(reason=Reason(ReasonCode.TILTED, {"tilt_deg": 50.0}) if outcome == "t" else None),
                    followed=SimpleNamespace(lost=0.95 if outcome == "L" else 0.2),
                    frame=SimpleNamespace(t_mono_s=self.clock.now_s),
                )
            )
        return [text.removeprefix("edgevpr: ") for _, text in self.link.texts()]


@pytest.fixture
def seen(tmp_path):
    return Seen(tmp_path)


def test_the_map_is_left_after_thirty_queries_without_a_match_and_found_with_two(seen):
    assert seen.look("+++" + "-" * 29) == []
    assert seen.look("-") == ["map left"]
    assert seen.look("-" * 50) == ["map left"]
    assert seen.look("+--") == ["map left"]
    assert seen.look("+") == ["map left", "map found again"]
    assert [(line["kind"], line["note"]["code"]) for line in read_log(seen.log)] == [
        ("sight", "MAP_LEFT"),
        ("sight", "MAP_FOUND"),
    ]
    assert [severity for severity, _ in seen.link.texts()] == [4, 6]


def test_a_flight_that_knows_to_be_lost_needs_ten(seen):
    assert seen.look("+++" + "L" * 9) == []
    assert seen.look("L") == ["map left"]


def test_a_map_that_was_hardly_ever_recognised_cannot_be_left(seen):
    assert seen.look("-" * 100 + "++" + "-" * 100) == []


def test_matches_far_apart_do_not_make_a_left_map_found(seen):
    assert seen.look("+++" + "-" * 30 + ("+" + "-" * 10) * 5) == ["map left"]


@pytest.mark.parametrize("outcome", "0xtnu")
def test_what_says_nothing_of_the_map_does_not_count(seen, outcome):
    assert "map left" not in seen.look("+++" + "-" * 29 + outcome * 40)
    assert seen.look("-")[-1] == "map left"


def test_a_tilt_is_told_when_it_lasts_five_seconds_and_when_it_is_over_for_as_long(seen):
    assert seen.look("-" + "t" * 5) == []
    assert seen.look("t") == ["tilt too large"]
    assert seen.look("-----") == ["tilt too large"]
    assert seen.look("-") == ["tilt too large", "tilt is fine again"]
    assert [line["kind"] for line in read_log(seen.log)] == ["tilt", "tilt"]


@pytest.mark.slow
def test_a_flight_that_leaves_its_map_and_comes_back_says_so(recording, tmp_path):
    clock = FakeClock()
    link = FakeLink(clock)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
    over_map, elsewhere = range(8), range(100, 140)
    pictures = [textured(number, 240, 320) for number in [*over_map, *elsewhere, *over_map]]
    lines = flight.fly(FakeSource(pictures, clock))
    assert link.texts() == [(4, "edgevpr: map left"), (6, "edgevpr: map found again")]
    assert [line["note"]["code"] for line in of_kind(lines, "sight")] == ["MAP_LEFT", "MAP_FOUND"]


@pytest.mark.parametrize(
    ("turned_deg", "said"),
    [
        ([88, 92], ["pictures turned 90 degrees"]),
        ([-179, 179], ["pictures turned 180 degrees"]),
        ([-32, -28], ["pictures turned -30 degrees"]),
        ([8, 12], []),
        ([0, 90], []),
        ([20, 80], []),
    ],
)
def test_pictures_that_are_turned_against_the_heading_are_said_once(tmp_path, turned_deg, said):
    clock = FakeClock()
    link = FakeLink(clock)
    source = load_config(None, {"source.up_deg": 300.0}).source
    watch = TurnWatch(Notifier(FlightLog(tmp_path / "log", clock=clock), link), source)
    view = SimpleNamespace(up_deg=350.0, reason=None)
    events = [SimpleNamespace(located=SimpleNamespace(heading_deg=350.0 + turn), view=view) for turn in turned_deg]
    missed = SimpleNamespace(located=None, view=view)
    for event in [events[0], missed, events[1]] * 4:
        watch.update(event)
    assert link.texts() == []
    for event in [missed, *events, *events]:
        watch.update(event)
    assert [text.removeprefix("edgevpr: ").replace("-180", "180") for _, text in link.texts()] == said


@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_pictures_are_reported_once_and_only_where_none_matches(recording, tmp_path, axis):
    clock = FakeClock()
    link = FakeLink(clock)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
    pictures = [np.flip(textured(number % 8, 240, 320), axis).copy() for number in range(20)]
    lines = flight.fly(FakeSource(pictures, clock))
    assert not any(line["accepted"] for line in of_kind(lines, "query"))
    assert link.texts() == [(4, "edgevpr: pictures are mirrored")]
    (line,) = of_kind(lines, "camera")
    assert line["note"]["code"] == "PICTURES_MIRRORED"


def test_pictures_of_other_ground_are_not_reported_as_mirrored(recording, tmp_path):
    clock = FakeClock()
    link = FakeLink(clock)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
    flight.fly(FakeSource([textured(number, 240, 320) for number in range(100, 135)], clock))
    assert link.texts() == []
