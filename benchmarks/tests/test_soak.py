"""The soak: its verdict, and a real one of some seconds."""

import base
import pytest
import soak
from soak_page import growth, page, verdict


def made_up(grown_mb_s: float = 0.0, later: dict | None = None, last: dict | None = None, **more: object) -> dict:
    """An hour without anything wrong but that; `later` changes the second half, `last` the last sample."""
    samples = [
        {
            "t_s": t_s,
            # What a flight takes in its first minutes is no growth.
            "rss_mb": 100.0 + min(t_s, 250) / 10 + max(0, t_s - 300) * grown_mb_s,
            "descriptors": 14,
            "threads": 9,
            "log_mb": 0.7,
            "is_calm": True,
            **(later or {} if t_s >= 1800 else {}),
        }
        for t_s in range(0, 3600, 5)
    ]
    samples[-1] |= last or {}
    ended = {"statuses": 700, "exit_code": 0, "tracebacks": 0, "log_limit_mb": 1.0, "end": {"accepted": 6000}}
    return {"samples": samples, **ended, **more}


def test_growth_is_that_after_five_minutes():
    found = growth(made_up(grown_mb_s=3 / 3600)["samples"])
    assert found["settled_s"] == 300
    # From the middle of the minutes 5 to 10 to that of the last six.
    assert found["grown_mb"] == pytest.approx(3 / 3600 * (3420 - 450), abs=0.02)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (made_up(), None),
        (made_up(grown_mb_s=1.5 / 3600), None),
        (made_up(later={"descriptors": 13, "threads": 6, "is_calm": False}), None),  # something is away
        (made_up(grown_mb_s=3 / 3600), "2.5 MB"),
        (made_up(last={"descriptors": 15}), "descriptors"),
        (made_up(last={"threads": 8}), "threads"),
        (made_up(last={"log_mb": 1.1}), "1.10 MB"),
        (made_up(tracebacks=1), "1 tracebacks"),
        (made_up(exit_code=-9), "code -9"),
        (made_up(end={"accepted": 0}), "no flight"),
    ],
)
def test_what_is_wrong_is_said(found, said):
    sentences = verdict(found)
    assert len(sentences) == (said is not None)
    assert not said or said in sentences[0]


def test_a_real_soak_of_some_seconds(tmp_path):
    """Everything goes away and comes back, and the flight goes on."""
    found = soak.run(tmp_path, lasts_s=12.0, every_s=1.0, radius_m=30.0)
    assert len(found["events"]) == 5
    assert (found["exit_code"], found["tracebacks"]) == (0, 0)
    assert found["statuses"] > 0
    assert found["end"]["accepted"] > 0
    first, last = found["samples"][0], found["samples"][-1]
    assert last["tlog_mb"] > first["tlog_mb"]
    assert 0 < last["log_mb"] <= found["log_limit_mb"]
    assert all(each["rss_mb"] > 0 for each in found["samples"])
    assert "autopilot frozen: 1" in page(base.made_by() | found)
