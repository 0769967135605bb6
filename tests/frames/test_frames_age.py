"""The time at which pictures of a stream were taken, by their time stamps and by when they arrived."""

import queue
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from fakes import FakeClock

from edgevpr.frames.streams import Arrivals, StampedTime, UnstampedTime

STEP_S = 0.05


def feed(time, pictures, *, stamp_s=100.0, t_mono_s=1000.0, delay_s=lambda number: 0.0, drift=0.0):
    """Let so many pictures arrive, one every 50 ms; returns how old each is said to be on arrival."""
    ages_s = []
    for number in range(pictures):
        stamp = stamp_s + number * STEP_S * (1 + drift)
        now = t_mono_s + number * STEP_S + delay_s(number)
        time.arrived(stamp, stamp, now)
        taken = time.taken_s(stamp, now)
        ages_s.append(None if taken is None else now - taken)
    return ages_s


def test_what_a_picture_took_longer_than_the_quickest_is_its_age():
    ages_s = feed(StampedTime(), 100, delay_s=lambda number: 0.8 if 60 <= number < 70 else 0.0)
    assert ages_s[3:60] == [pytest.approx(0, abs=1e-9)] * 57
    assert ages_s[60:70] == [pytest.approx(0.8)] * 10
    assert ages_s[70:] == [pytest.approx(0)] * 30


def test_pictures_that_have_waited_for_the_opening_have_no_time():
    """Forty pictures are there at once, the last of them new; then one comes every 50 ms."""
    ages_s = feed(StampedTime(), 80, delay_s=lambda number: max(0.0, 2.0 - number * STEP_S))
    assert ages_s[:40] == [None] * 40
    assert ages_s[50:] == [pytest.approx(0, abs=1e-9)] * 30


def test_no_picture_is_taken_after_it_has_arrived():
    time = StampedTime()
    feed(time, 20)
    assert time.taken_s(500.0, 1001.0) == 1001.0


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_clocks_that_drift_make_no_picture_old(drift):
    """An hour at 0.01 %: 0.36 s that are nobody's age."""
    ages_s = feed(StampedTime(), 72_000, drift=drift)
    assert max(ages_s[3:]) < 0.01


@pytest.mark.parametrize("delay", ["wavers", "grows"])
def test_a_delay_that_wavers_or_grows_is_age_for_as_long_as_it_lasts(delay):
    """A network that is jammed for a minute, after ten pictures in time; and a reader too slow for the stream."""
    wavering = np.random.default_rng(1).uniform(2.0, 2.5, 1200)
    delays_s = {"wavers": np.where(np.arange(1200) < 10, 0.0, wavering), "grows": 0.02 * np.arange(1200)}[delay]
    ages_s = feed(StampedTime(), 1200, delay_s=lambda number: delays_s[number])
    assert ages_s[10:] == pytest.approx(delays_s[10:])


def test_a_sender_that_has_paused_without_counting_is_new_again_after_ten_seconds():
    ages_s = feed(StampedTime(), 400, delay_s=lambda number: 1.5 if number >= 100 else 0.0)
    assert ages_s[100] == pytest.approx(1.5)
    assert ages_s[310:] == [pytest.approx(0)] * 90


@pytest.mark.parametrize("stamp_s", [0.0, 5000.0])
def test_a_sender_that_begins_anew_is_followed(stamp_s):
    time = StampedTime()
    feed(time, 40)
    ages_s = feed(time, 40, stamp_s=stamp_s, t_mono_s=1010.0)
    assert ages_s[0] is None
    assert ages_s[5:] == [pytest.approx(0, abs=1e-9)] * 35


def test_pictures_that_are_sent_out_of_turn_are_no_new_beginning():
    time, order = StampedTime(), [0, 3, 1, 2, 6, 4, 5, 9, 7, 8, 12, 10, 11]
    for turn, number in enumerate(order):
        now = 1000.0 + turn * STEP_S
        time.arrived(number * STEP_S, (turn - 1) * STEP_S, now)
    assert time.taken_s(11 * STEP_S, now) is not None


def test_without_stamps_a_picture_that_was_there_already_is_as_old_as_the_last_wait():
    time = UnstampedTime(opened_s=10.0)
    assert time.taken_s(asked_s=10.5, t_mono_s=10.5001) == 10.0
    assert time.taken_s(asked_s=10.5, t_mono_s=10.6) == 10.5, "it was waited for since then"
    assert time.taken_s(asked_s=13.0, t_mono_s=13.0005) == 10.5, "it may have come at any moment since"


def test_without_stamps_one_that_comes_when_it_is_due_is_new_and_one_that_was_held_up_may_be_old():
    time = UnstampedTime(opened_s=0.0)
    taken_s = [time.taken_s(0.2 * number, 0.2 * number + 0.19) for number in range(20)]
    assert taken_s[:9] == pytest.approx([0.2 * number for number in range(9)]), "what is usual is not known yet"
    assert taken_s[9:] == pytest.approx([0.2 * number + 0.19 for number in range(9, 20)])
    assert time.taken_s(4.0, 6.0) == 4.0
    assert time.taken_s(6.0, 6.0005) == 4.0, "it was held up with it"
    assert time.taken_s(6.1, 6.25) == 6.25


class Sender:
    """Sends what the test gives it; None is the end."""

    def __init__(self, clock):
        self._clock, self._sent = clock, queue.Queue()
        self.has_ended = threading.Event()

    def send(self, packet, t_mono_s):
        self._sent.put((packet, t_mono_s))

    def fetch(self):
        packet, self._clock.now_s = self._sent.get()
        if packet is None:
            self.has_ended.set()
        if isinstance(packet, Exception):
            raise packet
        return packet


@pytest.fixture
def clock():
    return FakeClock(10.0)


@pytest.fixture
def sender(clock):
    return Sender(clock)


def packet(is_keyframe=False):
    return SimpleNamespace(packet=SimpleNamespace(is_keyframe=is_keyframe))


def test_packets_that_wait_have_the_time_at_which_they_came_and_the_order(clock, sender):
    packets = [packet(), packet(), packet()]
    for number, each in enumerate(packets):
        sender.send(each, 11.0 + number)
    sender.send(None, 20.0)
    arrivals = Arrivals(sender.fetch, clock)
    sender.has_ended.wait(60)
    found = list(iter(arrivals.next, None))
    assert found == [(packets[0], 10.0, 11.0), (packets[1], 11.0, 12.0), (packets[2], 12.0, 13.0)]
    assert arrivals.next() is None, "the stream is still lost"


def test_it_is_known_whether_a_key_frame_waits(clock, sender):
    sender.send(packet(), 11.0)
    sender.send(packet(is_keyframe=True), 12.0)
    sender.send(None, 13.0)
    arrivals = Arrivals(sender.fetch, clock)
    sender.has_ended.wait(60)
    arrivals.next()
    assert arrivals.can_begin_anew()
    arrivals.next()
    assert not arrivals.can_begin_anew()


def test_a_failure_while_fetching_is_the_loss_of_the_stream(clock, sender, monkeypatch):
    failures = []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    arrivals = Arrivals(sender.fetch, clock)
    sender.send(MemoryError(), 11.0)
    assert arrivals.next() is None
    arrivals.close()
    assert [failure.exc_type for failure in failures] == [MemoryError]
