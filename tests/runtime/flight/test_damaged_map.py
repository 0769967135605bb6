"""A map that is damaged in flight: every BLOB and every column of it, one after another, and the flight goes on.

What is damaged may be compared or not; what must not be is an end of the flight, and a position that the map does not
have.
"""

import contextlib
import sqlite3
from functools import partial

import pytest
from fakes import FakeSource, format_note
from flights import PLACES, STEP_DEG, Flight, draw_pictures, fly_acts, noop, select
from map_writer import write_sql

from edgevpr.core.reasons import ReasonCode
from edgevpr.mavlink.messages import Health
from edgevpr.runtime.flight.watching import MAX_FAILURES_IN_A_ROW

DAMAGE = (None, b"", b"\xff", b"\x00" * 7, "text", 10**18, -1.5, float("inf"), b"\xa5" * 40_000)
COLUMNS = ("geom", "time", "alt_m", "heading_deg", "source_image", "quality", "coarse", "fine")


def is_mapped(line):
    """Whether a line's position is that of its place, as the map has it."""
    position = line["position"]
    return position is None or round((position["lat_deg"] - 50) / STEP_DEG) + 1 == line["place"]


@pytest.mark.slow
@pytest.mark.parametrize("place", [1, 2, 3, 7, PLACES])
def test_damaged_fine_part_costs_one_query_and_then_only_queries_that_may_show_it(place_map, tmp_path, place):
    damage = partial(write_sql, place_map, f"UPDATE places SET fine = x'00' WHERE place_id = {place}")
    queries, lines, flight = fly_acts(place_map, tmp_path / "log", [noop, damage, *[noop] * 10])
    assert len(queries) == 12
    assert queries[0]["accepted"]
    assert (queries[1]["accepted"], queries[1]["fix"]) == (False, None)
    assert queries[1]["reason"]["code"] == "PLACE_UNREADABLE"
    for shown, line in enumerate(queries[2:], start=3):
        if line["accepted"]:
            assert line["place"] == shown
            assert is_mapped(line)
        else:
            assert place == shown or line["reason"]["code"] == "PLACE_UNREAD"
    assert sum(line["accepted"] for line in queries[2:]) >= 4, "the flight goes on with the rest"
    assert flight.end["unusable"] == 1
    assert [(line["place"], "fine part" in line["problem"]) for line in select(lines, "left out")] == [(place, True)]
    assert [(severity, " 1 place " in text) for severity, text in flight.link.texts()] == [(4, True)]
    assert flight.end["left_out"] == queries[-1]["totals"]["left_out"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("column", COLUMNS)
def test_damaged_columns_never_end_the_flight_or_send_a_position_outside_the_map(place_map, tmp_path, column):
    """Each kind of damage at every place at once, so that candidates and the best place have it."""

    def damage(value):
        """Write as another program that minds no rule of the map; the schema refuses some of it, which is as well."""
        with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(place_map)) as db, db:
            for kind in ("geom", "time"):
                db.create_function(f"ST_{kind}", 1, lambda each: each)
            db.execute("PRAGMA ignore_check_constraints = ON")
            db.execute(f"UPDATE places SET {column} = ?", (value,))

    queries, _, flight = fly_acts(place_map, tmp_path / "log", [partial(damage, value) for value in DAMAGE])
    assert len(queries) == len(DAMAGE)
    assert flight.end["queries"] == len(DAMAGE)
    assert flight.link.stats().fixes_sent == sum(line["accepted"] and bool(line["fix"]["sent"]) for line in queries)
    for line in queries:
        if line["fix"] and line["fix"]["sent"]:
            assert is_mapped(line)


def test_failures_are_critical_and_reported_once_after_ten_until_recovery(place_map, tmp_path, clock, link, caplog):
    health, whole = [], place_map.read_bytes()

    damage = partial(write_sql, place_map, "UPDATE places SET fine = x'00'")

    def record_health():
        health.append(link.health)

    flight = Flight(place_map, tmp_path / "log", clock, link, **{"source.rate_hz": 1.0})
    looks = [record_health] * MAX_FAILURES_IN_A_ROW
    calls = iter([noop, damage, *looks, partial(place_map.write_bytes, whole), *looks[:3]])
    count = MAX_FAILURES_IN_A_ROW + 6
    lines = flight.fly(FakeSource(draw_pictures(count), clock, work=lambda: next(calls)()))
    queries = select(lines, "query")
    assert [line["accepted"] for line in queries] == [True, *[False] * (MAX_FAILURES_IN_A_ROW + 1), *[True] * 4]
    assert health[-4] is Health.CRITICAL
    assert health[0] is health[-1] is Health.ACTIVE
    assert [line["note"]["code"] for line in select(lines, "failing")] == ["FRAMES_FAILING", "FRAMES_RECOVERED"]
    assert link.texts() == [
        (4, format_note(ReasonCode.MAP_LOST)),
        (4, format_note(ReasonCode.FRAMES_FAILING, frames=MAX_FAILURES_IN_A_ROW)),
        (6, format_note(ReasonCode.MAP_BACK)),
        (6, format_note(ReasonCode.FRAMES_RECOVERED)),
    ]
    assert flight.end["unusable"] == MAX_FAILURES_IN_A_ROW + 1
    assert flight.end["left_out"] == 0, "where all are damaged the file is at fault, and may come back"
    told = [record.message for record in caplog.records if "is damaged" in record.message]
    assert len(told) == 1, "the same trouble is said once"
