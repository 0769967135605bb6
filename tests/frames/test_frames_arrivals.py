"""Packets of a stream that wait for decoding."""

import queue
import threading
from types import SimpleNamespace

import pytest
from fakes import FakeClock
from live_sources import PATIENCE_S

from edgevpr.frames import streams
from edgevpr.frames.streams import Arrivals


class Sender:
    """Sends what the test gives it; None is the end. Nothing of it may be used after `close`."""

    def __init__(self, clock):
        self._clock, self._sent = clock, queue.Queue()
        self.has_ended, self.is_closed = threading.Event(), threading.Event()

    def send(self, packet, t_mono_s):
        self._sent.put((packet, t_mono_s))

    def fetch(self):
        packet, self._clock.now_s = self._sent.get()
        if packet is None:
            self.has_ended.set()
        if isinstance(packet, Exception):
            raise packet
        return packet

    def close(self):
        self.is_closed.set()


@pytest.fixture
def clock():
    return FakeClock(10.0)


@pytest.fixture
def sender(clock):
    return Sender(clock)


@pytest.fixture
def arrivals(clock, sender):
    found = Arrivals(sender.fetch, clock, sender.close)
    yield found
    sender.send(None, 0.0)
    found.close()
    assert sender.is_closed.wait(PATIENCE_S)


def packet(is_keyframe=False, size=1000):
    return SimpleNamespace(packet=SimpleNamespace(is_keyframe=is_keyframe, size=size))


def test_packets_that_wait_have_the_time_at_which_they_came_and_the_order(sender, arrivals):
    packets = [packet(), packet(), packet()]
    for number, each in enumerate(packets):
        sender.send(each, 11.0 + number)
    sender.send(None, 20.0)
    sender.has_ended.wait(PATIENCE_S)
    found = list(iter(arrivals.next, None))
    assert [each.fetched for each in found] == packets
    assert [(each.asked_s, each.t_mono_s) for each in found] == [(10.0, 11.0), (11.0, 12.0), (12.0, 13.0)]
    assert arrivals.next() is None, "the stream is still lost"


def test_it_is_known_whether_a_key_frame_waits(sender, arrivals):
    sender.send(packet(), 11.0)
    sender.send(packet(is_keyframe=True), 12.0)
    sender.send(None, 13.0)
    sender.has_ended.wait(PATIENCE_S)
    arrivals.next()
    assert arrivals.can_begin_anew()
    arrivals.next()
    assert not arrivals.can_begin_anew()


def test_a_failure_while_fetching_is_the_loss_of_the_stream(sender, arrivals, monkeypatch):
    failures = []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    sender.send(MemoryError(), 11.0)
    assert arrivals.next() is None
    arrivals.close()
    assert [failure.exc_type for failure in failures] == [MemoryError]


@pytest.mark.parametrize(("limit", "size"), [("_WAITING_BYTES", 100_000), ("_WAITING_PACKETS", 1)])
def test_what_waits_is_bounded_and_goes_on_with_a_key_frame(sender, arrivals, monkeypatch, limit, size):
    """A decoder that hangs, or is too slow for long."""
    monkeypatch.setattr(streams, limit, 100 * size)
    most = 0
    for number in range(1000):
        sender.send(packet(is_keyframe=number % 60 == 0, size=size), 11.0 + number)
    sender.send(None, 2000.0)
    while not sender.has_ended.is_set():
        most = max(most, len(arrivals._waiting))
    assert most <= 102
    found = list(iter(arrivals.next, None))
    assert [each.is_after_gap for each in found] == [True] + [False] * (len(found) - 1)
    assert found[0].fetched.packet.is_keyframe
    assert found[-1].t_mono_s == 1010.0, "the newest are kept"


def test_a_stream_is_closed_by_the_thread_that_fetches_once_its_fetch_has_returned(sender, arrivals):
    threading.Thread(target=arrivals.cancel).start()
    assert arrivals.next() is None
    arrivals.close()
    assert not sender.is_closed.is_set(), "a fetch is under way"
    sender.send(packet(), 11.0)
    assert sender.is_closed.wait(PATIENCE_S)
    assert arrivals.next() is None
