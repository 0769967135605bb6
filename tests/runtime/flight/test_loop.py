"""The loop: it ends when told to, at once where it must, keeps its pace, and goes on whatever a frame brings."""

from functools import partial

import pytest
from fakes import FakeSource
from flights import select
from pictures import draw_texture

from edgevpr.core.config import SourceConfig
from edgevpr.core.errors import ImageError
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.startup import apply_recorded_rate
from edgevpr.runtime.flight.stop import Stop, StopNow

PICTURE = draw_texture(1, 240, 320)


@pytest.fixture
def flight(make_flight):
    return partial(make_flight, "hog", **{"source.rate_hz": 0.5})


def test_stop_between_frames_ends_the_flight_within_a_turn(flight, clock):
    flown = flight()
    slept = []

    def sleep(seconds):
        slept.append(seconds)
        clock.now_s += seconds
        flown.stop()

    object.__setattr__(clock.clock, "sleep", sleep)
    assert len(select(flown.fly(FakeSource([PICTURE] * 9, clock)), "query")) == 1
    assert slept == [pytest.approx(0.2)]


def test_stop_interrupts_the_recognition_of_a_frame(flight, clock):
    flown = flight()

    def encode_until_stop(image, mask):
        flown.stop()  # a signal comes
        raise AssertionError("the signal breaks this off")

    flown.recogniser.technique.encode = encode_until_stop
    assert flown.fly(FakeSource([PICTURE] * 9, clock)) == [], "what was broken off is no query"
    flown.stop()  # and a second signal finds nothing to break off


def test_stop_lets_observers_finish(flight, clock):
    flown = flight()
    send = flown.link.send
    flown.link.send = lambda *messages: (flown.stop(), send(*messages))
    assert len(select(flown.fly(FakeSource([PICTURE] * 9, clock)), "query")) <= 1
    stop = Stop()
    with pytest.raises(StopNow), stop.allow_interrupt():
        stop()
    assert stop.is_requested


def test_stop_before_the_start_ends_the_flight_at_once():
    stop = Stop()
    with pytest.raises(StopNow), stop.interrupt_start():
        stop()
    with pytest.raises(StopNow), stop.interrupt_start():
        pytest.fail("it was stopped before")
    stop()  # nothing is left to break off


def test_unreadable_frame_is_logged_and_the_next_one_recognised(flight, clock):
    flown = flight()
    lines = flown.fly(FakeSource([PICTURE, ImageError("1.png truncated"), PICTURE], clock, is_live=False))
    assert [line["reason"]["parameters"] for line in select(lines, "unusable")] == [{"problem": "1.png truncated"}]
    assert len(select(lines, "query")) == 2
    assert (flown.end["queries"], flown.end["unusable"]) == (2, 1)


def test_pace_takes_frames_evenly_even_after_a_late_one(clock):
    pace = Pace(2.0, clock.clock)
    assert pace.wait_s() == 0
    pace.record_frame()
    assert pace.wait_s() == pytest.approx(0.5)
    clock.now_s += 1.7
    assert pace.wait_s() == pytest.approx(-1.2)
    pace.record_frame()
    assert pace.wait_s() == 0, "what was missed is not made up for"
    pace.record_frame()
    assert pace.wait_s() == pytest.approx(0.5)
    pace.rate_hz = 1.0
    clock.now_s += 0.5
    pace.record_frame()
    assert pace.wait_s() == pytest.approx(1.0)


def test_pace_requests_odometry_frames_between_distant_frames(clock):
    pace, due_s = Pace(0.1, clock.clock), []
    pace.record_frame()
    for _ in range(100):
        clock.now_s += 0.1
        if pace.is_odometry_due(1.0):
            due_s.append(10.0 - pace.wait_s())
    assert due_s == pytest.approx([*range(1, 10)], abs=0.15)
    pace.record_frame()
    pace.rate_hz = 0.8
    clock.now_s += 3.0
    assert not pace.is_odometry_due(1.0), "queries show it themselves"


def test_frames_of_a_recording_come_by_its_steps_and_slower_as_the_rate_is_lowered(clock):
    pace = Pace(2.0, clock.clock)
    pace.record_frame(3.0)
    assert pace.wait_s() == pytest.approx(3.0)
    clock.now_s += 3.0
    pace.rate_hz = 1.0
    pace.record_frame(0.25)
    assert pace.wait_s() == pytest.approx(0.5)


def test_recorded_flight_follows_the_times_of_its_images(flight, clock):
    class Timed(FakeSource):
        def read(self, timeout_s):
            self.step_s = next(steps, None)
            return super().read(timeout_s)

    steps = iter((0.5, 0.0, 7.0))
    taken = [line["t_frame_s"] for line in select(flight().fly(Timed([PICTURE] * 4, clock, is_live=False)), "query")]
    assert [each - taken[0] for each in taken] == pytest.approx([0.0, 0.5, 0.5, 7.5])


def test_apply_recorded_rate_uses_the_most_frequent_interval():
    source = SourceConfig(rate_hz=1.0)
    assert apply_recorded_rate(source, [0.5, 0.0, 0.5, 60.0]).rate_hz == 2.0
    assert apply_recorded_rate(source, [1e-6, 1e-6]).rate_hz == 60.0
    assert apply_recorded_rate(source, []) is source


@pytest.mark.parametrize(
    ("trouble", "fed_s"), [(None, 45), ("is_lost", 100), ("is_frozen", 100), ("is_opening", 100), ("recording", 100)]
)
def test_watchdog_is_fed_while_the_lack_of_queries_has_a_known_reason(flight, clock, monkeypatch, trouble, fed_s):
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    fed = []
    monkeypatch.setattr(systemd, "notify", lambda **said: "WATCHDOG" in said and fed.append(clock.now_s))
    flown = flight(**{"source.rate_hz": 2.0})

    class Silent(FakeSource):
        def read(self, timeout_s):
            clock.now_s += timeout_s
            return None if clock.now_s < start_s + 100 else super().read(timeout_s)

    start_s, source = clock.now_s, Silent([PICTURE], clock, is_live=trouble != "recording")
    if trouble:
        setattr(source, trouble, True)
    flown.fly(source)
    assert max(fed) - start_s == pytest.approx(fed_s, abs=2)
