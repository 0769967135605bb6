"""The status that a whole flight tells, by a clock that is turned by hand."""

import pytest
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import Flight

from edgevpr.frames.images import read_image
from edgevpr.mavlink.requests import Wish

pytestmark = pytest.mark.slow


class Kept:
    def __init__(self):
        self.statuses = []

    def tell(self, status):
        self.statuses.append(status)


@pytest.fixture
def told(recording, tmp_path):
    """Fly over the map's own pictures, with `pictures` after them, and give what was told."""

    def flown(count=20, pictures=(), link=None, act=None, **settings):
        clock, kept = FakeClock(), Kept()
        link = link and link(clock)
        if act:
            clock.at(8.0, lambda: act(link))
        seen = sorted((recording / "seen" / "images").iterdir())[:count]
        source = FakeSource([*map(read_image, seen), *pictures], clock, work=lambda: clock.work(0.1, cores=0.5))
        settings = {"source.rate_hz": 2.0} | settings
        Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **settings).fly(source, status=kept)
        return kept.statuses

    return flown


def test_the_status_counts_what_the_flight_does_and_names_its_match(told):
    statuses = told()
    first, last = statuses[0], statuses[-1]
    assert (first.queries, first.newest, first.match, first.rate_hz, first.cpu_cores) == (0, None, None, None, None)
    assert last.accepted == last.queries > 15
    assert last.rate_hz == pytest.approx(2.0, abs=0.2)
    assert last.asked_rate_hz == 2.0
    assert last.cpu_cores == pytest.approx(0.1, abs=0.03)
    assert last.match == last.newest
    assert last.match.query == f"frame {last.queries - 1:06d}"
    assert last.match.place == last.queries
    assert 0 < last.match.age_s < 1.5
    assert last.match.lat_deg == pytest.approx(50.0, abs=1.0)
    assert 0.9 < last.match.confidence <= 1.0
    assert last.used_mah > first.used_mah
    assert last.source == "streaming"
    assert last.link is None
    assert last.summary.startswith(f"streaming; {last.queries} queries, {last.accepted} accepted, ")


def test_the_navigation_says_how_well_it_knows_the_position(told):
    def with_velocity(clock):
        def vehicle():
            return vehicle_at(50.0, 8.0, clock.now_s, velocity_m_s=(0.0, 0.0), position_sd_m=3.0)

        return FakeLink(clock, vehicle=vehicle)

    accuracies = [status.link.accuracy_m for status in told(link=with_velocity)]
    assert any(each is not None and each >= 5.0 for each in accuracies)


def test_a_flight_that_is_paused_says_so(told):
    last = told(30, link=FakeLink, act=lambda link: link.wish(Wish.PAUSE) and None, **{"source.rate_hz": 2.0})[-1]
    assert last.paused
    assert "paused" in last.remarks
    assert last.health == "STANDBY"
