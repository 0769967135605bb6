"""Packets are taken as they come, however long nobody asks for them."""

import queue
import threading
from types import SimpleNamespace

import pytest
from fakes import FakeClock

from edgevpr.frames.streams import Arrivals


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
    assert [each.fetched for each in found] == packets
    assert [(each.asked_s, each.t_mono_s) for each in found] == [(10.0, 11.0), (11.0, 12.0), (12.0, 13.0)]
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
