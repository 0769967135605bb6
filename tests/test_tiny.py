"""The whole walk in under a second: pictures become a map, a frame is recognised, a fix is sent. The first gate."""

from fakes import FakeClock, FakeSource
from flights import Flight, connect_autopilot
from pictures import draw_texture
from walks import make_map

from edgevpr.core.types import Frame, Position
from edgevpr.techniques import create


def test_flight_sends_a_fix_for_a_recognised_image(tmp_path):
    positions = [Position(50 + n / 1000, 8.0) for n in range(5)]
    frames = [Frame(image=draw_texture(n), name=f"{n}", t_mono_s=0.0, position=positions[n]) for n in range(5)]
    place_map, clock = make_map(tmp_path / "m.gpkg", create("cohog", {"w1": 208}), frames), FakeClock(1003.0)
    link = connect_autopilot(clock)
    flight = Flight(place_map, tmp_path / "log", clock, link)
    known, answer, unknown = flight.fly(FakeSource([draw_texture(3), draw_texture(9)], clock))
    assert link.stats().fixes_sent == 1
    assert [flight.end[each] for each in ("queries", "accepted", "unusable")] == [2, 1, 0]
    assert (known["place"], known["accepted"], known["fix"]["sent"]) == (4, True, True)
    assert (answer["kind"], answer["query"], answer["result"]) == ("answer", known["query"], "ACCEPTED")
    assert (unknown["accepted"], unknown["fix"]) == (False, None)
