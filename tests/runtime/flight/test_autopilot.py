"""What the autopilot is sent, and that an event says what became of its fix: accepted, sent or taken."""

import numpy as np
import pytest
from fakes import FakeSource
from flights import draw_pictures, prepare_flight, select

from edgevpr.mavlink.messages import Health
from edgevpr.runtime.flight.watching import MAX_BLANK_IN_A_ROW

HELD = False, {"code": "HELD_UNCONFIRMED", "parameters": {}}


def list_fixes(lines):
    """Of each query, whether its fix was sent, and why not."""
    return [fix and (fix["sent"], fix["why"]) for fix in (line["fix"] for line in select(lines, "query"))]


def test_query_line_has_its_fix_and_the_last_answer(make_flight, clock, link):
    link.report_vehicle = lambda: None  # it has no position
    lines = make_flight().fly(FakeSource(draw_pictures(4), clock))
    assert list_fixes(lines) == [HELD, *[(True, None)] * 3]
    fix = select(lines, "query")[1]["fix"]
    assert (fix["query"], fix["lat_deg"], fix["lon_deg"]) == ("frame 000001", 50.001, 8.0)
    assert [line["result"] for line in select(lines, "answer")] == ["ACCEPTED"] * 3
    assert link.stats().fixes_sent == 3


def test_answer_line_precedes_the_next_query(make_flight, clock, link, statuses):
    link.answer = "FAILED"
    lines = make_flight().fly(FakeSource(draw_pictures(4), clock))
    assert [line["kind"] for line in lines if line["kind"] in ("query", "answer")] == ["query", "answer"] * 4
    queries, answers = select(lines, "query"), select(lines, "answer")
    assert [line["query"] for line in answers] == [line["query"] for line in queries]
    assert {(line["sent"], line["result"], line["why"]["code"]) for line in answers} == {(True, "FAILED", "GPS_IN_USE")}
    assert all(figure in statuses[-1] for figure in ("3 fixes sent", "0 accepted", "3 refused (GPS in use)"))


def test_fix_not_sent_expects_no_answer(make_flight, clock):
    lines = make_flight(**{"mavlink.send_fixes": False}).fly(FakeSource(draw_pictures(3), clock))
    assert len(select(lines, "query")) == 3
    assert not select(lines, "answer")


def test_fix_of_a_slow_match_is_reported_as_too_old(make_flight, clock, link, statuses):
    flown = make_flight()
    encode = flown.recogniser.technique.encode
    flown.recogniser.technique.encode = lambda *seen: (clock.work(6.2), encode(*seen))[1]
    link.report_vehicle = lambda: None  # it has no position
    lines = flown.fly(FakeSource(draw_pictures(4), clock))
    assert all(line["accepted"] for line in select(lines, "query")), "accepted never means sent"
    too_old = False, {"code": "FRAME_TOO_OLD", "parameters": {"age_s": 6.2, "limit_s": 5.0}}
    assert list_fixes(lines) == [HELD, *[too_old] * 3]
    assert link.stats().fixes_sent == 0
    assert "2 too late" in statuses[-1]


def test_fix_without_a_link_is_reported(recording, tmp_path, clock):
    lines = prepare_flight(recording, tmp_path, None, clock).fly(FakeSource(draw_pictures(1), clock))
    assert list_fixes(lines) == [(False, {"code": "NO_LINK", "parameters": {}})]
    assert not select(lines, "answer")


def test_refused_match_has_no_fix(make_flight, clock, link):
    assert list_fixes(make_flight().fly(FakeSource(draw_pictures(2, first=100), clock))) == [None, None]
    assert link.stats().fixes_sent == 0


def test_query_cost_is_sent_for_each_query(make_flight, clock, link):
    flown = make_flight(board="rpi-4b")
    encode = flown.recogniser.technique.encode
    flown.recogniser.technique.encode = lambda *seen: (clock.work(0.1, 2.0), encode(*seen))[1]
    flown.fly(FakeSource(draw_pictures(1, first=100), clock))
    told = {each.name: each.value for each in link.sent if each.get_type() == "NAMED_VALUE_FLOAT"}
    assert told["vpr_cpu"] == pytest.approx(0.5), "two of four cores while the query lasted"
    assert told["vpr_mah"] == pytest.approx(flown.end["used_mah"], rel=0.01)


@pytest.mark.parametrize("technique", ["cohog", "hog"])
def test_confidence_of_an_accepted_match_is_sent_if_known(make_flight, clock, link, technique):
    lines = make_flight(technique).fly(FakeSource(draw_pictures(2) + draw_pictures(1, first=100), clock))
    queries = select(lines, "query")
    assert [line["accepted"] for line in queries] == [True, True, False]
    told = [each.value for each in link.sent if getattr(each, "name", "") == "vpr_conf"]
    known = [
        max(line["confidence"], line.get("track", line)["confidence"])
        for line in queries
        if line["accepted"] and "confidence" in line
    ]
    assert told == pytest.approx(known)
    assert all(0.9 <= each <= 1 for each in told)


@pytest.mark.slow
def test_camera_lost_is_announced_and_critical_until_it_is_back(make_flight, clock, link):
    health = []
    source = FakeSource(draw_pictures(5), clock, work=lambda: (health.append(link.health.name), turn())[0])

    def turn():
        source.is_lost = len(health) in (2, 3)

    lines = make_flight().fly(source)
    assert health == ["ACTIVE", "ACTIVE", "CRITICAL", "CRITICAL", "ACTIVE"]
    assert [severity for severity, text in link.texts() if "camera" in text] == [4, 6]
    assert [line["condition"] for line in select(lines, "source")] == ["LOST", "RUNNING"]


def test_failing_observer_does_not_end_the_flight(make_flight, clock, link, caplog):
    link.send_fix = lambda fix: 1 / 0
    assert len(select(make_flight().fly(FakeSource(draw_pictures(2), clock)), "query")) == 2
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [ZeroDivisionError] * 2


def test_blank_images_are_reported_once_after_ten_and_so_is_the_ground_again(make_flight, clock, link):
    health, seen = [], draw_pictures(19)
    seen[1:16] = [np.zeros((240, 320), np.uint8)] * 15
    lines = make_flight().fly(FakeSource(seen, clock, work=lambda: health.append(link.health)))
    queries = select(lines, "query")
    assert [line["accepted"] for line in queries] == [True, *[False] * 15, *[True] * 3]
    assert all(line["reason"]["code"] == "LOW_TEXTURE" for line in queries[1:16])
    assert queries[1]["fix"] is queries[1]["place"] is None
    assert [severity for severity, _ in link.texts()] == [4, 6]
    assert [line["note"]["code"] for line in select(lines, "camera")] == ["IMAGE_BLANK", "GROUND_VISIBLE"]
    assert [health[number] for number in (MAX_BLANK_IN_A_ROW, 15, -1)] == [
        Health.ACTIVE,
        Health.CRITICAL,
        Health.ACTIVE,
    ]
