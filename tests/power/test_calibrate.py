"""The idle and full watts of a board from two loads, made up and of the real machine."""

from types import SimpleNamespace

import pytest

from edgevpr.power import calibrate as calibrating
from edgevpr.power.boards import load_board
from edgevpr.power.calibrate import MeterError, calibrate, find_meters, measure_at

METER = SimpleNamespace(title="INA3221 (hwmon1), channel VDD_IN", read_w=lambda: 4.0)
PI4 = load_board("rpi-4b")


def calibrated(monkeypatch, idle, full):
    """The Pi 4 after it was measured as two points (utilisation, watts), and the loads that were announced."""
    loads, points = [], {0.0: idle, 1.0: full}
    monkeypatch.setattr(calibrating, "measure_at", lambda meter, load: points[load])
    return calibrate(PI4, METER, loads.append), loads


def test_a_board_gets_the_watts_at_what_the_whole_machine_did(monkeypatch):
    # Another program takes 0.04 of the machine all the time.
    board, loads = calibrated(monkeypatch, (0.04, 2.12), (0.96, 4.88))
    assert loads == [0.0, 1.0]
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
def test_figures_that_no_board_can_have_are_one_sentence(monkeypatch, idle, full, word):
    with pytest.raises(MeterError, match=word):
        calibrated(monkeypatch, idle, full)


def test_a_meter_that_disappears_midway_is_an_error_and_no_mean():
    readings = iter([4.0, 4.0])

    def read_w():
        for reading in readings:
            return reading
        raise MeterError("it is gone")

    with pytest.raises(MeterError, match="it is gone"):
        measure_at(SimpleNamespace(title="a meter", read_w=read_w), 0.0, settle_s=0.0, window_s=60.0)


HWMON = "sys/class/hwmon"


def orin(**changes):
    files = {"name": "ina3221", "in7_label": "sum of shunt voltages", "in7_input": "3"}
    rails = (("VDD_IN", 5000, 1200), ("VDD_CPU_GPU_CV", 4900, 300), ("VDD_SOC", 4950, 400))
    for channel, (label, mv, ma) in enumerate(rails, 1):
        files |= {f"in{channel}_label": label, f"in{channel}_input": f"{mv}\n", f"curr{channel}_input": f"{ma}\n"}
    return {f"{HWMON}/hwmon1/{name}": text for name, text in (files | changes).items()}


def test_of_three_channels_only_the_boards_input_is_a_meter(tree):
    (meter,) = find_meters(tree(orin()))
    assert meter.read_w() == pytest.approx(6.0)
    assert "channel VDD_IN" in meter.title


@pytest.mark.parametrize(
    ("changes", "watts"),
    [
        ({"in1_label": "POM_5V_GPU", "in3_label": "POM_5V_IN"}, [1.98]),  # a Jetson Nano
        ({"in1_enable": "0\n", "in3_enable": "1\n"}, []),
        ({"in1_label": "VDD_GPU"}, []),
    ],
)
def test_the_input_goes_by_its_name_and_must_be_switched_on(tree, changes, watts):
    assert [meter.read_w() for meter in find_meters(tree(orin(**changes)))] == pytest.approx(watts)


@pytest.mark.parametrize(
    ("current", "word"),
    [("-800", "-4 W"), ("900000", "4500 W"), ("many", "'many'"), ("", "''"), ("nan", "nan W"), ("inf", "inf W")],
)
def test_nonsense_is_never_passed_on_as_a_figure(tree, current, word):
    (meter,) = find_meters(tree(orin(curr1_input=current)))
    with pytest.raises(MeterError, match=word):
        meter.read_w()


def test_the_offset_of_an_idle_channel_is_no_nonsense(tree):
    (meter,) = find_meters(tree(orin(curr1_input="-1")))
    assert meter.read_w() == 0


def test_a_meter_that_goes_is_a_sentence(tree):
    root = tree(orin())
    (meter,) = find_meters(root)
    (root / HWMON / "hwmon1/curr1_input").unlink()
    with pytest.raises(MeterError, match="curr1_input"):
        meter.read_w()
