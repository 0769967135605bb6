"""A camera that shows nothing for a while: silence, and it is said once."""

import numpy as np
from fakes import FakeClock, FakeLink, FakeSource
from flights import Flight, of_kind
from pictures import textured

from edgevpr.mavlink.messages import Health
from edgevpr.runtime.flight.watching import NOTHING_IN_A_ROW

GROUND, NOTHING = textured(1, 240, 320), np.zeros((240, 320), np.uint8)


def flown(recording, tmp_path, pictures):
    """(lines of the log, announcements, health after each picture) of a flight with a picture a second."""
    clock, health = FakeClock(), []
    link = FakeLink(clock)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
    source = FakeSource(pictures, clock, work=lambda: health.append(link.health))
    return flight.fly(source), link.texts(), health


def test_ten_pictures_of_nothing_are_said_once_and_so_is_the_ground_after_them(recording, tmp_path, caplog):
    lines, texts, health = flown(recording, tmp_path, [GROUND, *[NOTHING] * 15, *[GROUND] * 3])
    queries = of_kind(lines, "query")
    assert [line["accepted"] for line in queries] == [True, *[False] * 15, *[True] * 3]
    assert all(line["reason"]["code"] == "LOW_TEXTURE" for line in queries[1:16])
    assert queries[1]["fix"] is queries[1]["place"] is None
    assert texts == [(4, "edgevpr: camera shows nothing"), (6, "edgevpr: camera shows ground again")]
    assert [line["note"]["code"] for line in of_kind(lines, "camera")] == ["NOTHING_SHOWN", "GROUND_SHOWN"]
    assert health[NOTHING_IN_A_ROW] is Health.ACTIVE
    assert health[15] is Health.CRITICAL
    assert health[-1] is Health.ACTIVE
    assert len([record for record in caplog.records if "shows nothing" in record.message]) == 1
