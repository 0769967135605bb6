"""A flight whose autopilot tells attitude, heading and height: its pictures are levelled by those of their own time."""

import numpy as np
import pytest
from fakes import FakeClock, FakeLink, FakeSource, make_receiver, make_vehicle
from flights import STEP_DEG, Flight, select
from pictures import draw_texture
from walks import make_map

from edgevpr.core.types import Frame, Position
from edgevpr.runtime.flight import watching
from edgevpr.runtime.flight.survey import MapSurvey, SurveyMeasure, SurveyResult
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

PLACES = 5
FAR_APART = {"source.fov_deg": 66.0, "source.rate_hz": 0.1}


@pytest.fixture(scope="module")
def place_map(tmp_path_factory):
    technique = create("cohog", {"camera": "nadir"})
    frames = (
        Frame(
            image=draw_texture(place + 20, 256, 256),
            name=f"{place}",
            t_mono_s=0.0,
            position=Position(50 + place * STEP_DEG, 8.0),
            heading_deg=0.0,
        )
        for place in range(PLACES)
    )
    return make_map(tmp_path_factory.mktemp("level") / "m.gpkg", technique, frames)


def fly(place_map, log, turns, **said):
    """The queries of a flight over the first places, the nose to the east where it `turns`, and the times at which its
    link was asked for the attitude."""
    clock, asked_s = FakeClock(), []

    def vehicle():
        return make_vehicle(50.0, 8.0, clock.now_s, heading_deg=90.0 if turns else 0.0, **said)

    link = FakeLink(clock, vehicle=vehicle)
    link.predict_vehicle = lambda t_mono_s: (asked_s.append(t_mono_s), vehicle())[1]
    images = [np.ascontiguousarray(np.rot90(draw_texture(place + 20, 256, 256), turns)) for place in range(3)]
    source = FakeSource(images, clock, work=lambda: clock.sleep(1.0))
    lines = Flight(place_map, log, clock, link, **{"source.fov_deg": 66.0, "match.reach_m_s": 20.0}).fly(source)
    return select(lines, "query"), asked_s


def test_flight_reads_the_attitude_at_the_frame_time(place_map, tmp_path):
    queries, asked_s = fly(place_map, tmp_path / "f.jsonl", 1, roll_deg=0.2, pitch_deg=0.0, height_m=80.0)
    assert asked_s == [query["t_frame_s"] for query in queries]
    assert [query["reference_image"] for query in queries if query["accepted"]] == ["0", "1", "2"]
    assert all(query["rotation_deg"] == 0 for query in queries), "each was turned north-up before it was asked"
    assert all(query["view"]["up_deg"] == 0.0 for query in queries)
    assert queries[0]["view"]["footprint_m"] == pytest.approx(103.9, abs=0.1)
    assert queries[0]["hints"] == {"reach_m": pytest.approx(111.2, abs=0.1), "heading": True}, "of the autopilot"


@pytest.mark.parametrize(("is_live", "has_gps", "t_s"), [(True, False, 2.0), (True, True, 10.0), (False, False, 10.0)])
def test_flight_takes_odometry_frames_between_rare_queries_without_gps(place_map, tmp_path, is_live, has_gps, t_s):
    clock = FakeClock()

    def vehicle():
        level = {"heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0, "height_m": 80.0}
        gps = make_receiver((50.0, 8.0), 1.0, clock.now_s) if has_gps else None
        return make_vehicle(50.0, 8.0, clock.now_s, velocity_m_s=(0.0, 0.0), has_gps=has_gps, gps=gps, **level)

    source = FakeSource([draw_texture(20, 256, 256)] * 21, clock, is_live=is_live)
    flown = Flight(place_map, tmp_path / "f.jsonl", clock, FakeLink(clock, vehicle=vehicle), **FAR_APART)
    lines = flown.fly(source)
    queries = select(lines, "query")
    starts_s = [query["odometry"]["from_s"] - query["t_frame_s"] for query in queries[1:]]
    assert starts_s[1:] == [pytest.approx(-t_s, abs=0.25)] * (len(queries) - 2)
    assert len(queries) == (4 if t_s < 10.0 else 21), "the others are no queries"
    assert not select(lines, "unusable")
    assert flown.end["queries"] == len(queries)


@pytest.fixture
def fixed_survey(monkeypatch):
    """Nine degrees ahead, and a map that lies 5 m beside GPS: what each survey finds."""
    known, unknown = SurveyMeasure((9.0,), 0.9, 1.5, 1.0), SurveyMeasure((0.0,), 9.0, 1.5, 1.0)
    off_m = SurveyMeasure((3.0, -4.0), 0.5, 1.0, 1.0)
    where = Position(50.0, 8.0)
    measures = {"off_m": off_m, "scale": unknown, "ahead_deg": known, "right_deg": unknown}
    found = SurveyResult(matches=99, middle=where, measures=measures)
    monkeypatch.setattr(MapSurvey, "compute_result", lambda self: found)


def test_flight_reports_a_strip_of_its_images_once(place_map, tmp_path):
    images = [np.pad(draw_texture(number, 256, 192), ((0, 0), (0, 24))) for number in range(20)]
    link = FakeLink(clock := FakeClock())
    lines = Flight(place_map, tmp_path / "f.jsonl", clock, link, **FAR_APART).fly(FakeSource(images, clock))
    assert [line["note"]["code"] for line in select(lines, "camera")] == ["STRIP_FOUND"]
    assert (4, "edgevpr: 24 px at the right never change: crop") in link.texts()


@pytest.mark.usefixtures("fixed_survey")
def test_images_are_levelled_once_the_attitude_is_known(place_map, tmp_path, monkeypatch):
    monkeypatch.setattr(watching, "_SURVEY_INTERVAL", 2)
    monkeypatch.setattr(MapSurvey, "add_match", lambda self, event, distrusts_gps: True)
    queries, _ = fly(place_map, tmp_path / "f.jsonl", 0, roll_deg=0.0, pitch_deg=0.0, height_m=80.0)
    _, *of_under = zip(*(query["view"]["nadir_offset"] for query in queries), strict=True)
    behind = -80.0 * np.tan(np.radians(9.0)) / 103.9
    assert of_under == [pytest.approx((0.0, 0.0, behind), abs=0.002)]
