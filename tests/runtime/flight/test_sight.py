"""The map that is left and found again, and the tilt that is too large: told once, and not at every flicker."""

from types import SimpleNamespace

import numpy as np
import pytest
from fakes import FakeSource, format_note
from flights import draw_pictures, select

from edgevpr.core.config import load_config
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.frames.level import View
from edgevpr.runtime.flight.camerawatch import TurnWatch
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.watching import MapCoverageWatch

MAP_LEFT = format_note(ReasonCode.MAP_LEFT)
MAP_FOUND = format_note(ReasonCode.MAP_FOUND)
TILT_TOO_LARGE = format_note(ReasonCode.TILT_TOO_LARGE)
TILT_FINE = format_note(ReasonCode.TILT_FINE)


class SightFlight:
    """A sight with its listeners; `look` shows it pictures, one a second."""

    def __init__(self, notifier, clock, link):
        self.clock, self.link, self.sight = clock, link, MapCoverageWatch(notifier)

    def query(self, outcomes: str, every_s: float = 1.0):
        """`+` accepted, `-` not, `L` not and lost, `0` shows nothing, `x` failed, `t` tilted, `n` not worth a search,
        `u` no query."""
        for outcome in outcomes:
            self.clock.now_s += every_s
            self.sight.update(
                SimpleNamespace(
                    is_query=outcome != "u",
                    accepted=outcome == "+",
                    failed=outcome == "x",
                    lacks_texture=outcome == "0",
                    salience=SimpleNamespace(reason="grass" if outcome == "n" else None),
                    view=View(reason=Reason(ReasonCode.TILTED, {"tilt_deg": 50.0}) if outcome == "t" else None),
                    track=SimpleNamespace(lost=0.95 if outcome == "L" else 0.2),
                    frame=SimpleNamespace(t_mono_s=self.clock.now_s),
                )
            )
        return [text for _, text in self.link.texts()]


@pytest.fixture
def sight_flight(notifier, clock, link):
    return SightFlight(notifier, clock, link)


def test_sight_reports_the_map_left_after_thirty_queries_and_found_after_two_matches(sight_flight, tmp_path):
    assert sight_flight.query("+++" + "-" * 29) == []
    assert sight_flight.query("-") == [MAP_LEFT]
    assert sight_flight.query("-" * 50) == [MAP_LEFT]
    assert sight_flight.query("+--") == [MAP_LEFT]
    assert sight_flight.query("+") == [MAP_LEFT, MAP_FOUND]
    assert [(line["kind"], line["note"]["code"]) for line in read_log(tmp_path / "log")] == [
        ("sight", "MAP_LEFT"),
        ("sight", "MAP_FOUND"),
    ]
    assert [severity for severity, _ in sight_flight.link.texts()] == [4, 6]


@pytest.mark.parametrize(
    ("outcomes", "texts"),
    [
        ("+++" + "L" * 9, []),
        ("+++" + "L" * 10, [MAP_LEFT]),  # the flight knows to be lost
        ("-" * 100 + "++" + "-" * 100, []),  # it was hardly ever recognised
        ("+++" + "-" * 30 + ("+" + "-" * 10) * 5, [MAP_LEFT]),  # matches far apart
    ],
)
def test_sight_requires_several_queries_to_leave_or_find_the_map(sight_flight, outcomes, texts):
    assert sight_flight.query(outcomes) == texts


@pytest.mark.parametrize("outcome", "0xtnu")
def test_sight_ignores_queries_without_information_about_the_map(sight_flight, outcome):
    assert MAP_LEFT not in sight_flight.query("+++" + "-" * 29 + outcome * 40)
    assert sight_flight.query("-")[-1] == MAP_LEFT


def test_sight_reports_tilt_after_five_seconds_and_its_end(sight_flight, tmp_path):
    assert sight_flight.query("-" + "t" * 5) == []
    assert sight_flight.query("t") == [TILT_TOO_LARGE]
    assert sight_flight.query("-----") == [TILT_TOO_LARGE]
    assert sight_flight.query("-") == [TILT_TOO_LARGE, TILT_FINE]
    assert [line["kind"] for line in read_log(tmp_path / "log")] == ["tilt", "tilt"]


@pytest.mark.slow
def test_sight_reports_a_flight_that_leaves_its_map_and_returns(make_flight, clock, link):
    link.answer = None  # without an autopilot, no fix is held back
    lines = make_flight().fly(FakeSource([*draw_pictures(8), *draw_pictures(40, first=100), *draw_pictures(8)], clock))
    assert link.texts() == [(4, MAP_LEFT), (6, MAP_FOUND)]
    assert [line["note"]["code"] for line in select(lines, "sight")] == ["MAP_LEFT", "MAP_FOUND"]


@pytest.mark.parametrize(
    ("rotation_deg", "said"),
    [
        ([88, 92], ["images rotated 90 degrees"]),
        ([-179, 179], ["images rotated 180 degrees"]),
        ([-32, -28], ["images rotated -30 degrees"]),
        ([8, 12], []),
        ([0, 90], []),
        ([20, 80], []),
    ],
)
def test_sight_reports_images_rotated_from_the_heading_once(notifier, link, rotation_deg, said):
    watch = TurnWatch(notifier, load_config(None, {"source.up_deg": 300.0}).source)
    view = SimpleNamespace(up_deg=350.0, reason=None)
    events = [SimpleNamespace(located=SimpleNamespace(heading_deg=350.0 + turn), view=view) for turn in rotation_deg]
    missed = SimpleNamespace(located=None, view=view)
    for event in [events[0], missed, events[1]] * 4:
        watch.update(event)
    assert link.texts() == []
    for event in [missed, *events, *events]:
        watch.update(event)
    assert [text.removeprefix("edgevpr: ").replace("-180", "180") for _, text in link.texts()] == said


@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_images_are_reported_once_and_only_if_none_matches(make_flight, clock, link, axis):
    mirrored = [np.flip(picture, axis).copy() for picture in draw_pictures(8)]
    lines = make_flight().fly(FakeSource([*mirrored, *mirrored, *mirrored[:4]], clock))
    assert not any(line["accepted"] for line in select(lines, "query"))
    assert link.texts() == [(4, f"edgevpr: {ReasonCode.IMAGES_MIRRORED.summary}")]
    (line,) = select(lines, "camera")
    assert line["note"]["code"] == "IMAGES_MIRRORED"


def test_pictures_of_other_ground_are_not_reported_as_mirrored(make_flight, clock, link):
    make_flight().fly(FakeSource(draw_pictures(35, first=100), clock))
    assert link.texts() == []
