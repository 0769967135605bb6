"""Following a flight: what looks at a map become with those before them, over maps in order and maps with positions."""

import math

import numpy as np
import pytest
from fakes import make_vehicle
from fixed_confidence import make_model

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec, TechniqueSpec
from edgevpr.core.geodesy import distance_m, offset_between_m, offset_position
from edgevpr.core.types import Frame, Pose, Position
from edgevpr.frames.level import View
from edgevpr.places.index import PlaceIndex, allocate_index
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import Ranking
from edgevpr.runtime.recognise.evidence import Evidence
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.place_filter import PlaceFilter

PLACES = 150
SPACING_M = 20.0
FOOTPRINT_M = 80.0
STRIDE = 3  # places from look to look, at one a second: each look is of new ground
SPEC = TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4"))
VIEW = View(up_deg=0.0, footprint_m=FOOTPRINT_M, nadir_offset=(0.0, 0.1))
BLANK = np.zeros((4, 4), np.uint8)
CERTAIN = 0.98
STEP_M = 0.6 * SPACING_M * STRIDE, 0.8 * SPACING_M * STRIDE
SIMILAR_PLACES = 7  # places elsewhere that a look is a little like


def to_position(place):
    return Position(*offset_position(50.0, 8.0, 0.6 * SPACING_M * place, 0.8 * SPACING_M * place))


def make_index(positions):
    """An index of places with these positions (None: unknown), numbered from 101."""
    index = allocate_index(SPEC, len(positions), None)
    index.place_ids[:] = 101 + np.arange(len(positions))
    for slot, position in enumerate(positions):
        index.lat_deg[slot], index.lon_deg[slot] = (position.lat_deg, position.lon_deg) if position else (np.nan,) * 2
    return index


ORDER_INDEX = make_index([None] * PLACES)
METRIC_INDEX = make_index([to_position(place) for place in range(PLACES)])


class Flight:
    """A follower over a real map, and the looks of one flight: `look` hears one and keeps it."""

    def __init__(self, place_map: PlaceMap, index: PlaceIndex, max_speed_m_s: float | None = None) -> None:
        self.follower = PlaceFilter(place_map, max_speed_m_s=max_speed_m_s, is_live=True)
        self.place_map, self.index, self.t_s = place_map, index, 1000.0
        self.has_poses = read_layers(place_map).median_m is not None

    def advance(self, elapsed_s=float(STRIDE), velocity_m_s=None, moved_m=None):
        """Go on, `moved_m` (east, north) by the camera's own motion."""
        before_s, self.t_s = self.t_s, self.t_s + elapsed_s
        vehicle = make_vehicle(50.0, 8.0, self.t_s, velocity_m_s=velocity_m_s)
        told_m = moved_m and (moved_m[0] / 1.4, moved_m[1] / 1.4)  # by a reported height that is too low
        stride = moved_m and OdometryStep(from_s=before_s, to_s=self.t_s, moved_m=told_m, sd_m=0.2, inliers=100)
        self.follower.predict(Frame(image=BLANK, name="", t_mono_s=self.t_s), vehicle, stride, 1.4)

    def handle(self, place, p, of_map=None, others=(), lead=1.0, rival=0):
        """Update the filter with a query whose best place is `place`; 2.5 is halfway between places 2 and 3. 80
        landmarks agree with it, and `rival` with a place elsewhere."""
        best = round(place)
        similar = np.random.default_rng(best).permutation(len(self.index))[:SIMILAR_PLACES]
        others = [slot for slot in others or similar if slot != best]
        slots = np.array([best, *others], int)
        scores = np.array([0.3] + [0.29 if lead < 0.1 else 0.25 if rival else 0.2] * len(others), np.float32)
        compared = {slot: FineMatch(float(score)) for slot, score in zip(slots.tolist(), scores, strict=True)}
        counts = {"landmarks": math.log1p(80), "rival": math.log1p(rival)}
        evidence = Evidence(agree=-1.0, lead=lead, coverage=-1.0, **counts)
        rule = make_model(lambda evidence: p, lambda evidence: p if of_map is None else of_map)
        where = None
        if self.has_poses:
            number = int(self.index.place_ids[best])
            position = to_position(place)
            where = Located(position=position, covariance_m2=(9.0, 1.0, 9.0), heading_deg=350.0, places=(number,))
        ranking = Ranking(slots=slots, scores=scores, compared=compared)
        return self.follower.update(ranking, self.index, evidence, rule, where, VIEW)

    def query(self, place, p=0.8, elapsed_s=float(STRIDE), velocity_m_s=None, moved_m=None, **more):
        self.advance(elapsed_s, velocity_m_s, moved_m)
        followed = self.handle(place, p, **more)
        self.follower.commit()
        assert_sound(followed)
        return followed

    def query_places(self, places, p=0.8, **more):
        return [self.query(place, p, **more) for place in places]


def assert_sound(followed):
    assert 0 <= followed.confidence <= 1 + 1e-9
    assert 0 <= followed.lost <= 1
    assert 0 <= followed.mass <= 1 + 1e-9
    if followed.estimate:
        assert np.isfinite([followed.estimate.position.lat_deg, followed.estimate.position.lon_deg]).all()
        assert 0 < followed.estimate.sd_m < np.inf


def measure_off_m(followed, place):
    here, there = followed.estimate.position, to_position(place)
    return distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg)


@pytest.fixture(params=["in order", "positions", "poses"])
def flight(request, tmp_path):
    with make_bare_map(tmp_path / "m.gpkg", has_poses=request.param == "poses") as place_map:
        yield Flight(place_map, ORDER_INDEX if request.param == "in order" else METRIC_INDEX)


@pytest.fixture
def bare_map(tmp_path):
    with make_bare_map(tmp_path / "bare.gpkg", has_poses=False) as place_map:
        yield place_map


@pytest.fixture
def posed_map(tmp_path):
    with make_bare_map(tmp_path / "posed.gpkg", has_poses=True) as place_map:
        yield place_map


def make_bare_map(path, has_poses):
    """A map of a few places: a follower asks it for nothing but how large their ground is."""
    place_map = PlaceMap.create(path, SPEC)
    for place in range(3):
        pose = Pose(up_deg=0.0, footprint_m=FOOTPRINT_M, covariance_m2=(4.0, 0.0, 4.0)) if has_poses else None
        frame = Frame(image=BLANK, name=f"{place}", t_mono_s=0.0, position=to_position(place), pose=pose)
        place_map.add(frame, Descriptor(coarse=np.zeros(1, "<f4")))
    return place_map


@pytest.mark.parametrize("p", [0.01, 0.5, 0.9, 0.9999])
def test_place_filter_uses_the_first_query_unchanged(flight, p):
    followed = flight.query(20, p)
    assert followed.slot == 20
    assert followed.confidence == pytest.approx(p)
    assert followed.lost == pytest.approx(1 - p)
    assert not followed.prefers_other(20)


def test_place_filter_shares_the_remaining_probability_among_other_places(flight):
    followed = flight.query(20, 0.1, of_map=0.9, others=(40,))
    assert followed.slot == 40
    assert 0.1 < followed.confidence < 0.8, "it may be none of those that were compared"
    assert followed.confidence + followed.lost == pytest.approx(0.9)
    assert followed.prefers_other(20)
    assert not followed.prefers_other(40)


def test_positions_are_those_of_the_places(posed_map, bare_map):
    posed, bare = Flight(posed_map, METRIC_INDEX), Flight(bare_map, METRIC_INDEX)
    for place in np.arange(10, 60, 2.5):
        found = posed.query(place)
        assert measure_off_m(found, place) < SPACING_M / 2
    assert found.estimate.sd_m < SPACING_M
    assert found.estimate.heading_deg == pytest.approx(350.0)
    assert found.mass > CERTAIN
    for place in range(10, 60, STRIDE):
        found = bare.query(place)
        assert measure_off_m(found, place) < SPACING_M
    assert found.estimate.heading_deg is None
    assert found.estimate.sd_m > SPACING_M / 4, "a place says no better where the aircraft is than it is apart"


def test_place_filter_does_not_count_a_place_of_the_same_position_as_another(posed_map):
    where = Located(position=to_position(20), covariance_m2=(9.0, 0.0, 9.0), places=(121, 141))
    slots = np.array([20, 40])
    scores = np.array([0.3, 0.3], np.float32)
    ranking = Ranking(slots=slots, scores=scores, compared={20: FineMatch(0.3), 40: FineMatch(0.3)})
    follower = PlaceFilter(posed_map, max_speed_m_s=None, is_live=True)
    rule = make_model(lambda evidence: 0.6, lambda evidence: 0.9)
    followed = follower.update(ranking, METRIC_INDEX, Evidence(agree=-1.0, lead=1.0, coverage=-1.0), rule, where, VIEW)
    assert (followed.slot, followed.confidence) == (20, pytest.approx(0.6))
    assert followed.lost == pytest.approx(0.4)


def test_place_filter_predicts_looking_down_only_after_a_certain_match(flight):
    weak = flight.query_places(range(10, 40, STRIDE))
    assert weak[-1].confidence > CERTAIN
    assert weak[-1].predicted < 1e-6
    flight.query(40, 0.95)
    assert flight.query(43).predicted > 0.9


def test_place_filter_is_lost_beyond_the_map(posed_map):
    flight = Flight(posed_map, METRIC_INDEX)
    flight.query_places(range(10, 40, STRIDE))
    east_m, north_m = 0.8 * SPACING_M * STRIDE, -0.6 * SPACING_M * STRIDE  # across the row of places
    found = [flight.query(80, 0.01, moved_m=(east_m, north_m), velocity_m_s=(0.0, 0.0)) for _ in range(4)]
    assert found[0].lost < 0.6
    assert found[3].lost > 0.95


@pytest.mark.parametrize("t_utc_s", [None, float("nan")])
def test_place_filter_tracks_a_recording_without_times(flight, t_utc_s):
    follower = flight.follower = PlaceFilter(flight.place_map, max_speed_m_s=None, is_live=False)
    for place in range(10, 70, STRIDE):
        follower.predict(Frame(image=BLANK, name="", t_mono_s=0.0, t_utc_s=t_utc_s), None)
        followed = flight.handle(place, 0.9)
        follower.commit()
    assert followed.slot == 67
    assert followed.confidence > 0.95


def test_place_filter_keeps_only_the_last_pass_of_a_frame(flight):
    other = Flight(flight.place_map, flight.index)
    for each in (flight, other):
        each.query_places(range(10, 40, STRIDE))
        each.advance()
    flight.handle(90, 0.9)
    assert flight.handle(40, 0.9) == other.handle(40, 0.9)
    flight.follower.commit(), other.follower.commit()
    assert flight.query(43) == other.query(43)


def test_place_filter_gives_no_confidence_from_a_place_without_position(posed_map, bare_map):
    some = make_index([None if place % 3 == 0 else to_position(place) for place in range(PLACES)])
    for place_map in (posed_map, bare_map):
        flight = Flight(place_map, some)
        flight.has_poses = False
        followed = flight.query(30, 0.95, others=(41, 50))
        assert followed.confidence < 0.1
        assert not followed.prefers_other(30)
        assert followed.lost > 0.9


def measure_displacement_m(places):
    """Metres east and north by so many places."""
    return offset_between_m(to_position(0), to_position(places))


def fly_across_gap(place_map, moved_m, away=60, p=0.5):
    """Six places found, three queries that find nothing while the flight goes on, then one that is right."""
    flight = Flight(place_map, METRIC_INDEX)
    for place in range(6):
        flight.query(place, moved_m=measure_displacement_m(1))
    for place in range(6, 9):
        flight.query(place + away, p=0.01, moved_m=moved_m)
    return flight, flight.query(9, p=p, moved_m=moved_m)


def test_place_filter_confirms_a_doubtful_match_by_odometry(posed_map):
    _, blind = fly_across_gap(posed_map, None)
    _, seen = fly_across_gap(posed_map, measure_displacement_m(1))
    assert blind.confidence < 0.9  # of a match that is right half the time
    assert seen.confidence > 0.96
    assert measure_off_m(seen, 9) < SPACING_M


def test_place_filter_counts_failed_queries_over_the_same_ground_once(posed_map):
    flight = Flight(posed_map, METRIC_INDEX)
    for place in range(6):
        flight.query(place, moved_m=measure_displacement_m(1))
    lost = [flight.query(60, p=0.01, elapsed_s=1.0, moved_m=measure_displacement_m(0.02)).lost for _ in range(20)]
    assert lost[-1] < 0.5


@pytest.mark.parametrize("moved_m", [None, measure_displacement_m(1)])
def test_place_filter_recovers_from_a_wrong_estimate(posed_map, moved_m):
    """Carried off by half the map, while the camera sees nothing of it, or sees a motion that is not the aircraft's."""
    flight, _ = fly_across_gap(posed_map, moved_m)
    found = [flight.query(place, p=0.9, moved_m=moved_m) for place in range(60, 66)]
    assert found[-1].confidence >= 0.9
    assert found[-1].mass > CERTAIN
    assert measure_off_m(found[-1], 65) < SPACING_M


def test_place_filter_never_confirms_one_of_several_twins(posed_map):
    flight = Flight(posed_map, METRIC_INDEX)
    for place in range(20, 60, STRIDE):
        assert flight.query(place, 0.9999, others=[place + 60], lead=0.15, rival=75, moved_m=STEP_M).confidence < 0.9
