"""Temperature, frequency and throttling from trees that stand for /sys."""

import pytest

from edgevpr.power.thermal import ThermalState, ThermalWatch, read_limit_c

ZONE = "sys/class/thermal/thermal_zone"
CPU = "sys/devices/system/cpu"
POLICY = f"{CPU}/cpufreq/policy0"
PI = {
    f"{ZONE}0/type": "cpu-thermal\n",
    f"{ZONE}0/temp": "48312\n",
    f"{ZONE}0/trip_point_0_type": "critical\n",
    f"{ZONE}0/trip_point_0_temp": "110000\n",
    f"{POLICY}/cpuinfo_max_freq": "1800000\n",
    f"{POLICY}/scaling_max_freq": "1800000\n",
    f"{POLICY}/scaling_cur_freq": "600000\n",
}
FIRMWARE = "sys/devices/platform/soc/soc:firmware/get_throttled"
HWMON = "sys/class/hwmon/hwmon"


def make_state(temperature_c, frequency_mhz, throttled, why="", **more):
    return ThermalState(temperature_c=temperature_c, frequency_mhz=frequency_mhz, throttled=throttled, why=why, **more)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, make_state(48.312, 600.0, False, hot=False)),
        ({f"{ZONE}1/type": "wifi-thermal\n", f"{ZONE}1/temp": "90000\n"}, make_state(48.312, 600.0, False, hot=False)),
        ({f"{ZONE}2/type": "soc0-thermal\n", f"{ZONE}2/temp": "51000\n"}, make_state(51.0, 600.0, False, hot=False)),
        ({f"{POLICY}/scaling_max_freq": "1000000\n"}, make_state(48.312, 600.0, False, hot=False)),  # a power mode
        ({f"{ZONE}0/temp": "82500\n"}, make_state(82.5, 600.0, True, "600 of 1800 MHz at 82.5 degrees", hot=True)),
        (
            {f"{CPU}/cpufreq/policy4/{name}": "2400000" for name in ("cpuinfo_max_freq", "scaling_cur_freq")},
            make_state(48.312, 2400.0, False, hot=False),  # the fastest of two clusters
        ),
    ],
)
def test_thermal_watch_reads_temperature_frequency_and_throttling(tree, files, expected):
    assert ThermalWatch(tree(PI | files)).read() == expected


@pytest.mark.parametrize("nonsense", ["hot\n", "999999999\n", "-300000\n", "\udcff"])
def test_thermal_watch_treats_invalid_values_as_unknown(tree, nonsense):
    root = tree(PI)
    (root / f"{ZONE}0/temp").write_bytes(nonsense.encode(errors="surrogateescape"))
    (root / f"{POLICY}/scaling_cur_freq").write_bytes(b"-1\n")
    watch = ThermalWatch(root)
    assert watch.read() == make_state(None, None, False)
    for name in PI:
        (root / name).unlink()
    assert watch.read() == make_state(None, None, False), "where sensors disappear too"


def test_thermal_watch_treats_a_falling_frequency_limit_as_throttling(tree):
    watch = ThermalWatch(tree(PI))
    assert watch.read().throttled is False
    tree({f"{POLICY}/scaling_max_freq": "1200000\n"})
    seen = watch.read()
    assert (seen.throttled, "1200 of 1800 MHz" in seen.why) == (True, True)
    tree({f"{POLICY}/scaling_max_freq": "1800000\n"})
    assert watch.read().throttled is False


@pytest.mark.parametrize(
    ("answer", "throttled", "why", "under_voltage", "hot"),
    [
        ("0\n", False, "", False, False),
        ("a\n", True, "frequency capped, soft temperature limit now", False, True),
        ("1\n", False, "under-voltage now", True, False),
        ("50005\n", True, "under-voltage, throttled now", True, False),
        ("50004\n", True, "throttled now; under-voltage since start", False, False),
        ("what\n", False, "", None, False),
    ],
)
def test_thermal_watch_reads_the_flags_of_the_firmware(tree, answer, throttled, why, under_voltage, hot):
    expected = make_state(48.312, 600.0, throttled, why=why, under_voltage=under_voltage, hot=hot)
    assert ThermalWatch(tree(PI | {FIRMWARE: answer})).read() == expected


def test_thermal_watch_reports_an_under_voltage_between_two_readings_once(tree):
    watch = ThermalWatch(tree(PI | {FIRMWARE: "0\n"}))
    seen = []
    for answer in ("0\n", "10000\n", "10000\n", "50000\n"):
        tree({FIRMWARE: answer})
        seen.append(watch.read().under_voltage)
    assert seen == [False, True, False, False]


@pytest.mark.parametrize("more", [{}, {FIRMWARE: "0\n"}])
def test_thermal_watch_treats_the_alarm_of_the_driver_as_under_voltage(tree, more):
    other = {f"{HWMON}0/name": "cpu_thermal\n", f"{HWMON}0/in0_lcrit_alarm": "1\n"}
    alarm = f"{HWMON}1/in0_lcrit_alarm"
    watch = ThermalWatch(tree(PI | more | other | {f"{HWMON}1/name": "rpi_volt\n", alarm: "0\n"}))
    assert watch.read().under_voltage is False
    tree({alarm: "1\n"})
    assert watch.read().under_voltage is True
    tree({alarm: "what\n"})
    assert watch.read().under_voltage is (False if more else None)


@pytest.mark.parametrize(("hot_c", "hot"), [(None, False), (70.0, True), (76.0, False)])
def test_thermal_watch_is_hot_at_the_temperature_of_the_profile(tree, hot_c, hot):
    assert ThermalWatch(tree(PI | {f"{ZONE}0/temp": "75000\n"}), hot_c).read().hot is hot


def write_trips(**points):
    return {
        f"{ZONE}0/trip_point_{n}_{what}": f"{value}\n"
        for n, (kind, millidegrees) in enumerate(points.items())
        for what, value in (("type", kind.rstrip("0123456789")), ("temp", millidegrees))
    }


@pytest.mark.parametrize(
    ("points", "expected_c"),
    [
        ({"passive1": 95_000, "passive2": 70_000, "critical": 105_000}, 70.0),
        ({"critical": 110_000}, 80.0),
        ({"critical": 75_000}, 65.0),
        ({"passive": -274_000, "critical": 0}, 80.0),
        ({}, 80.0),
    ],
)
def test_thermal_limit_is_the_first_trip_point_of_the_kernel(tree, points, expected_c):
    assert read_limit_c(tree({f"{ZONE}0/type": "x86_pkg_temp\n"} | write_trips(**points))) == expected_c
