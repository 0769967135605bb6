"""Progress on a terminal (a real pty) and into a file."""

import io
import os

import pytest
from fakes import FakeClock

from edgevpr.core.text import format_probability, progress


def test_progress_writes_a_line_for_every_tenth_to_a_file():
    out = io.StringIO()
    assert list(progress(range(200), 200, "cohog", out)) == list(range(200))
    lines = out.getvalue().splitlines()
    assert len(lines) == 11
    assert lines[0] == "cohog  1/200  0 %"
    assert lines[-1] == "cohog  200/200  100 %"


def test_progress_redraws_one_line_on_a_terminal():
    reader, writer = os.openpty()
    with os.fdopen(writer, "w") as terminal:
        assert list(progress("abcd", 4, "map", terminal)) == list("abcd")
        drawn = ""
        while "\n" not in drawn:  # a terminal passes on what it has: perhaps not all at once
            drawn += os.read(reader, 4096).decode()
    os.close(reader)
    assert drawn.split("\r")[:4] == ["map  1/4  25 %", "map  2/4  50 %", "map  3/4  75 %", "map  4/4  100 %"]
    assert drawn.count("\n") == 1


def test_progress_shows_the_remaining_time_once_it_can_be_estimated():
    out, clock = io.StringIO(), FakeClock()

    def yield_slowly():
        for each in range(40):
            clock.now_s += 20.0
            yield each

    list(progress(yield_slowly(), 40, "sets", out, clock))
    lines = out.getvalue().splitlines()
    assert lines[0] == "sets  1/40  2 %, 13 min left"
    assert "sets  36/40  90 %, 80 s left" in lines
    assert len(lines) == 40, "no line is older than 5 s"
    assert lines[-1] == "sets  40/40  100 %"


@pytest.mark.parametrize(
    ("probability", "said"),
    [
        (0.5, "50.0 %"),
        (0.9989, "99.9 %"),
        (0.9997, "1 in 3,000 wrong"),
        (0.9999997, "1 in 1,000,000 wrong"),
        (1.0, "1 in 1,000,000 wrong"),
    ],
)
def test_format_probability_never_shows_a_row_of_nines(probability, said):
    assert format_probability(probability) == said
