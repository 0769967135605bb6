"""The idle and full watts of a board from two loads, and the profile of this machine that is written with them."""

from types import SimpleNamespace

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.power import calibrate as calibrating
from edgevpr.power.boards import MachineSpeed, load_board
from edgevpr.power.calibrate import MeterError, calibrate, find_meter, measure_load, write_profile

METER = SimpleNamespace(title="INA3221 (hwmon1), channel VDD_IN", read_w=lambda: 4.0)
SCORE = MachineSpeed(single=0.2, multi=0.7, products=0.1, passes=0.4, verified=True, source="edgevpr's micro-benchmark")


@pytest.fixture
def measured(monkeypatch):
    """A machine whose loads are held at once: the points (utilisation, watts) of idle and full load can be set."""
    points = {0.0: (0.0, 2.0), 1.0: (1.0, 6.5)}
    monkeypatch.setattr(calibrating, "measure_load", lambda meter, load: points[load])
    monkeypatch.setattr(calibrating, "micro_benchmark", lambda: SCORE)
    monkeypatch.setattr(calibrating, "find_meter", lambda: METER)
    return points


def test_calibrate_takes_the_watts_at_what_the_whole_machine_did(measured):
    measured.update({0.0: (0.04, 2.12), 1.0: (0.96, 4.88)})  # another program takes 0.04 of the machine all the time
    board = calibrate(load_board("rpi-4b"), METER)
    assert (board.idle_w, board.full_w, board.verified) == (pytest.approx(2.0), pytest.approx(5.0), True)
    assert board.source == f"measured on this machine, idle and with all cores busy, with its {METER.title}"


@pytest.mark.parametrize(
    ("idle", "full", "word"),
    [
        ((0.8, 4.0), (1.0, 5.0), "80% of the machine was busy when idle, and 100% at full load"),
        ((0.2, 0.5), (1.0, 5.5), "-0.75 W idle"),
        ((0.0, 5.0), (1.0, 3.0), "-2 W more"),
        ((0.0, 5.0), (1.0, 5.0), "of no board"),
    ],
)
def test_calibrate_refuses_figures_that_no_board_can_have(measured, idle, full, word):
    measured.update({0.0: idle, 1.0: full})
    with pytest.raises(MeterError, match=word):
        calibrate(load_board("rpi-4b"), METER)


def test_write_profile_names_the_meter_and_is_read_back(measured, tmp_path, capsys):
    power = write_profile(tmp_path / "mine.yaml")
    board = load_board(str(tmp_path / "mine.yaml"))
    assert (board.idle_w, board.full_w, board.verified) == (pytest.approx(2.0), pytest.approx(6.5), True)
    assert METER.title in board.source
    assert board.benchmark_score == SCORE
    assert power.startswith("Power: 2 W idle, 6.5 W ")
    assert "load 100%" in capsys.readouterr().err


def test_write_profile_never_overwrites_a_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    for named in (path, tmp_path / "mine.json", tmp_path / "no" / "mine.yaml"):
        with pytest.raises(UsageError, match=str(named)):
            write_profile(named)
    assert path.read_text() == "precious"
    assert [file.name for file in tmp_path.iterdir()] == ["mine.yaml"]


def test_measure_at_raises_where_the_meter_disappears():
    readings = iter([4.0, 4.0])

    def read_w():
        for reading in readings:
            return reading
        raise MeterError("it is gone")

    with pytest.raises(MeterError, match="it is gone"):
        measure_load(SimpleNamespace(title="a meter", read_w=read_w), 0.0, settle_s=0.0, window_s=60.0)


HWMON = "sys/class/hwmon"


def orin(**changes):
    files = {"name": "ina3221", "in7_label": "sum of shunt voltages", "in7_input": "3"}
    rails = (("VDD_IN", 5000, 1200), ("VDD_CPU_GPU_CV", 4900, 300), ("VDD_SOC", 4950, 400))
    for channel, (label, mv, ma) in enumerate(rails, 1):
        files |= {f"in{channel}_label": label, f"in{channel}_input": f"{mv}\n", f"curr{channel}_input": f"{ma}\n"}
    return {f"{HWMON}/hwmon1/{name}": text for name, text in (files | changes).items()}


@pytest.mark.parametrize(
    ("changes", "watts"),
    [
        ({}, 6.0),
        ({"in1_label": "POM_5V_GPU", "in3_label": "POM_5V_IN"}, 1.98),  # a Jetson Nano
        ({"curr1_input": "-1"}, 0.0),  # the offset of an idle channel
        ({"in1_enable": "0\n", "in3_enable": "1\n"}, None),
        ({"in1_label": "VDD_GPU"}, None),
    ],
)
def test_find_meter_takes_only_the_input_of_the_board(tree, changes, watts):
    meter = find_meter(tree(orin(**changes)))
    assert (meter and meter.read_w()) == (watts and pytest.approx(watts))


@pytest.mark.parametrize(
    ("current", "word"),
    [("-800", "-4 W"), ("900000", "4500 W"), ("many", "'many'"), ("nan", "nan W"), ("inf", "inf W")],
)
def test_read_w_refuses_an_impossible_value(tree, current, word):
    meter = find_meter(tree(orin(curr1_input=current)))
    with pytest.raises(MeterError, match=word):
        meter.read_w()


def test_read_w_refuses_a_meter_that_is_gone(tree):
    root = tree(orin())
    meter = find_meter(root)
    (root / HWMON / "hwmon1/curr1_input").unlink()
    with pytest.raises(MeterError, match="curr1_input"):
        meter.read_w()
