"""Packets of a stream that wait for decoding."""

import queue
import threading
from types import SimpleNamespace

import pytest
from fakes import FakeClock
from loopback import PATIENCE_S

from edgevpr.frames import streams
from edgevpr.frames.decoding import TimedPacket


class Sender:
    """Sends what the test gives it; None is the end. Nothing of it may be used after `close`."""

    def __init__(self, clock):
        self._clock, self._sent = clock, queue.Queue()
        self.has_ended, self.is_closed = threading.Event(), threading.Event()

    def send(self, t_mono_s, is_keyframe=False, size=1000):
        self._sent.put((TimedPacket(SimpleNamespace(is_keyframe=is_keyframe, size=size)), t_mono_s))

    def end(self, error=None):
        self._sent.put((error, 1.0))

    def fetch(self):
        packet, self._clock.now_s = self._sent.get()
        if packet is None:
            self.has_ended.set()
        if isinstance(packet, Exception):
            raise packet
        return packet


@pytest.fixture
def sender():
    return Sender(FakeClock(10.0))


@pytest.fixture
def arrivals(sender):
    found = streams.PacketQueue(sender.fetch, sender._clock, sender.is_closed.set)
    yield found
    sender.end()
    found.close()
    assert sender.is_closed.wait(PATIENCE_S)


def test_arrivals_keep_times_and_order_and_report_a_waiting_key_frame(sender, arrivals):
    for number in range(3):
        sender.send(11.0 + number, is_keyframe=number == 1)
    sender.end()
    sender.has_ended.wait(PATIENCE_S)
    first = arrivals.next()
    assert arrivals.has_key_frame()
    rest = list(iter(arrivals.next, None))
    assert not arrivals.has_key_frame()
    assert [(each.request_s, each.arrival_s) for each in (first, *rest)] == [(10.0, 11.0), (11.0, 12.0), (12.0, 13.0)]
    assert arrivals.next() is None, "the stream is still lost"


def test_arrivals_treat_a_failed_fetch_as_a_lost_stream(sender, arrivals, monkeypatch):
    failures = []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    sender.end(MemoryError())
    assert arrivals.next() is None
    arrivals.close()
    assert [failure.exc_type for failure in failures] == [MemoryError]


@pytest.mark.parametrize(("limit", "size"), [("_MAX_QUEUED_BYTES", 100_000), ("_MAX_QUEUED_PACKETS", 1)])
def test_arrivals_are_limited_and_continue_at_a_key_frame(sender, arrivals, monkeypatch, limit, size):
    """A decoder that hangs, or is too slow for long."""
    monkeypatch.setattr(streams, limit, 100 * size)
    most = 0
    for number in range(1000):
        sender.send(11.0 + number, is_keyframe=number % 60 == 0, size=size)
    sender.end()
    while not sender.has_ended.is_set():
        most = max(most, len(arrivals._queued))
    assert most <= 102
    found = list(iter(arrivals.next, None))
    assert [each.is_after_gap for each in found] == [True] + [False] * (len(found) - 1)
    assert found[0].packet.is_keyframe
    assert found[-1].arrival_s == 1010.0, "the newest are kept"


def test_arrivals_close_the_stream_on_the_fetching_thread_after_its_fetch(sender, arrivals):
    threading.Thread(target=arrivals.cancel).start()
    assert arrivals.next() is None
    arrivals.close()
    assert not sender.is_closed.is_set(), "a fetch is under way"
    sender.send(11.0)
    assert sender.is_closed.wait(PATIENCE_S)
    assert arrivals.next() is None
