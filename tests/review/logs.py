"""Logs of made-up flights, written by the real log."""

from pathlib import Path

from edgevpr.runtime.flight.flightlog import FlightLog


def query(name: str, **fields) -> dict:
    """The fields of a query with a fix that was sent."""
    at = {"lat_deg": 50.0, "lon_deg": 8.0}
    fix = {"query": name, "sent": True, "why": None, "answer": None, **at, "accuracy_m": 2.0}
    found = {"place": 3, "reference_image": "3.jpg", "score": 0.5, "position": at, "located": at, "accuracy_m": 2.0}
    return {
        "query": name,
        "accepted": True,
        "reason": {"code": "ACCEPTED_BY_CONFIDENCE", "parameters": {"confidence": 1.0}},
        "confidence": 1.0,
        **found,
        "fix": fix,
    } | fields


def write_log(path: Path, *lines: tuple[str, dict], end: bool = True, first_s: int = 1000) -> Path:
    """Write a flight, a line a second. Two of one millisecond are one flight, unless they begin at other seconds."""
    seconds = iter(range(first_s, 10_000))
    with FlightLog(path) as log:
        for kind, fields in (("start", {}), *lines, *([("end", {})] if end else [])):
            log.write(kind, **{"t_mono_s": float(next(seconds))} | fields)
    return path
