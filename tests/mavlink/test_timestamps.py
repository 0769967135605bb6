"""The time of signed messages: never back, whatever ends the process and whatever the clock of the board says."""

import subprocess
import sys
from unittest.mock import Mock

import pytest
from fakes import FakeClock
from loopback import wait_until

from edgevpr.core.errors import ConfigError
from edgevpr.mavlink.signing import OLD, TICKS_S, TimeStamps

STREAM = (7, 1, 0)
MINUTE = 60 * TICKS_S


@pytest.fixture
def path(tmp_path):
    return tmp_path / "time"


def make_stamps(path, utc_s: float = 0.0, clock=None) -> TimeStamps:
    """Those of a board whose clock stands at `utc_s`: 0 without a clock chip."""
    return TimeStamps(path, clock or FakeClock(), lambda: utc_s)


def test_time_stamps_are_saved_every_half_minute_and_resume_a_minute_later(path):
    clock = FakeClock()
    stamps = make_stamps(path, clock=clock)
    for _ in range(200):
        clock.now_s += 1
        last = stamps.next()
    wait_until(lambda: last - int(path.read_text()) < 30 * TICKS_S, "keeping the time")
    after = make_stamps(path)
    assert after.next() >= last + MINUTE
    assert after.check(STREAM, last) == OLD, "a message of before was admitted after the restart"


def test_time_stamps_follow_a_clock_set_forward_but_not_one_set_back(path):
    utc_s = [1.8e9]
    stamps = TimeStamps(path, FakeClock(), lambda: utc_s[0])
    first = stamps.next()
    utc_s[0] += 86_400
    assert stamps.next() == pytest.approx(first + 86_400 * TICKS_S, abs=100 * TICKS_S)
    last = stamps.next()
    utc_s[0] -= 10 * 86_400
    assert stamps.next() == last + 1


SCRIPT = """
import sys, time
from pathlib import Path
from edgevpr.mavlink.signing import TimeStamps
mono_s = 0.0
stamps = TimeStamps(Path(sys.argv[1]), lambda: mono_s, lambda: 0.0)
while True:
    mono_s += 0.01
    print(stamps.next(), flush=True)
"""


@pytest.mark.process
def test_time_stamps_never_decrease_after_kill_9(path):
    last = 0
    for lines in (1, 5000, 20_000):
        with subprocess.Popen([sys.executable, "-c", SCRIPT, str(path)], stdout=subprocess.PIPE, text=True) as process:
            first = last_before = int(process.stdout.readline())
            for _ in range(lines):
                last_before = int(process.stdout.readline())
            process.kill()
            rest = process.stdout.read().splitlines(keepends=True)
            last_before = max([last_before, *(int(line) for line in rest if line.endswith("\n"))])
        assert first > last
        last = last_before


@pytest.mark.parametrize("content", [b"", b"soon\n", b"-5\n", b"9" * 20, b"\xff\x00", b"1" * 100, "²".encode()])
def test_time_stamps_refuse_an_invalid_or_unwritable_file_in_one_sentence(path, content):
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="time"):
        make_stamps(path)
    assert path.read_bytes() == content
    with pytest.raises(ConfigError, match="signing_state"):
        make_stamps(path.parent / "no-folder" / "time")


def test_time_stamps_continue_on_a_full_disk(path, monkeypatch, caplog):
    clock = FakeClock()
    stamps = make_stamps(path, clock=clock)
    monkeypatch.setattr("edgevpr.mavlink.signing.write_atomically", Mock(side_effect=OSError(28, "disk full")))
    tries = []
    monkeypatch.setattr("edgevpr.mavlink.signing.Thread.start", lambda thread: tries.append(thread.run()))
    first = stamps.next()
    for _ in range(3):
        clock.now_s += 60
        assert stamps.next() > first
    assert (len(tries), caplog.text.count("disk full")) == (3, 1)
    make_stamps(path)  # nor does it at the next start, where there is a time from before


def test_time_stamps_borrowed_from_a_file_leave_it_unchanged(path):
    clock = FakeClock()
    flown = make_stamps(path, clock=clock).next()
    before = path.read_bytes()
    borrowed = TimeStamps(path, clock, lambda: 0.0, is_saved=False)
    assert borrowed.next() > flown
    clock.now_s += 300
    assert borrowed.check((1, 1, 0), borrowed.next() + 3600 * TICKS_S) is None  # the time is learnt
    assert borrowed.next() > flown + 3600 * TICKS_S
    assert path.read_bytes() == before
    assert TimeStamps(path.with_name("absent"), is_saved=False).next() > 0
    assert list(path.parent.iterdir()) == [path]
    assert make_stamps(path, clock=clock).next() < flown + 3600 * TICKS_S
