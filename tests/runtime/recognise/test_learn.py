"""Which frames become places: with a real map file, a real index, and a clock to turn."""

import math

import numpy as np
import pytest
from fakes import FakeClock, vehicle_at

from edgevpr.core.config import load_config
from edgevpr.core.contract import Descriptor
from edgevpr.core.errors import MapError, UsageError
from edgevpr.core.types import Frame, Position
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled
from edgevpr.places.index import GrowingIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.decide import Matcher, WalkSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.judge import AcceptRule
from edgevpr.runtime.recognise.learn import Learner, check_positions
from edgevpr.runtime.recognise.locate import at_place
from edgevpr.runtime.recognise.place_filter import Followed
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.techniques import create

TECHNIQUE = create("hog", {"w1": 32})
SPACING_M = 10.0
GAP_M = 100.0
METRE_DEG = 1 / 111_195  # of latitude


class Bench:
    """A learner over an empty map, and the moment it is."""

    def __init__(self, path, places_in_ram=100):
        self.clock = FakeClock()
        self.map = PlaceMap.create(path, TECHNIQUE.spec)
        self.growing = GrowingIndex(self.map, TECHNIQUE, budget_bytes=10**6, room=places_in_ram)
        self.recogniser = Recogniser(
            FrameEncoder(technique=TECHNIQUE),
            self.map,
            Matcher(self.growing.index, AcceptRule(min_score=0.0, min_margin=0.0, neighbour_m=50.0)),
            QueryMeter(load_board("this")),
            settings=WalkSettings(),
        )
        self.learner = Learner(
            self.recogniser, self.growing, spacing_m=SPACING_M, gap_m=GAP_M, utc_clock=self.clock.utc_s
        )

    def see(
        self,
        north_m=0.0,
        heard_s_ago=0.1,
        has_gps=True,
        t_fix_s=-math.inf,
        quality=0.9,
        position=None,
        followed=None,
    ):
        """Show a frame, at a place that the autopilot or the frame itself tells; `t_fix_s` is when a fix was sent or
        taken that may be in what the autopilot tells."""
        now_s = self.clock.now_s
        frame = Frame(image=np.zeros((8, 8), np.uint8), name=f"{north_m}", t_mono_s=now_s, position=position)
        vehicle = None
        if heard_s_ago is not None:
            there = 50 + north_m * METRE_DEG, 8.0, now_s - heard_s_ago
            vehicle = vehicle_at(*there, alt_m=312.0, heading_deg=90.0, has_gps=has_gps, t_fix_s=t_fix_s)
        part = np.random.default_rng(int(abs(north_m))).random(TECHNIQUE.spec.coarse.shape).astype("<f2")
        event = Recognition(
            frame=frame,
            vehicle=vehicle,
            picture=Levelled(frame.image, None, UNKNOWN_VIEW),
            descriptor=Descriptor(coarse=part, quality=quality),
            followed=followed,
        )
        return self.learner.learn(event)


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path / "m.gpkg")
    yield bench
    bench.map.close()


def test_a_frame_becomes_a_place_in_file_and_index_where_the_autopilot_is(bench):
    place = bench.see(north_m=40.0)
    assert place.position == Position(50 + 40 * METRE_DEG, 8.0, 312.0)
    (held,) = bench.map.places()
    assert held.place_id == place.place_id == bench.recogniser.index.place_ids[0]
    assert (held.heading_deg, held.quality, held.source_image) == (90.0, 0.9, "40.0")
    assert held.position.lat_deg == bench.recogniser.index.lat_deg[0]
    assert held.t_utc_s is not None
    assert bench.learner.learnt == 1


def test_a_recordings_own_position_counts_before_the_autopilots_and_is_no_echo(bench):
    own = Position(51.0, 9.0)
    assert bench.see(position=own, t_fix_s=bench.clock.now_s).position == own
    assert bench.see(position=Position(52.0, 9.0), heard_s_ago=None) is not None


def test_where_the_autopilot_only_reckons_nothing_is_learnt(bench):
    assert bench.see(has_gps=False) is None
    assert bench.learner.passed_over == {"without GPS": 1}
    assert bench.see(has_gps=True) is not None


def test_near_a_place_of_the_file_nothing_is_learnt(bench):
    assert bench.see(0.0)
    assert bench.see(9.9) is None
    assert bench.see(10.2)
    assert bench.see(15.0) is None
    assert bench.see(-10.2)
    assert bench.learner.passed_over == {"near a place": 2}
    assert len(bench.map) == 3


def test_a_place_that_was_given_up_in_ram_is_not_learnt_again(tmp_path):
    bench = Bench(tmp_path / "m.gpkg", places_in_ram=4)
    for turn in range(2):
        for number in range(12):
            assert (bench.see(20.0 * number) is None) == (turn == 1)
    assert len(bench.map) == 12
    assert len(bench.recogniser.index) <= 4
    bench.map.close()


@pytest.mark.parametrize("quality", [0.19, math.nan])
def test_a_frame_that_says_little_is_left_out(bench, quality):
    assert bench.see(quality=quality) is None
    assert bench.learner.passed_over == {"of low quality": 1}
    assert bench.see(quality=0.2)


def test_after_a_fix_of_ours_the_autopilot_may_only_repeat_it(bench):
    sent_s = bench.clock.now_s
    for seconds, expected in ((0.0, False), (9.9, False), (10.0, True)):
        bench.clock.now_s = sent_s + seconds
        assert (bench.see(t_fix_s=sent_s) is not None) == expected
    assert bench.learner.passed_over == {"just after a fix": 2}


def by_flight(lost, mass, north_m=0.0, sd_m=3.0, has_estimate=True):
    """What a flight knows that is likeliest so far to the north."""
    there = at_place(Position(50 + north_m * METRE_DEG, 8.0), sd_m)
    return Followed(slot=0, confidence=mass, lost=lost, mass=mass, estimate=there if has_estimate else None)


UNSURE, AGAINST_IT = "while not sure where it is", "where the flight so far contradicts it"


@pytest.mark.parametrize(
    ("followed", "objection"),
    [
        (None, None),
        (by_flight(0.5, 0.5, has_estimate=False), None),
        (by_flight(0.95, 0.05, north_m=9000.0), None),
        (by_flight(0.85, 0.15), UNSURE),
        (by_flight(0.1, 0.85), UNSURE),
        (by_flight(0.02, 0.95), None),
        (by_flight(0.02, 0.95, north_m=25.0), None),
        (by_flight(0.02, 0.95, north_m=300.0), AGAINST_IT),
        (by_flight(0.02, 0.95, north_m=300.0, sd_m=100.0), None),
    ],
)
def test_a_place_is_learnt_where_the_flight_is_sure_to_be_off_the_map_or_there(bench, followed, objection):
    place = bench.see(followed=followed)
    assert (place is None) == (objection is not None)
    assert bench.learner.passed_over == ({objection: 1} if objection else {})
    assert bench.see(followed=by_flight(0.99, 0.01), north_m=40.0), "once it is sure, it is learnt"


def test_trouble_with_the_file_ends_the_learning_and_nothing_else(bench):
    assert bench.see(0.0)
    (pages,) = bench.map.db.execute("PRAGMA page_count").fetchone()
    bench.map.db.execute(f"PRAGMA max_page_count = {pages}")
    places = [bench.see(20.0 * number) for number in range(1, 30)]
    assert None in places
    assert "make room" in bench.learner.trouble
    learnt = bench.learner.learnt
    assert learnt == 1 + len([place for place in places if place]) == len(bench.map)
    bench.map.db.execute("PRAGMA max_page_count = 100000")
    assert bench.see(1000.0) is None, "it has stopped for good"
    assert len(bench.recogniser.index) == learnt
    assert "then stopped" in bench.learner.summary


def test_a_place_that_is_in_the_file_is_told_though_the_index_cannot_follow(bench):
    bench.growing.add = lambda *_: (_ for _ in ()).throw(MapError("m.gpkg: the file is damaged."))
    assert bench.see(0.0).place_id == 1
    assert "damaged" in bench.learner.trouble
    assert len(bench.map) == 1


def test_a_flight_that_could_never_know_where_it_is_is_refused(tmp_path):
    def config(**overrides):
        return load_config(None, {"source.uri": str(tmp_path)} | overrides)

    with pytest.raises(UsageError, match="--link"):
        check_positions(config(**{"source.uri": "/dev/video0"}))
    check_positions(config(**{"mavlink.link": "udpout:127.0.0.1:9"}))
    check_positions(config())
