"""The status that a whole flight tells, by a clock that is turned by hand."""

import pytest
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import Flight

from edgevpr.frames.images import read_image

pytestmark = pytest.mark.slow


class Kept:
    def __init__(self):
        self.statuses = []

    def tell(self, status):
        self.statuses.append(status)


@pytest.mark.parametrize("has_link", [False, True])
def test_the_status_counts_what_the_flight_does_and_names_its_match(recording, tmp_path, has_link):
    clock, kept = FakeClock(), Kept()
    still = {"velocity_m_s": (0.0, 0.0), "position_sd_m": 3.0}
    link = FakeLink(clock, vehicle=lambda: vehicle_at(50.0, 8.0, clock.now_s, **still)) if has_link else None
    seen = sorted((recording / "seen" / "images").iterdir())[:20]
    source = FakeSource([*map(read_image, seen)], clock, work=lambda: clock.work(0.1, cores=0.5))
    Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 2.0}).fly(source, status=kept)
    first, last = kept.statuses[0], kept.statuses[-1]
    assert first["queries"] == 0
    assert not any(first[name] for name in ("newest", "match"))
    assert last["accepted"] == last["queries"] > 15
    assert last["asked_rate_hz"] == 2.0
    assert last["match"] == last["newest"]
    assert last["match"]["query"] == f"frame {last['queries'] - 1:06d}"
    assert last["match"]["place"] == last["queries"]
    assert 0 < last["t_mono_s"] - last["match"]["t_frame_s"] < 1.5
    assert 0.9 < last["match"]["confidence"] <= 1.0
    assert last["used_mah"] > first["used_mah"]
    assert last["source"] == "streaming"
    assert last["summary"].startswith(f"streaming; {last['queries']} queries, {last['accepted']} accepted, ")
    if has_link:
        assert last["link"]["accuracy_m"] >= 5.0
        assert last["link"]["fixes"] in last["summary"]
    else:
        assert last["link"] is None
