"""Power meters found in trees that stand for /sys, and what they say when they are broken."""

import pytest

from edgevpr.power.calibrate import MeterError, find_meters

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
