"""A fix that contradicts the autopilot's own position is held back until a second, independent one says the same."""

from dataclasses import replace

import numpy as np
import pytest
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import STEP_DEG, Flight, of_kind
from mavlink_peers import Peer, UdpPort, wait_until
from pictures import textured

from edgevpr.contract import FineMatch
from edgevpr.geodesy import moved
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight import autopilot
from edgevpr.runtime.flight.autopilot import DRY_RUN
from edgevpr.runtime.flight.consistency import Consistency
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.types import Candidate, Frame, Place, Position, QueryCost, Steps

NO_COST = QueryCost(
    t_encode_s=0, t_match_s=0, u_encode=0, u_match=0, cpu_s=0, rss_mb=0, used_mah=0, marginal_mah=0
)  # fmt: skip
HOME = 50.0, 8.0


def seen(
    off_m, t_s=0.0, *, places=(1,), flown_m=(0.0, 0.0), sd_m=20.0, fix_sd_m=8.0, accuracy_m=8.0, heard_ago_s=0.0, **said
):
    """An accepted match at `t_s` that lies `off_m` (east, north) off the autopilot's position, which is `flown_m` from
    home; `said` is what else it says of its vehicle."""
    here = moved(*HOME, *flown_m)
    position = Position(*moved(*here, *off_m))
    said = {"has_gps": False, "position_sd_m": sd_m, "velocity_m_s": (0.0, 15.0)} | said
    frame = Frame(image=np.zeros((8, 8), np.uint8), name="f", t_mono_s=1000.0 + t_s)
    place = Place(place_id=places[0] if places else 1, source_image="", position=position)
    return Recognition(
        frame=frame,
        vehicle=vehicle_at(*here, frame.t_mono_s - heard_ago_s, **said),
        best=Candidate(place, FineMatch(0.5)),
        accepted=True,
        reason="",
        located=Located(position=position, covariance_m2=(fix_sd_m**2, 0.0, fix_sd_m**2), places=places),
        accuracy_m=accuracy_m,
        steps=Steps(),
        cost=NO_COST,
    )


def held(*events):
    """Which of the fixes are held back, in turn."""
    consistency = Consistency()
    return [consistency.objection(event) is not None for event in events]


def test_a_fix_within_what_both_allow_is_sent():
    assert held(seen((60, 50)), seen((-80, 0), 1.0), seen((0, 0), 2.0)) == [False] * 3


def test_one_that_contradicts_is_held_back_and_says_by_how_much():
    said = Consistency().objection(seen((300, -400)))
    assert said.startswith("held back: 500 m from where the autopilot is by its own reckoning, which is good to 20 m")


@pytest.mark.parametrize("more", [{"sd_m": 150.0}, {"fix_sd_m": 150.0}, {"accuracy_m": 150.0}])
def test_what_either_does_not_know_gives_room(more):
    assert held(seen((500, 0))) == [True]
    assert held(seen((500, 0), **more)) == [False]


@pytest.mark.parametrize(("velocity_m_s", "is_held"), [((0.0, 0.0), True), ((0.0, 25.0), False), (None, False)])
def test_what_was_flown_since_the_report_gives_room(velocity_m_s, is_held):
    assert held(seen((100, 0), heard_ago_s=0.9, velocity_m_s=velocity_m_s)) == [is_held]


def test_an_inexact_fix_has_room_only_where_it_is_inexact():
    along = replace(seen((500, 0)).located, covariance_m2=(200.0**2, 0.0, 8.0**2))
    east, north = seen((500, 0)), seen((0, 500))
    assert held(replace(east, located=along, accuracy_m=200.0)) == [False]
    assert held(replace(north, located=replace(along, position=north.position), accuracy_m=200.0)) == [True]


@pytest.mark.parametrize(
    "unknown", [{"sd_m": None}, {"has_gps": True}, {"heard_ago_s": 1.5}], ids=["certainty", "GPS", "stale"]
)
def test_where_the_autopilot_s_position_says_nothing_no_fix_is_held_back(unknown):
    assert held(seen((500, 0), **unknown)) == [False]
    consistency = Consistency()
    consistency.objection(seen((500, 0)))
    consistency.objection(seen((500, 0), 1.0, places=(2,), **unknown))
    assert consistency.objection(seen((500, 0), 2.0, places=(3,))), "and what was held before is forgotten"


def test_without_a_vehicle_no_fix_is_held_back():
    assert held(replace(seen((500, 0)), vehicle=None)) == [False]


def test_a_second_one_of_another_place_that_says_the_same_is_sent_and_so_are_those_after_it():
    events = [seen((500, 5 * t_s), t_s, places=(t_s,), flown_m=(0, 15 * t_s)) for t_s in range(6)]
    assert held(*events) == [True] + [False] * 5


def test_a_second_one_that_says_something_else_is_held_back_too():
    assert held(seen((500, 0)), seen((-500, 0), 1.0, places=(2,)), seen((500, 200), 2.0, places=(3,))) == [True] * 3


def test_the_same_place_again_is_no_second_one_until_the_aircraft_has_moved_on():
    hovering = [seen((500, 0), t_s) for t_s in range(4)]
    assert held(*hovering) == [True] * 4
    assert held(*hovering, seen((500, 0), 5.0, flown_m=(0, 150))) == [True] * 4 + [False]
    stuck = [seen((500, -15 * t_s), t_s, flown_m=(0, 15 * t_s)) for t_s in range(0, 12)]
    assert held(*stuck) == [True] * 12, "a fix that stays where it was says nothing new"


def test_an_aircraft_that_creeps_on_has_moved_on_in_the_end():
    creeping = [seen((500, 0), t_s, flown_m=(0, 12 * t_s)) for t_s in range(12)]
    assert held(*creeping) == [True] * 7 + [False] * 5


def test_places_that_are_partly_the_same_are_not_independent():
    assert held(seen((500, 0), places=(1, 2)), seen((500, 0), 1.0, places=(2, 3))) == [True, True]
    assert held(seen((500, 0), places=(1, 2)), seen((500, 0), 1.0, places=(3, 4))) == [True, False]
    assert held(seen((500, 0), places=()), seen((500, 0), 1.0, places=())) == [True, True], "by the best place"


def test_a_single_wrong_one_among_right_ones_is_all_that_is_held_back():
    events = [seen((0, 0), t_s, places=(t_s,)) for t_s in range(6)]
    events[3] = seen((500, 0), 3.0, places=(90,))
    assert held(*events) == [False, False, False, True, False, False]


def test_a_wrong_one_among_those_that_agree_against_the_autopilot_is_held_back():
    events = [seen((500, 0), t_s, places=(t_s,)) for t_s in range(6)]
    events[3] = seen((-700, 0), 3.0, places=(90,))
    assert held(*events) == [True, False, False, True, False, False]


def test_two_that_agree_across_one_that_agrees_with_the_autopilot_do_not_count():
    assert held(seen((500, 0)), seen((0, 0), 1.0, places=(2,)), seen((500, 0), 2.0, places=(3,))) == [True, False, True]


def test_when_the_autopilot_has_taken_the_fix_the_old_offset_is_a_contradiction_again():
    events = [seen((500, 0)), seen((500, 0), 1.0, places=(2,)), seen((3, 0), 2.0, places=(3,))]
    assert held(*events, seen((500, 0), 3.0, places=(4,))) == [True, False, False, True]


def test_the_autopilot_s_reckoning_may_drift_between_two_that_agree():
    assert held(seen((500, 0)), seen((530, 0), 10.0, places=(2,))) == [True, False]
    assert held(seen((500, 0)), seen((530, 0), 1.0, places=(2,))) == [True, True]


def test_those_that_agree_are_sent_for_as_long_as_they_come():
    drifting = [seen((500 + 2 * t_s, 0), t_s, places=(t_s,)) for t_s in range(0, 120, 8)]
    assert held(*drifting) == [True] + [False] * 14


def test_what_agreed_long_ago_is_forgotten():
    assert held(seen((500, 0)), seen((500, 0), 31.0, places=(2,))) == [True, True]
    agreed = seen((500, 0)), seen((500, 0), 1.0, places=(2,))
    assert held(*agreed, seen((500, 0), 30.0, places=(3,))) == [True, False, False]
    assert held(*agreed, seen((500, 0), 32.0, places=(3,))) == [True, False, True]


def fly(recording, tmp_path, pictures, off_deg=0.05, has_gps=False, **settings):
    """A flight past the places, one a second, with an autopilot that is `off_deg` of longitude off; its lines, link."""
    clock = FakeClock()

    def vehicle():
        north = 50 + STEP_DEG * (clock.now_s - 1000.0)
        return vehicle_at(north, 8.0 + off_deg, clock.now_s, has_gps=has_gps, position_sd_m=20.0)

    link = FakeLink(clock, vehicle=vehicle)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0} | settings)
    lines = flight.fly(FakeSource([textured(number, 240, 320) for number in pictures], clock))
    return of_kind(lines, "query"), link


def test_in_flight_a_fix_held_back_is_in_the_log_and_the_ground_is_told_once(recording, tmp_path):
    queries, link = fly(recording, tmp_path, (0, 20, 2, 3, 4))
    assert all(line["accepted"] for line in queries), "held back or not, the match stays accepted"
    assert [line["fix"]["sent"] for line in queries] == [False, False, False, True, True]
    assert queries[0]["fix"]["why"].startswith("held back: 3574 m from where the autopilot is")
    assert link.stats().fixes_sent == 2
    assert link.texts() == [
        (4, "edgevpr: fix held back, contradicts autopilot"),
        (6, "edgevpr: fixes agree again"),
    ]
    assert sum(each.name == "vpr_place" for each in link.sent if each.get_type() == "NAMED_VALUE_INT") == 5


def test_over_a_real_link_it_is_what_the_autopilot_says_of_itself_that_counts(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(autopilot, "_SETTLED_WITHIN_S", 60.0)
    clock, port = FakeClock(), UdpPort()
    with Link(parse_link(f"udpout:127.0.0.1:{port.number}"), clock=clock) as link:
        peer = Peer(port)
        peer.expect("HEARTBEAT")
        peer.heartbeat()
        wait_until(link.listens)
        turns = iter(range(4))

        def turn():
            """GPS at the first frame only; a filter that reckons from then on, and at the last frame has given up."""
            turn = next(turns)
            where = round((50 + turn * STEP_DEG) * 1e7), round(8.05 * 1e7)
            flags = mavlink.EKF_CONST_POS_MODE if turn == 3 else mavlink.EKF_POS_HORIZ_REL
            peer.heartbeat()
            peer.send(mavlink.MAVLink_gps_raw_int_message(0, 1 if turn else 3, *where, 0, 80, 120, 0, 0, 14))
            peer.send(mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.1))
            peer.send(mavlink.MAVLink_global_position_int_message(0, *where, 0, 80_000, 1500, 0, 0, 0))
            wait_until(lambda: link.vehicle() and link.vehicle().t_heard_s == clock.now_s)

        flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
        pictures = [textured(number, 240, 320) for number in (0, 1, 20, 3)]
        queries = of_kind(flight.fly(FakeSource(pictures, clock, work=turn)), "query")
        assert peer.expect_text("edgevpr: fix held back, contradicts autopilot")
    port.close()
    assert [line["fix"]["sent"] for line in queries] == [True, False, False, True]
    assert "good to 6 m" in queries[1]["fix"]["why"], "5 m by GPS, and a second of drift"


def test_in_flight_with_gps_nothing_is_held_back(recording, tmp_path):
    queries, link = fly(recording, tmp_path, (0, 1), has_gps=True)
    assert [line["fix"]["sent"] for line in queries] == [True, True]
    assert link.texts() == []


def test_a_dry_run_says_which_fixes_would_be_held_back(recording, tmp_path):
    queries, link = fly(recording, tmp_path, (0, 1), **{"mavlink.send_fixes": False})
    assert queries[0]["fix"]["why"].startswith("held back")
    assert queries[1]["fix"]["why"] == DRY_RUN
    assert link.stats().fixes_sent == 0
