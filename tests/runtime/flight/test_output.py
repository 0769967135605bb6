"""The watch over our own positions: withdrawn where they cannot be right, back with proof."""

from dataclasses import replace

import pytest
from fakes import receiver_at, vehicle_at

from edgevpr.core.geodesy import moved
from edgevpr.mavlink.messages import TEXT_BYTES
from edgevpr.runtime.flight.output import Output, OutputWatch

HOME = 50.0, 8.0
LONG_AGO_S = -100.0


class Watched:
    """Reports ten times a second; positions are sent all the time."""

    def __init__(self):
        self.watch, self.now_s = OutputWatch(), 0.0

    def report(self, seconds, *, off_m=0.0, ratio=0.1, has_gps=True, fixed_s=LONG_AGO_S, sends=True):
        for _ in range(round(10 * seconds)):
            self.now_s += 0.1
            if sends:
                self.watch.note_sent(self.now_s)
            gps = receiver_at(HOME, 1.0, self.now_s, steady_for_s=60.0) if has_gps else None
            vehicle = vehicle_at(*moved(*HOME, off_m, 0.0), self.now_s, has_gps=has_gps, gps=gps)
            self.watch.update(replace(vehicle, innovation_ratio=ratio), fixed_s, has_gps)
        return self.watch.withdrawn


def test_positions_are_withdrawn_when_the_estimate_leaves_a_good_receiver():
    watched = Watched()
    assert watched.report(10, off_m=14.0) is None
    assert watched.report(3, off_m=30.0) is Output.LEADS_AWAY
    assert watched.report(20, off_m=0.0, sends=False) is None, "it follows its receiver again"


def test_estimate_that_leaves_a_receiver_is_no_matter_without_positions_of_ours_or_with_a_match():
    assert Watched().report(20, off_m=30.0, sends=False) is None
    watched = Watched()
    for _ in range(20):
        assert watched.report(1, off_m=30.0, fixed_s=watched.now_s) is None


def test_positions_are_withdrawn_when_the_autopilot_refuses_them_until_a_match_proves_them():
    watched = Watched()
    assert watched.report(2, ratio=1.5, has_gps=False) is None, "a glitch"
    assert watched.report(1, ratio=0.5, has_gps=False) is None
    assert watched.report(4, ratio=1.5, has_gps=False) is Output.REFUSED
    assert watched.report(30, ratio=0.1, has_gps=False, sends=False) is Output.REFUSED, "silence proves nothing"
    assert watched.report(1, ratio=0.1, has_gps=False, fixed_s=watched.now_s + 0.5) is None


@pytest.mark.parametrize("output", Output)
def test_text_of_an_output_fits_a_status_text(output):
    assert len(f"edgevpr: {output.text}") <= TEXT_BYTES
