"""Which machine this is, from trees that stand for it, and the profile that is written for one that has none."""

import os

import pytest

from edgevpr.power.boards import MachineSpeed, detect, load_board, own_profile, profile_text

DMI = "sys/class/dmi/id"
USABLE = len(os.sched_getaffinity(0))


def machine(ram_kb=4_000_000, cores=4, **more):
    online = "sys/devices/system/cpu/online"
    return {"proc/meminfo": f"MemTotal: {ram_kb} kB\n", online: f"0-{cores - 1}\n", "proc/self/cgroup": "0::/\n"} | more


def arm(model, *parts, **options):
    cpuinfo = "".join(
        f"processor\t: {n}\nCPU implementer\t: 0x41\nCPU part\t: {part}\n\n" for n, part in enumerate(parts)
    )
    tree = {"proc/device-tree/model": model + "\0", "proc/cpuinfo": cpuinfo}
    return machine(cores=len(parts), **options) | tree


def x86(**dmi):
    cpuinfo = "processor\t: 0\nmodel name\t: Intel(R) N100\nflags\t: sse\n" * 4
    return machine() | {"proc/cpuinfo": cpuinfo} | {f"{DMI}/{name}": text + "\n" for name, text in dmi.items()}


SPEED = MachineSpeed(single=0.21, multi=0.8, products=0.11, passes=0.4, verified=True, source="a benchmark")


def written(root):
    """The profile that is written for a machine, as it is read back."""
    path = root / "written.yaml"
    path.write_text(profile_text(own_profile(SPEED, root)), encoding="utf-8")
    return load_board(str(path), root)


@pytest.mark.parametrize(
    ("model", "parts", "ram_kb", "board", "cpu"),
    [
        ("Raspberry Pi Zero 2 W Rev 1.0", ["0xd03"] * 4, 430_000, "rpi-zero-2w", "4 x Cortex-A53"),
        ("Raspberry Pi 5 Model B Rev 1.0", ["0xd0b"] * 4, 8_000_000, "rpi-5", "4 x Cortex-A76"),
        (
            "NVIDIA Jetson Orin Nano Developer Kit", ["0xd42"] * 6, 7_600_000, "jetson-orin-nano", "6 x Cortex-A78AE",
        ),
        ("Hardkernel Odroid XU4", ["0xc07"] * 4 + ["0xc0f"] * 4, 2_000_000, "odroid-xu4",
         "4 x Cortex-A7 + 4 x Cortex-A15"),
    ],
)  # fmt: skip
def test_a_known_board_is_recognised_and_its_profile_has_what_is_really_there(tree, model, parts, ram_kb, board, cpu):
    root = tree(arm(model, *parts, ram_kb=ram_kb))
    found = detect(root)
    assert (found["board"], found["model"], found["cpu"], found["cores"]) == (board, model, cpu, len(parts))
    assert found["usable_cores"] == min(len(parts), USABLE)
    mine, shipped = written(root), load_board(board)
    assert (mine.idle_w, mine.full_w, mine.verified) == (shipped.idle_w, shipped.full_w, shipped.verified)
    assert (mine.source, mine.benchmark_score) == (shipped.source, SPEED)
    assert mine.ram_mb == pytest.approx(ram_kb * 1.024e-3, rel=0.001)
    assert mine.memory_max_mb == pytest.approx(mine.ram_mb * shipped.memory_max_mb / shipped.ram_mb, rel=0.01)


def test_an_unknown_arm_board_gets_a_profile_that_invents_nothing(tree):
    root = tree(
        arm("Radxa ROCK 5B", *["0xd05"] * 4, *["0xd0b"] * 4, ram_kb=16_000_000)
        | {
            "sys/class/thermal/thermal_zone0/type": "bigcore0-thermal\n",
            "sys/class/thermal/thermal_zone0/trip_point_0_type": "passive\n",
            "sys/class/thermal/thermal_zone0/trip_point_0_temp": "85000\n",
        }
    )
    found = detect(root)
    assert (found["board"], found["cpu"], found["thermal_limit_c"]) == (None, "4 x Cortex-A55 + 4 x Cortex-A76", 85.0)
    board = written(root)
    assert board.title == "Radxa ROCK 5B (4 x Cortex-A55 + 4 x Cortex-A76)"
    assert (board.recognised_by, board.cores, board.ram_mb) == ("Radxa ROCK 5B", 8, 16384.0)
    assert (board.idle_w, board.full_w, board.verified) == (0.0, 1.0, False)
    assert board.source.startswith("relative figures")
    assert (board.thermal_limit_c, board.technique) == (85.0, "cohog")


def test_an_x86_machine_is_named_by_its_firmware(tree):
    root = tree(x86(sys_vendor="AAEON", product_name="UP-APL03", board_name="UP-APL03"))
    found = detect(root)
    assert (found["board"], found["model"], found["cpu"]) == (None, "AAEON UP-APL03", "Intel(R) N100")
    assert found["thermal_limit_c"] == 80.0
    board = written(root)
    assert (board.title, board.recognised_by) == ("AAEON UP-APL03 (Intel(R) N100)", None)
    assert detect(tree(x86(sys_vendor="", product_name="")))["model"] is None


@pytest.mark.parametrize("model", ['Board: "X" #1', "- [a, {b", "Bård ÅÄ\x07\x85 ½", "null", "'", "\\n %YAML"])
def test_whatever_a_board_calls_itself_the_file_can_be_read(tree, model):
    root = tree(arm(model, "0xd03"))
    assert written(root).recognised_by == model
