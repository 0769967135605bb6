"""Power meters found in trees that stand for /sys, and what they say when they are broken."""

import pytest

from edgevpr.power.powermeter import MeterError
from edgevpr.power.sensors import find_meters

HWMON = "sys/class/hwmon"
RAPL = "sys/class/powercap"

PMIC = """\
     3V7_WL_SW_A current(0)=0.10000000A
      VDD_CORE_A current(7)=2.00000000A
     3V7_WL_SW_V volt(8)=3.70000000V
      VDD_CORE_V volt(15)=0.80000000V
         EXT5V_V volt(24)=5.10000000V
          BATT_V volt(25)=0.00000000V
"""


def orin(**changes):
    files = {"name": "ina3221", "in7_label": "sum of shunt voltages", "in7_input": "3"}
    rails = (("VDD_IN", 5000, 1200), ("VDD_CPU_GPU_CV", 4900, 300), ("VDD_SOC", 4950, 400))
    for channel, (label, mv, ma) in enumerate(rails, 1):
        files |= {f"in{channel}_label": label, f"in{channel}_input": f"{mv}\n", f"curr{channel}_input": f"{ma}\n"}
    return {f"{HWMON}/hwmon1/{name}": text for name, text in (files | changes).items()}


def package(number, energy_uj=5_000_000, wrap_uj=262_143_328_850, name=None):
    folder = f"{RAPL}/intel-rapl:{number}"
    return {
        f"{folder}/name": name or f"package-{number}\n",
        f"{folder}/energy_uj": f"{energy_uj}\n",
        f"{folder}/max_energy_range_uj": f"{wrap_uj}\n",
    }


def pi5(tree, answer=PMIC, model="Raspberry Pi 5 Model B Rev 1.0", code=0):
    root = tree(
        {
            "proc/device-tree/model": model + "\0",
            "usr/bin/vcgencmd": f'#!/bin/sh\n[ "$1" = pmic_read_adc ] || exit 9\ncat <<END\n{answer}END\nexit {code}\n',
        }
    )
    (root / "usr/bin/vcgencmd").chmod(0o755)
    return root


def test_of_three_channels_the_board_s_input_comes_first(tree):
    found = find_meters(tree(orin()))
    assert [(meter.covers, meter.read().power_w) for meter in found.meters] == [
        ("board", pytest.approx(6.0)),
        ("rail", pytest.approx(1.47)),
        ("rail", pytest.approx(1.98)),
    ]
    assert "channel VDD_IN" in found.meters[0].title
    assert found.notes == ()


def test_three_channels_without_labels_are_not_taken_for_the_input(tree):
    files = {name: text for name, text in orin().items() if "label" not in name}
    assert [meter.covers for meter in find_meters(tree(files)).meters] == ["rail"] * 3


def test_a_channel_that_is_switched_off_is_no_meter(tree):
    titles = [meter.title for meter in find_meters(tree(orin(in2_enable="0\n", in3_enable="1\n"))).meters]
    assert len(titles) == 2
    assert not any("CPU_GPU" in title for title in titles)


def test_a_jetson_nano_names_its_input_otherwise(tree):
    found = find_meters(tree(orin(in1_label="POM_5V_GPU", in3_label="POM_5V_IN")))
    assert found.meters[0].read().power_w == pytest.approx(1.98)


def test_a_chip_of_one_channel_says_its_power_itself(tree):
    folder = f"{HWMON}/hwmon3"
    root = tree(
        {
            f"{folder}/name": "ina219\n",
            f"{folder}/power1_input": "3250000\n",
            f"{folder}/in1_input": "5100\n",
            f"{folder}/curr1_input": "637\n",
        }
    )
    (meter,) = find_meters(root).meters
    assert (meter.covers, meter.read(lambda: 7.0).power_w, meter.read(lambda: 7.0).t_mono_s) == ("board", 3.25, 7.0)
    (root / folder / "power1_input").unlink()
    assert meter.read().power_w == pytest.approx(5.1 * 0.637)


def test_only_whole_packages_are_counted_and_each_once(tree):
    root = tree(
        {
            **package(0, energy_uj=10_000_000),
            **package("0:0", name="core", energy_uj=4_000_000),
            **package(1, energy_uj=20_000_000),
            **package("1:0", name="dram"),
            **package(2, name="psys"),
        }
    )
    (meter,) = find_meters(root).meters
    assert (meter.kind, meter.covers) == ("rapl", "cpu")
    assert meter.read().energies_j == (10.0, 20.0)
    assert meter.wraps_j == (262143.32885, 262143.32885)


def test_a_counter_for_the_superuser_only_is_a_sentence(tree, monkeypatch):
    root = tree(package(0))
    path = root / RAPL / "intel-rapl:0/energy_uj"
    read_text = type(path).read_text

    def refused(self, *args, **options):
        if self == path:
            raise PermissionError(13, "Permission denied")
        return read_text(self, *args, **options)

    monkeypatch.setattr(type(path), "read_text", refused)
    found = find_meters(root)
    assert found.meters == ()
    assert found.notes == (
        f"{path} can be read by the superuser only: run this with sudo, or allow it with sudo chmod a+r {path}.",
    )


def test_a_counter_that_does_not_say_when_it_wraps_is_not_used(tree):
    found = find_meters(tree(package(0, wrap_uj=0)))
    assert found.meters == ()
    assert "does not say when its counter wraps" in found.notes[0]


def test_a_counter_beyond_its_range_is_refused(tree):
    root = tree(package(0, wrap_uj=10_000_000))
    (meter,) = find_meters(root).meters
    tree(package(0, energy_uj=-1, wrap_uj=10_000_000))
    with pytest.raises(MeterError, match="outside its own range"):
        meter.read()


def test_the_power_chip_of_a_pi_5_is_corrected_for_what_its_rails_leave_out(tree):
    (meter,) = find_meters(pi5(tree)).meters
    assert (meter.kind, meter.covers) == ("pmic", "board")
    assert meter.read().power_w == pytest.approx(1.1451 * (0.1 * 3.7 + 2.0 * 0.8) + 0.5879)


def test_other_raspberry_pis_have_no_such_chip(tree):
    assert find_meters(pi5(tree, model="Raspberry Pi 4 Model B Rev 1.5")).meters == ()


@pytest.mark.parametrize(
    ("answer", "code", "sentence"),
    [
        ("", 0, "lists no rail with volts and amperes"),
        ("error=2 error_msg=not registered\n", 0, "lists no rail with volts and amperes"),
        ("VDD_CORE_A current(7)=1..2A\n", 0, "which is no number"),
        ("", 1, "cannot be read with vcgencmd"),
    ],
)
def test_a_power_chip_that_answers_nonsense_is_a_sentence(tree, answer, code, sentence):
    (meter,) = find_meters(pi5(tree, answer, code=code)).meters
    with pytest.raises(MeterError, match=sentence):
        meter.read()


@pytest.mark.parametrize(
    ("current", "sentence"),
    [
        ("-800", "says -4 W, which cannot be"),
        ("900000", "says 4500 W, which cannot be"),
        ("many", "says 'many', which is no number"),
        ("", "says '', which is no number"),
        ("nan", "which is no number"),
        ("inf", "which is no number"),
    ],
)
def test_nonsense_is_never_passed_on_as_a_figure(tree, current, sentence):
    meter = find_meters(tree(orin(curr1_input=current))).meters[0]
    with pytest.raises(MeterError, match=sentence):
        meter.read()


def test_the_offset_of_an_idle_channel_is_no_nonsense(tree):
    assert find_meters(tree(orin(curr1_input="-1"))).meters[0].read().power_w == 0


def test_a_meter_that_goes_is_a_sentence(tree):
    root = tree(orin())
    meter = find_meters(root).meters[0]
    (root / HWMON / "hwmon1/curr1_input").unlink()
    with pytest.raises(MeterError, match=r"curr1_input cannot be read \(No such file or directory\): the power meter"):
        meter.read()


def test_a_machine_without_a_meter_is_told_so(tree):
    found = find_meters(tree({f"{HWMON}/hwmon0/name": "coretemp\n", f"{HWMON}/hwmon0/temp1_input": "40000\n"}))
    assert found.meters == ()
    assert found.notes[0].startswith("This machine has no power meter that edgevpr knows")
