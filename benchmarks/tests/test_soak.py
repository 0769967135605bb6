"""The soak: its verdict, and a real one of some seconds."""

import json
from dataclasses import replace

import pytest
import soak
from soak_page import Sample, Soak, growth, verdict, write_page


def made_up(grown_mb_s: float = 0.0, later: dict | None = None, **last: object) -> Soak:
    """An hour without anything wrong but that; `later` changes the second half, `last` the last sample."""
    samples = [
        Sample(
            t_s=t_s,
            # What a flight takes in its first minutes is no growth.
            rss_mb=100.0 + min(t_s, 250) / 10 + max(0, t_s - 300) * grown_mb_s,
            pss_mb=90.0,
            uss_mb=80.0,
            descriptors=14,
            threads=9,
            cpu_s=t_s / 10,
            log_mb=0.7,
            tlog_mb=t_s / 500,
            away="",
            is_calm=True,
        )
        for t_s in range(0, 3600, 5)
    ]
    half = len(samples) // 2
    samples[half:] = [replace(each, **(later or {})) for each in samples[half:]]
    samples[-1] = replace(samples[-1], **last)
    end = {"queries": 7000, "accepted": 6000}
    return Soak(
        samples=samples, events={}, statuses=700, exit_code=0, tracebacks=0, warnings=0, log_limit_mb=1.0, end=end
    )


def test_a_flight_that_settles_is_as_it_should_be():
    assert verdict(made_up()) == []
    assert verdict(made_up(grown_mb_s=1.5 / 3600)) == []


def test_growth_is_that_after_five_minutes():
    found = growth(made_up(grown_mb_s=3 / 3600).samples)
    assert found.settled_s == 300
    # From the middle of the minutes 5 to 10 to that of the last six.
    assert found.grown_mb == pytest.approx(3 / 3600 * (3420 - 450), abs=0.02)
    assert found.slope_mb_h == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (made_up(grown_mb_s=3 / 3600), "memory has grown by 2.5 MB"),
        (made_up(descriptors=15), "descriptors is not constant while all is there: [14, 15]"),
        (made_up(threads=8), "threads is not constant while all is there: [8, 9]"),
        (made_up(log_mb=1.1), "the flight log took 1.10 MB; 1 MB are allowed"),
        (replace(made_up(), tracebacks=1), "1 tracebacks"),
        (replace(made_up(), exit_code=-9), "code -9"),
        (replace(made_up(), end={"queries": 7000, "accepted": 0}), "that was no flight"),
    ],
)
def test_what_is_wrong_is_said(wrong, said):
    (sentence,) = verdict(wrong)
    assert said in sentence


def test_what_differs_while_something_is_away_is_not_wrong():
    gone = {"descriptors": 13, "threads": 6, "is_calm": False, "away": "camera pulled out"}
    assert verdict(made_up(later=gone)) == []


def test_a_real_soak_of_some_seconds(tmp_path):
    """Everything goes away and comes back, and the flight goes on."""
    found = soak.run(tmp_path, lasts_s=12.0, every_s=1.0, radius_m=30.0)
    assert set(found.events) == {
        "configuration read again",
        "a reader that reads nothing",
        "camera pulled out",
        "autopilot killed",
        "camera silent",
        "autopilot frozen",
        "ground station closed",
    }
    assert found.exit_code == 0
    assert found.tracebacks == 0
    assert found.statuses > 0
    assert found.end["accepted"] > 0
    first, last = found.samples[0], found.samples[-1]
    assert last.tlog_mb > first.tlog_mb
    assert 0 < last.log_mb <= found.log_limit_mb
    assert all(0 < each.uss_mb <= each.pss_mb <= each.rss_mb for each in found.samples)

    write_page(tmp_path, found, {"date": "today", "commit": "this", "machine": {"cores": 1, "cpu": "one"}})
    assert json.loads((tmp_path / "soak.json").read_text())["statuses"] == found.statuses
    assert (tmp_path / "soak.png").read_bytes().startswith(b"\x89PNG")
    assert "autopilot frozen: 1" in (tmp_path / "soak.md").read_text()
