"""SIGHUP: the configuration is read again in flight."""

import logging
import signal
from itertools import pairwise

import pytest
from fakes import FakeClock, FakeLink, FakeSource
from flight_process import start, wait_for
from flights import Flight, of_kind
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.runtime.flight.governor import Governor, Limits, Setting, steps
from edgevpr.runtime.flight.metering import LoadReading
from edgevpr.runtime.flight.reloading import Reread


@pytest.fixture
def clock():
    return FakeClock()


def reloaded(recording, tmp_path, clock, texts, technique="cohog"):
    """Fly eight pictures; after the second, the configuration file holds each of `texts`, one after the other, and
    SIGHUP comes each time. Give the flight and the lines of its log."""
    file = tmp_path / "config.yaml"
    given = {"map": str(recording / f"{technique}.gpkg"), "source.uri": "/dev/video0"}
    waiting, seen = list(texts), []
    flight = Flight(
        recording / f"{technique}.gpkg", tmp_path / "log", clock, FakeLink(clock), **given, **{"source.rate_hz": 1.0}
    )
    file.write_text("source: {rate_hz: 1.0}\n")
    flight.reread = Reread(lambda: load_config(file, {name: given[name] for name in given}))

    def work():
        seen.append(1)
        if len(seen) >= 2 and waiting:
            file.write_text(waiting.pop(0))
            flight.reread()

    return flight, flight.fly(FakeSource([textured(number, 240, 320) for number in range(8)], clock, work=work))


def steps_s(lines):
    at_s = [line["t_mono_s"] for line in of_kind(lines, "query")]
    return [round(after - before, 2) for before, after in pairwise(at_s)]


def test_another_rate_is_flown_from_the_next_query_on(recording, tmp_path, clock):
    _, lines = reloaded(recording, tmp_path, clock, ["source: {rate_hz: 0.5}\n"])
    (line,) = of_kind(lines, "reload")
    assert (line["taken"], line["refused"]) == ({"source.rate_hz": 0.5}, [])
    assert steps_s(lines)[0] == 1.0
    assert steps_s(lines)[-3:] == [2.0, 2.0, 2.0]


def test_another_precision_is_asked_of_matches(recording, tmp_path, clock):
    flight, lines = reloaded(recording, tmp_path, clock, ["source: {rate_hz: 1.0}\nmatch: {accept_precision: 0.95}\n"])
    assert of_kind(lines, "reload")[0]["taken"] == {"match.accept_precision": 0.95}
    assert flight.recogniser.rule.sure.precision == 0.95


def test_what_may_not_change_in_flight_is_refused_by_name_each_time(recording, tmp_path, clock, caplog):
    text = "source: {rate_hz: 1.0, fov_deg: 60}\nmavlink: {send_fixes: false}\nmatch: {accept_precision: 0.9}\n"
    with caplog.at_level(logging.INFO):
        flight, lines = reloaded(recording, tmp_path, clock, [text, text])
    first, second = of_kind(lines, "reload")
    assert first["taken"] == {"match.accept_precision": 0.9}
    assert first["refused"] == second["refused"] == ["source.fov_deg", "mavlink.send_fixes"]
    assert second["taken"] == {}
    assert caplog.messages.count("only a new start changes source.fov_deg, mavlink.send_fixes") == 2
    assert flight.link.stats().fixes_sent > 2, "it flies on as it was told at the start"


@pytest.mark.parametrize(
    "text", ["source: {rate_hz: 1000}\n", "mapp: x\n", "source: [", "\0", "match: {accept_precision: 2}"]
)
def test_a_broken_file_changes_nothing_and_is_said(recording, tmp_path, clock, caplog, text):
    _, lines = reloaded(recording, tmp_path, clock, [text])
    (line,) = of_kind(lines, "reload")
    assert "config.yaml" in line["problem"]
    assert any(line["problem"] in message for message in caplog.messages)
    assert set(steps_s(lines)) == {1.0}


def test_what_the_governor_has_lowered_stays_lowered():
    governor = Governor(Limits(0.5, 500, 80), steps(Setting(1.0, 30), keeps_rate=False))
    reading = LoadReading(cpu_share=0.9, late_share=0.0, rss_mb=100.0, temperature_c=None, throttled=None)
    for now_s in range(10):
        if governor.look(now_s, reading):
            break
    assert governor.setting.rate_hz == 0.5
    governor.ask_rate(4.0)
    assert (governor.asked.rate_hz, governor.setting.rate_hz) == (4.0, 2.0)


@pytest.mark.slow
def test_the_start_line_is_repeated_with_the_configuration_that_is_in_force(recording, tmp_path):
    config, log = tmp_path / "c.yaml", tmp_path / "flight.jsonl"
    config.write_text("source: {rate_hz: 2}\n")
    run = start(recording / "cohog.gpkg", recording / "blind" / "images", log, "--config", str(config))
    begun = wait_for("start", log, run)
    wait_for("query", log, run)
    config.write_text("source: {rate_hz: 3}\nmavlink: {component_id: 7}\n")
    run.send_signal(signal.SIGHUP)
    wait_for("reload", log, run)
    log.rename(tmp_path / "taken.jsonl")
    again = wait_for("start", log, run)
    run.terminate()
    run.communicate(timeout=120)
    assert (begun["config"]["source"]["rate_hz"], again["config"]["source"]["rate_hz"]) == (2.0, 3.0)
    begun["config"]["source"]["rate_hz"] = 3.0
    assert again == {**begun, "repeated": True, "part": 2}, "what may not change in flight is as it was"
