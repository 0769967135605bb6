"""Power meters found in trees that stand for /sys, what they say when they are broken, and their mean over a time."""

import pytest

from edgevpr.power.calibrate import Meter, MeterError, find_meters, mean_power

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
    assert meter.certain


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


def test_a_chip_of_one_channel_says_its_power_itself(tree):
    folder = f"{HWMON}/hwmon3"
    figures = {"power1_input": "3250000\n", "in1_input": "5100\n", "curr1_input": "637\n"}
    root = tree({f"{folder}/{name}": text for name, text in ({"name": "ina219\n"} | figures).items()})
    (meter,) = find_meters(root)
    assert (meter.read_w(), meter.certain) == (3.25, False)
    (root / folder / "power1_input").unlink()
    assert meter.read_w() == pytest.approx(5.1 * 0.637)
    assert list(find_meters(tree({f"{folder}/in1_label": "VDD_CPU"}))) == []


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


def test_a_machine_without_a_meter_has_none(tree):
    root = tree({f"{HWMON}/hwmon0/name": "coretemp\n", f"{HWMON}/hwmon0/temp1_input": "40000\n"})
    assert list(find_meters(root)) == []


def watts(clock, power):
    """A meter: `power` of seconds since the start."""
    return Meter(title="INA219 (hwmon0)", look=lambda: power(clock() - 1000.0))


def test_a_ramp_is_integrated_exactly(clock):
    mean_w = mean_power(watts(clock, lambda t_s: 2.0 + 0.3 * t_s), 10.0, clock, clock.sleep)
    assert mean_w == pytest.approx(3.5, abs=1e-9)


def test_readings_that_come_late_weigh_by_their_time(clock):
    """Every second sleep takes three times as long: a plain mean of the readings would be wrong."""
    late = [False]

    def sleep(seconds):
        late[0] = not late[0]
        clock.sleep(seconds * (3 if late[0] else 1))

    mean_w = mean_power(watts(clock, lambda t_s: 10.0 * t_s), 4.0, clock, sleep)
    assert mean_w == pytest.approx(10.0 * (clock() - 1000.0) / 2, rel=1e-9)


def test_a_meter_that_disappears_midway_is_an_error_and_no_mean(clock):
    def power(t_s):
        if t_s > 6:
            raise FileNotFoundError("/sys/x is gone")
        return 4.0

    with pytest.raises(MeterError, match=r"INA219 \(hwmon0\) cannot be read .*/sys/x is gone"):
        mean_power(watts(clock, power), 10.0, clock, clock.sleep)
    assert clock() < 1000 + 6.5  # it does not go on for the rest of the window
