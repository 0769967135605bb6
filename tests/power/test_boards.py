"""Profiles of boards: those that travel with edgevpr, the user's own, and the machine itself, from trees that stand
for it; and the profile that is written for one that has none."""

import os

import pytest

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import shipped
from edgevpr.power.boards import MachineSpeed, board_names, detect, load_board, own_profile, profile_text

PROFILE = (shipped("profiles") / "rpi-4b.yaml").read_text()


def changed_profile(tmp_path, **changes):
    """The path of a copy of the Pi 4's profile with some lines changed; None leaves a line out."""
    lines = [line for line in PROFILE.splitlines() if line.split(":")[0] not in changes]
    # At the end stands a section, which an indented line belongs to: what is not indented goes before it.
    more = [f"{key}: {value}" for key, value in changes.items() if value is not None]
    lines = [line for line in more if line[0] != " "] + lines + [line for line in more if line[0] == " "]
    path = tmp_path / "mine.yaml"
    path.write_text("\n".join(lines))
    return str(path)


def this_machine(tree, model=None, ram_kb=4_000_000, **limits):
    """A root with the memory, the device tree and the control group limits of some machine."""
    files = {"proc/meminfo": f"MemTotal: {ram_kb} kB\n", "proc/self/cgroup": "0::/\n"}
    files |= {f"sys/fs/cgroup/{name.replace('_', '.')}": text for name, text in limits.items()}
    return tree(files | ({"proc/device-tree/model": model + "\0"} if model else {}))


@pytest.mark.parametrize("name", board_names())
def test_a_profile_that_travels_is_whole_and_says_where_its_figures_are_from(name):
    board = load_board(name)
    assert board.name == name
    assert board.source
    assert board.benchmark_score.source
    assert board.benchmark_score.single or not board.benchmark_score.verified
    assert board.technique == "cohog"


def test_a_profile_of_ones_own_is_named_by_its_path(tmp_path):
    board = load_board(changed_profile(tmp_path, full_w=7.5))
    assert (board.name, board.full_w) == ("mine", 7.5)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"full_w": 1.5}, "`full_w` is 1.5, below `idle_w`, 2.29: correct one of them."),
        ({"idle_w": -1}, "`idle_w` is -1; it must be between 0 and 1000."),
        ({"wats": 3}, "unknown key `wats`"),
        ({"source": None}, "the key `source` is missing: add it."),
        ({"  single": 0}, "`benchmark_score.single` is 0; it must be between 0.0001 and 100."),
        (
            {"budget_mb": 600},
            "`budget_mb` (600) must fit in `memory_max_mb` (512), and that in `ram_mb` (1024): correct them.",
        ),
        (
            {"memory_max_mb": 2000},
            "`budget_mb` (256) must fit in `memory_max_mb` (2000), and that in `ram_mb` (1024): correct them.",
        ),
    ],
)
def test_a_profile_that_makes_no_sense_is_one_sentence(tmp_path, changes, sentence):
    path = changed_profile(tmp_path, **changes)
    with pytest.raises(ConfigError) as raised:
        load_board(path)
    assert str(raised.value).startswith(f"{path}: {sentence}")


def test_a_board_that_is_not_there_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="`rpi-4b`"):
        load_board("rpi4b")
    with pytest.raises(ConfigError, match="generic-x86"):
        load_board("quantum")
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        load_board(str(tmp_path / "none.yaml"))


def test_this_machine_is_recognised_by_its_device_tree(tree):
    root = this_machine(tree, model="Raspberry Pi 4 Model B Rev 1.4", ram_kb=8_000_000)
    board, profile = load_board("this", root), load_board("rpi-4b")
    assert board.name == "rpi-4b"
    assert board.title == "this machine (Raspberry Pi 4B, 64-bit)"
    assert (board.idle_w, board.full_w, board.benchmark_score.single) == (profile.idle_w, profile.full_w, 0.38)
    assert board.ram_mb == 8192.0
    assert (board.budget_mb, board.memory_max_mb) == (2048.0, 4096.0)  # a quarter and half, as in the profile
    assert board.cores == os.cpu_count()


def test_a_machine_without_a_device_tree_is_any_x86(tree):
    board = load_board("this", this_machine(tree))
    assert (board.name, board.verified) == ("generic-x86", False)
    score = board.benchmark_score
    assert (score.single, score.products, score.passes, score.verified) == (1.0, 1.0, 1.0, False)


def test_a_board_nobody_has_profiled_has_no_known_speed(tree):
    board = load_board("this", this_machine(tree, "Radxa ZERO 3"))
    assert board.benchmark_score.single is None
    assert "Radxa ZERO 3" in board.benchmark_score.source
    assert "Radxa ZERO 3" in board.title
    assert not board.verified


def test_a_control_group_lowers_what_edgevpr_may_take_but_not_what_the_machine_is(tree):
    root = this_machine(tree, "Raspberry Pi 4 Model B", memory_max="400000000\n", cpu_max="20000 100000\n")
    board = load_board("this", root)
    assert board.ram_mb == 4096.0
    assert (board.memory_max_mb, board.budget_mb) == (400.0, 200.0)
    assert board.cores == os.cpu_count()
    assert board.cores * board.cpu_share == pytest.approx(0.2)


def test_a_network_gets_no_more_threads_than_the_board_spares_cores(tree, tmp_path):
    assert [load_board(name).threads for name in ("rpi-zero-2w", "rpi-4b", "jetson-orin-nano")] == [1, 2, 3]
    for name in board_names():
        board = load_board(name)
        assert 1 <= board.threads <= max(1, round(board.cores * board.cpu_share))
    assert load_board(changed_profile(tmp_path, threads=None)).threads == 1
    root = this_machine(tree, "Raspberry Pi 4 Model B", cpu_max="20000 100000\n")
    assert load_board("this", root).threads == 1


def test_the_services_own_limits_are_not_taken_off_twice(tree):
    model = "Raspberry Pi 4 Model B"
    free = load_board("this", this_machine(tree, model))
    quota = f"{round(100_000 * free.cpu_share * free.cores)} 100000\n"
    memory_max = f"{round(free.memory_max_mb * 1e6)}\n"
    served = load_board("this", this_machine(tree, model, memory_max=memory_max, cpu_max=quota))
    assert served == free


def test_this_machine_knows_where_it_begins_to_slow_down(tree):
    assert load_board("this", this_machine(tree, "Raspberry Pi 3 Model B Plus Rev 1.3")).thermal_limit_c == 60
    zone = {"type": "CPU-therm\n", "trip_point_0_type": "passive\n", "trip_point_0_temp": "97000\n"}
    tree({f"sys/class/thermal/thermal_zone0/{name}": text for name, text in zone.items()})
    root = this_machine(tree, "NVIDIA Jetson Nano Developer Kit")
    assert load_board("this", root).thermal_limit_c == 97


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
