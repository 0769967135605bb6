"""A flight that is commanded from the ground: it pauses and goes on."""

import pytest
from fakes import FakeSource, format_note
from flights import draw_pictures, select

from edgevpr.core.reasons import ReasonCode
from edgevpr.mavlink.ground import UserCommand
from edgevpr.runtime.flight import systemd


def list_queries(lines):
    return [line["query"] for line in select(lines, "query")]


def test_pause_stops_queries_and_sending_and_resumes_with_the_newest_image(make_flight, clock, link):
    answers, health = [], []

    def work():
        link.predict_vehicle(clock())  # the autopilot reports during the pause too
        health.append(link.health.name)
        if wish := {2: UserCommand.PAUSE, 5: UserCommand.RESUME}.get(len(health)):
            answers.append(link.send_command(wish))

    lines = make_flight().fly(FakeSource(draw_pictures(7), clock, work=work))
    assert answers == ["ACCEPTED", "ACCEPTED"]
    assert list_queries(lines) == ["frame 000000", "frame 000001", "frame 000005", "frame 000006"]
    assert health == ["ACTIVE", "ACTIVE", "STANDBY", "STANDBY", "STANDBY", "ACTIVE", "ACTIVE"]
    assert link.stats().fixes_sent == 4
    assert [(line["command"], line["sender"], line["note"]["code"]) for line in select(lines, "command")] == [
        ("PAUSE", "255/190", "PAUSED_BY_COMMAND"),
        ("RESUME", "255/190", "RESUMED_BY_COMMAND"),
    ]
    codes = ReasonCode.PAUSED_BY_COMMAND, ReasonCode.RESUMED_BY_COMMAND
    assert link.texts() == [(6, format_note(code)) for code in codes]


def test_pause_halts_a_recording(make_flight, clock, link):
    flown = make_flight()
    source = FakeSource(draw_pictures(3), clock, is_live=False, work=lambda: link.send_command(UserCommand.PAUSE))
    clock.schedule(30.0, lambda: link.send_command(UserCommand.RESUME))
    clock.schedule(60.0, flown.stop)
    started_s = clock.now_s
    lines = flown.fly(source)
    assert list_queries(lines) == ["frame 000000", "frame 000001"], "paused, gone on, and paused again by the second"
    assert clock.now_s - started_s == pytest.approx(60.0, abs=0.5)


def test_pause_feeds_the_watchdog_and_shows_in_the_status(make_flight, clock, link, monkeypatch):
    told = []
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    assert systemd.watchdog_interval_s() == 1.0
    monkeypatch.setattr(systemd, "notify", lambda **said: told.append(said))
    source = FakeSource(draw_pictures(9), clock, work=lambda: link.send_command(UserCommand.PAUSE))
    assert list_queries(make_flight().fly(source)) == ["frame 000000"]
    assert sum("WATCHDOG" in each for each in told) == 9
    assert "1 queries" in told[-2]["STATUS"]
    assert "; paused" in told[-2]["STATUS"]
