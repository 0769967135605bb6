"""Temperature, frequency and throttling from trees that stand for /sys."""

import pytest

from edgevpr.power.thermal import ThermalState, ThermalWatch, limit_c

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


def state(temperature_c, frequency_mhz, throttled, why="", **more):
    return ThermalState(temperature_c=temperature_c, frequency_mhz=frequency_mhz, throttled=throttled, why=why, **more)


def test_a_cool_board_that_idles_is_not_throttled(tree):
    assert ThermalWatch(tree(PI)).look() == state(48.312, 600.0, False, hot=False)


def test_the_hottest_sensor_of_the_cpu_counts_and_no_other(tree):
    zones = {
        f"{ZONE}1/type": "wifi-thermal\n",
        f"{ZONE}1/temp": "90000\n",
        f"{ZONE}2/type": "soc0-thermal\n",
        f"{ZONE}2/temp": "51000\n",
    }
    assert ThermalWatch(tree(PI | zones)).look().temperature_c == 51.0


def test_a_machine_that_says_nothing_is_unknown(tmp_path):
    assert ThermalWatch(tmp_path).look() == state(None, None, None)


@pytest.mark.parametrize("nonsense", ["", "hot\n", "999999999\n", "-300000\n", "nan\n", "\udcff"])
def test_a_sensor_that_says_nonsense_is_none(tree, nonsense):
    root = tree(PI)
    (root / f"{ZONE}0/temp").write_bytes(nonsense.encode(errors="surrogateescape"))
    (root / f"{POLICY}/scaling_cur_freq").write_bytes(b"-1\n")
    assert ThermalWatch(root).look() == state(None, None, False)


def test_sensors_that_go_do_not_raise(tree):
    root = tree(PI)
    watch = ThermalWatch(root)
    for name in PI:
        (root / name).unlink()
    assert watch.look() == state(None, None, False)


def test_a_frequency_limit_that_sinks_is_throttling(tree):
    root = tree(PI)
    watch = ThermalWatch(root)
    assert watch.look().throttled is False
    tree({f"{POLICY}/scaling_max_freq": "1200000\n"})
    seen = watch.look()
    assert (seen.throttled, seen.why) == (True, "frequency limited to 1200 of 1800 MHz")
    tree({f"{POLICY}/scaling_max_freq": "1800000\n"})
    assert watch.look().throttled is False


def test_a_power_mode_that_holds_the_frequency_low_is_not(tree):
    watch = ThermalWatch(tree(PI | {f"{POLICY}/scaling_max_freq": "1000000\n"}))
    assert watch.look().throttled is False


def test_a_hot_machine_that_runs_slowly_is_throttled(tree):
    seen = ThermalWatch(tree(PI | {f"{ZONE}0/temp": "82500\n"})).look()
    assert (seen.throttled, seen.why) == (True, "600 of 1800 MHz at 82.5 degrees")


def test_the_fastest_of_two_clusters_is_looked_at(tree):
    big = f"{CPU}/cpufreq/policy4"
    files = {f"{big}/cpuinfo_max_freq": "2400000", f"{big}/scaling_cur_freq": "2300000"}
    assert ThermalWatch(tree(PI | files)).look().frequency_mhz == 2300.0


@pytest.mark.parametrize(
    ("answer", "throttled", "why", "under_voltage", "hot"),
    [
        ("0\n", False, "", False, False),
        ("4\n", True, "throttled now", False, False),
        ("a\n", True, "frequency capped, soft temperature limit now", False, True),
        ("1\n", False, "under-voltage now", True, False),
        ("50000\n", False, "under-voltage, throttled since start", False, False),
        ("50005\n", True, "under-voltage, throttled now", True, False),
        ("50004\n", True, "throttled now; under-voltage since start", False, False),
        ("what\n", False, "", None, False),
    ],
)
def test_the_firmware_says_what_slows_it_down(tree, answer, throttled, why, under_voltage, hot):
    expected = state(48.312, 600.0, throttled, why=why, under_voltage=under_voltage, hot=hot)
    assert ThermalWatch(tree(PI | {FIRMWARE: answer})).look() == expected


def test_an_under_voltage_between_two_readings_is_seen_once(tree):
    watch = ThermalWatch(tree(PI | {FIRMWARE: "0\n"}))
    seen = []
    for answer in ("0\n", "10000\n", "10000\n", "50000\n"):
        tree({FIRMWARE: answer})
        seen.append(watch.look().under_voltage)
    assert seen == [False, True, False, False]


@pytest.mark.parametrize("more", [{}, {FIRMWARE: "0\n"}])
def test_the_alarm_of_the_driver_is_an_under_voltage(tree, more):
    other = {f"{HWMON}0/name": "cpu_thermal\n", f"{HWMON}0/in0_lcrit_alarm": "1\n"}
    alarm = f"{HWMON}1/in0_lcrit_alarm"
    watch = ThermalWatch(tree(PI | more | other | {f"{HWMON}1/name": "rpi_volt\n", alarm: "0\n"}))
    assert watch.look().under_voltage is False
    tree({alarm: "1\n"})
    assert watch.look().under_voltage is True
    tree({alarm: "what\n"})
    assert watch.look().under_voltage is (False if more else None)


@pytest.mark.parametrize(("hot_c", "hot"), [(None, False), (70.0, True), (76.0, False)])
def test_hot_is_the_temperature_of_the_boards_profile(tree, hot_c, hot):
    assert ThermalWatch(tree(PI | {f"{ZONE}0/temp": "75000\n"}), hot_c).look().hot is hot


def trips(**points):
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
        ({"active": 50_000}, 80.0),
        ({"passive": -274_000, "critical": 0}, 80.0),
        ({}, 80.0),
    ],
)
def test_the_limit_is_the_first_point_where_the_kernel_slows_down(tree, points, expected_c):
    assert limit_c(tree({f"{ZONE}0/type": "x86_pkg_temp\n"} | trips(**points))) == expected_c
