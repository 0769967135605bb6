"""A profile of this machine, written once, with the watts of its meter."""

import math

import pytest

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.power import calibrate, sensors
from edgevpr.power.boards import MachineSpeed, load_board
from edgevpr.power.powermeter import Meter, MeterError
from edgevpr.runtime.preflight.ownprofile import measured_profile, require_new_profile, write_profile

SCORE = MachineSpeed(single=0.2, multi=0.7, products=0.1, passes=0.4, verified=True, source="edgevpr's micro-benchmark")


@pytest.fixture
def quick(monkeypatch):
    """A machine that holds any load at once: the busy share is what was asked for, and time passes by itself."""
    state = {"share": 0.0, "busy": 0.0, "all": 0.0, "now": 0.0}

    class Held:
        def __init__(self, share):
            state["share"] = share

        def __enter__(self):
            return self

        def __exit__(self, *_):
            state["share"] = 0.0

    def sleep(seconds):
        state["now"] += seconds
        state["all"] += seconds
        state["busy"] += seconds * state["share"]

    really = calibrate.calibrate
    monkeypatch.setattr(calibrate.busy, "cpu_times", lambda root=None: (state["busy"], state["all"]))
    monkeypatch.setattr(
        calibrate,
        "calibrate",
        lambda meter, progress: really(
            meter, clock=lambda: state["now"], sleep=sleep, load=Held, progress=progress, window_s=2.0
        ),
    )
    return state


def board_with(monkeypatch, *meters, notes=()):
    monkeypatch.setattr(sensors, "find_meters", lambda: sensors.Found(meters, notes))


def test_the_watts_of_a_meter_are_fitted_and_written_into_a_profile_that_names_it(monkeypatch, tmp_path, quick, capsys):
    meter = Meter(
        kind="ina",
        title="INA3221 (hwmon1), channel VDD_IN",
        covers="board",
        period_s=0.05,
        look=lambda: (2.0 + 4.5 * quick["share"],),
    )
    board_with(monkeypatch, meter)
    path, said = measured_profile(tmp_path / "measured.json", SCORE)
    board = load_board(str(path))
    assert (board.idle_w, board.full_w, board.verified) == (2.0, 6.5, True)
    assert "INA3221 (hwmon1), channel VDD_IN" in board.source
    assert board.benchmark_score == SCORE
    assert path.parent == tmp_path
    assert path.name.startswith("measured-")
    assert said.startswith("Power: 2 W idle, 6.5 W with every core busy, by the INA3221")
    shown = capsys.readouterr().err
    assert "1/5  load 0%" in shown
    assert "5/5  load 100%" in shown


def test_a_meter_of_the_cpu_alone_is_not_verified(monkeypatch, tmp_path, quick):
    board_with(
        monkeypatch,
        Meter(kind="rapl", title="RAPL", covers="cpu", period_s=0.05, look=lambda: (5.0 + 10 * quick["share"],)),
    )
    path, _ = measured_profile(tmp_path / "measured.json", SCORE)
    board = load_board(str(path))
    assert not board.verified
    assert board.source.startswith("CPU only")


def test_without_a_meter_it_is_one_line_and_no_file(monkeypatch, tmp_path):
    board_with(monkeypatch, notes=("This machine has no power meter that edgevpr knows.",))
    assert measured_profile(tmp_path / "m.json", SCORE) == (None, "This machine has no power meter that edgevpr knows.")
    assert not list(tmp_path.iterdir())


def test_a_meter_that_says_nonsense_leaves_no_file(monkeypatch, tmp_path, quick):
    board_with(monkeypatch, Meter(kind="ina", title="INA219", covers="board", period_s=0.05, look=lambda: (math.nan,)))
    with pytest.raises(MeterError, match="INA219 failed 3 times in a row"):
        measured_profile(tmp_path / "m.json", SCORE)
    assert not list(tmp_path.iterdir())


def test_a_file_is_never_overwritten(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    with pytest.raises(UsageError, match="is there already: move it away, or choose another name"):
        require_new_profile(path)
    with pytest.raises(EdgevprError, match="is there already"):
        write_profile(path, "title: another")
    assert path.read_text() == "precious"
    assert [each.name for each in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.mark.parametrize(
    ("name", "said"), [("mine.json", "ends in .yaml"), ("no/mine.yaml", "there is no such folder")]
)
def test_a_name_that_makes_no_profile_is_one_sentence(tmp_path, name, said):
    with pytest.raises(UsageError, match=said):
        require_new_profile(tmp_path / name)
