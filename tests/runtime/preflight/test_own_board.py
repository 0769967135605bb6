"""The profile of this machine, as measured; and the speed that costs measured here are scaled from."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.power import calibrate
from edgevpr.power.boards import MachineSpeed, load_board
from edgevpr.runtime.preflight import own_board
from edgevpr.runtime.preflight.own_board import scaled_from, write_profile

SCORE = MachineSpeed(single=0.2, multi=0.7, products=0.1, passes=0.4, verified=True, source="edgevpr's micro-benchmark")


@pytest.fixture(autouse=True)
def scored(monkeypatch):
    monkeypatch.setattr(own_board, "micro_benchmark", lambda: SCORE)


def test_the_score_that_is_scaled_from_is_measured_unless_both_are_published():
    x86, pi, other = load_board("generic-x86"), load_board("rpi-4b"), load_board("rpi-5")
    assert scaled_from(x86, pi).benchmark_score == SCORE
    assert scaled_from(pi, other) == pi, "7-zip beside 7-zip"
    assert scaled_from(pi, replace(other, benchmark_score=SCORE)).benchmark_score == SCORE
    assert scaled_from(x86, x86) == x86


def meter_at(held, watts):
    return SimpleNamespace(title="INA3221 (hwmon1), channel VDD_IN", read_w=lambda: watts(held[-1]))


@pytest.fixture
def held(monkeypatch):
    """A machine that holds any load at once; the loads that were held."""
    held = []

    def measure_at(meter, share):
        held.append(share)
        return share, meter.read_w()

    monkeypatch.setattr(calibrate, "measure_at", measure_at)
    return held


def test_the_watts_of_a_meter_are_fitted_and_written_into_a_profile_that_names_it(monkeypatch, tmp_path, held, capsys):
    meter = meter_at(held, lambda share: 2.0 + 4.5 * share)
    monkeypatch.setattr(calibrate, "find_meters", lambda: (meter,))
    said = write_profile(tmp_path / "mine.yaml")
    board = load_board(str(tmp_path / "mine.yaml"))
    assert (board.idle_w, board.full_w, board.verified) == (pytest.approx(2.0), pytest.approx(6.5), True)
    assert meter.title in board.source
    assert board.benchmark_score == SCORE
    assert said.startswith("Power: 2 W idle, 6.5 W ")
    assert "load 100%" in capsys.readouterr().err


def test_a_file_is_never_overwritten(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    for named in (path, tmp_path / "mine.json", tmp_path / "no" / "mine.yaml"):
        with pytest.raises(UsageError, match=str(named)):
            write_profile(named)
    assert path.read_text() == "precious"
    assert [each.name for each in tmp_path.iterdir()] == ["mine.yaml"]
