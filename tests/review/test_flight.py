"""A flight as its log tells it."""

import json

from logs import query, write_log

from edgevpr.core.appending import list_numbered
from edgevpr.core.reasons import ReasonCode
from edgevpr.review.logged import FixOutcome, read_flight
from edgevpr.runtime.flight.flightlog import FlightLog


def test_read_flight_assigns_a_later_answer_to_its_fix(tmp_path):
    lines = [("query", query(name)) for name in ("a", "b", "c", "d")]
    refused, superseded = ({"code": code, "parameters": {}} for code in ("WRONG_FORM", "SUPERSEDED"))
    answers = [
        ("answer", {"query": query, "sent": result is not None, "result": result, "why": why, "latency_ms": 3.0})
        for query, result, why in (("a", "ACCEPTED", None), ("b", "DENIED", refused), ("c", None, superseded))
    ]
    flight = read_flight(write_log(tmp_path / "log", *lines, *answers))
    names = ["ACCEPTED", "REFUSED", "NOT_SENT", "UNANSWERED"]
    assert [each.fix.outcome for each in flight.queries] == [FixOutcome[name] for name in names]
    assert flight.queries[1].fix.why.code is ReasonCode.WRONG_FORM


def test_read_flight_remarks_on_a_missing_file(tmp_path):
    path = tmp_path / "flight.jsonl"
    with FlightLog(path, max_mb=0.02) as log:
        log.write("start", map="m.gpkg", t_mono_s=1000.0)
        for second in range(1, 5):
            log.write("query", **query(str(second), note="x" * 3000), t_mono_s=1000.0 + second)
    list_numbered(path)[0].unlink()
    flight = read_flight(path)
    assert (flight.start["map"], flight.start["repeated"]) == ("m.gpkg", True)
    assert flight.remarks[0][:2] == (0.0, "missing")
    assert 0 < len(flight.queries) < 4


def test_read_flight_accepts_a_log_without_its_first_line(tmp_path):
    log = tmp_path / "log"
    log.write_text(json.dumps({"kind": "query", "t_mono_s": 5.0} | query("a")) + "\n")
    flight = read_flight(log)
    assert (flight.start, len(flight.queries)) == ({}, 1)


def test_read_flight_treats_values_of_a_wrong_type_as_unknown(tmp_path):
    wrong = {
        "located": {"lat_deg": 95.0, "lon_deg": 8.0},
        "position": [1, 2],
        "confidence": "high",
        "costs": 3,
        "totals": {"used_mah": 10**400},
        "board": None,
        "vehicle": {"lat_deg": True, "lon_deg": 8.0, "t_received_s": None, "gps": "none"},
        "reason": 7,
        "place": 1e300,
        "fix": "sent",
    }
    log = tmp_path / "log"
    log.write_text(json.dumps({"kind": "query", "t_mono_s": 5.0} | query("a", **wrong)) + "\n")
    (only,) = read_flight(log).queries
    known = only.position, only.confidence, only.autopilot_position, only.gps_position, only.place, only.fix
    assert known == (None,) * 6
