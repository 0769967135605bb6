"""Texts for the ground: one in five seconds, of each topic the newest, warnings first, and none of them lost."""

from contextlib import closing

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, UdpPort, link_to, wait_until

from edgevpr.mavlink.ground import SPACING_S, Texts
from edgevpr.mavlink.messages import Severity

WARNING, INFO = Severity.WARNING, Severity.INFO


@pytest.fixture
def texts():
    """Texts of which one has just been sent, at second 0."""
    texts = Texts()
    texts.put(INFO, "first")
    assert texts.next(0.0).text == "edgevpr: first"
    return texts


def told(texts: Texts, from_s: float = 0.0) -> list[tuple[int, str]]:
    """All that is told from a moment on, asked ten times a second."""
    said = []
    for tenth in range(round(from_s * 10), 10 * 200):
        if message := texts.next(tenth / 10):
            said.append((tenth / 10, message.text.removeprefix("edgevpr: ")))
    return said


def test_one_text_in_five_seconds_is_sent(texts):
    for name in "abc":
        texts.put(INFO, name)
    assert told(texts) == [(5.0, "a"), (10.0, "b"), (15.0, "c")]
    texts.put(INFO, "late")
    assert texts.next(500.0).text == "edgevpr: late", "after a silence at once"


def test_the_newest_text_of_a_topic_takes_the_place_of_one_that_waits(texts):
    texts.put(WARNING, "camera lost", "camera")
    texts.put(WARNING, "map left", "map")
    texts.put(WARNING, "camera frozen", "camera")
    assert [text for _, text in told(texts)] == ["camera frozen", "map left"]
    texts.put(INFO, "map found again", "map")
    texts.put(WARNING, "map left", "map")
    assert told(texts, 100.0) == [], "what comes and goes again before its turn is no change"


def test_a_new_warning_ends_the_note_that_all_is_well(texts):
    texts.put(WARNING, "camera lost", "camera")
    texts.put(INFO, "camera is back", "camera")
    texts.put(WARNING, "camera frozen", "camera")
    assert [text for _, text in told(texts)] == ["camera frozen"]
    texts.put(WARNING, "camera lost", "camera")
    texts.put(INFO, "camera is back", "camera")
    assert [text for _, text in told(texts, 100.0)] == ["camera lost", "camera is back"], "a note hides no warning"


@pytest.mark.network
def test_over_a_link_the_turns_are_kept_and_at_its_end_nothing_is_left_behind():
    clock = FakeClock()
    with (
        closing(UdpPort()) as port,
        link_to(f"udpout:127.0.0.1:{port.number}", clock=clock) as link,
    ):
        peer = Peer(port)
        peer.expect("HEARTBEAT")
        for name in ("one", "two", "three"):
            link.announce(WARNING, name)
        peer.expect_text("edgevpr: one")
        clock.now_s += SPACING_S - 0.1
        wait_until(lambda: link.stats().sent["HEARTBEAT"] == 2)
        assert link.stats().sent["STATUSTEXT"] == 1
        clock.now_s += 0.1
        peer.expect_text("edgevpr: two")
        link.close()
        peer.expect_text("edgevpr: three")
