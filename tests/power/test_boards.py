"""Profiles of boards: those that come with edgevpr, the user's own, and the machine itself, from trees that stand for
it; and the profile that is written for one that has none."""

import os

import pytest

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import shipped
from edgevpr.power.boards import MachineSpeed, board_names, detect, load_board, own_profile, profile_text

PROFILE = (shipped("profiles") / "rpi-4b.yaml").read_text()
SPEED = MachineSpeed(single=0.21, multi=0.8, products=0.11, passes=0.4, verified=True, source="a benchmark")


def changed_profile(tmp_path, **changes):
    """The path of a copy of the Pi 4's profile with some lines changed; None leaves a line out."""
    lines = [line for line in PROFILE.splitlines() if line.split(":")[0] not in changes]
    # At the end stands a section, which an indented line belongs to: what is not indented goes before it.
    more = [f"{key}: {value}" for key, value in changes.items() if value is not None]
    lines = [line for line in more if line[0] != " "] + lines + [line for line in more if line[0] == " "]
    path = tmp_path / "mine.yaml"
    path.write_text("\n".join(lines))
    return str(path)


def machine(tree, model=None, parts=(), ram_kb=4_000_000, cpuinfo="", **limits):
    """A root with the memory, the device tree, the kinds of Arm cores and the control group limits of some machine."""
    cpuinfo += "".join(f"processor\t: {n}\nCPU part\t: {part}\n\n" for n, part in enumerate(parts))
    files = {"proc/meminfo": f"MemTotal: {ram_kb} kB\n", "proc/self/cgroup": "0::/\n", "proc/cpuinfo": cpuinfo}
    files |= {f"sys/fs/cgroup/{name.replace('_', '.')}": text for name, text in limits.items()}
    files |= {"sys/devices/system/cpu/online": f"0-{len(parts) - 1}\n"} if parts else {}
    return tree(files | ({"proc/device-tree/model": model + "\0"} if model else {}))


def written(root):
    """The profile that is written for a machine, as it is read back."""
    path = root / "written.yaml"
    path.write_text(profile_text(own_profile(SPEED, root)), encoding="utf-8")
    return load_board(str(path), root)


@pytest.mark.parametrize("name", board_names())
def test_load_board_gives_a_whole_profile_with_its_sources(name):
    board = load_board(name)
    assert board.name == name
    assert board.source
    assert board.benchmark_score.source
    assert board.benchmark_score.single or not board.benchmark_score.verified
    assert board.technique == "cohog"
    assert 1 <= board.threads <= max(1, round(board.cores * board.cpu_share)), "as many as cores are spared"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"full_w": 1.5}, "`full_w` is 1.5, below `idle_w`, 2.29: correct one of them."),
        ({"wats": 3}, "unknown key `wats`"),
        ({"source": None}, "the key `source` is missing: add it."),
        ({"  single": 0}, "`benchmark_score.single` is 0; it must be between 0.0001 and 100."),
        (
            {"budget_mb": 600},
            "`budget_mb` (600) must fit in `memory_max_mb` (512), and that in `ram_mb` (1024): correct them.",
        ),
    ],
)
def test_load_board_refuses_a_wrong_profile_in_one_sentence(tmp_path, changes, sentence):
    path = changed_profile(tmp_path, **changes)
    with pytest.raises(ConfigError) as raised:
        load_board(path)
    assert str(raised.value).startswith(f"{path}: {sentence}")


def test_load_board_refuses_a_board_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="`rpi-4b`"):
        load_board("rpi4b")
    with pytest.raises(ConfigError, match="generic-x86"):
        load_board("quantum")
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        load_board(str(tmp_path / "none.yaml"))


def test_load_board_recognises_this_machine_by_its_device_tree(tree):
    root = machine(tree, "Raspberry Pi 4 Model B Rev 1.4", ram_kb=8_000_000)
    board, profile = load_board("this", root), load_board("rpi-4b")
    assert board.name == "rpi-4b"
    assert board.title == "this machine (Raspberry Pi 4B, 64-bit)"
    assert (board.idle_w, board.full_w, board.benchmark_score.single) == (profile.idle_w, profile.full_w, 0.38)
    assert board.ram_mb == 8192.0
    assert (board.budget_mb, board.memory_max_mb) == (2048.0, 4096.0)  # a quarter and half, as in the profile
    assert board.cores == os.cpu_count()


def test_load_board_takes_a_machine_without_a_device_tree_as_any_x86(tree):
    board = load_board("this", machine(tree))
    assert (board.name, board.verified) == ("generic-x86", False)
    score = board.benchmark_score
    assert (score.single, score.products, score.passes, score.verified) == (1.0, 1.0, 1.0, False)


def test_load_board_obeys_control_groups(tree):
    root = machine(tree, "Raspberry Pi 4 Model B", memory_max="400000000\n", cpu_max="20000 100000\n")
    board = load_board("this", root)
    assert board.ram_mb == 4096.0
    assert (board.memory_max_mb, board.budget_mb) == (400.0, 200.0)
    assert board.cores == os.cpu_count()
    assert board.cores * board.cpu_share == pytest.approx(0.2)
    assert board.threads == 1


def test_load_board_does_not_subtract_the_limits_of_the_service_twice(tree):
    model = "Raspberry Pi 4 Model B"
    free = load_board("this", machine(tree, model))
    quota = f"{round(100_000 * free.cpu_share * free.cores)} 100000\n"
    memory_max = f"{round(free.memory_max_mb * 1e6)}\n"
    assert load_board("this", machine(tree, model, memory_max=memory_max, cpu_max=quota)) == free


def test_load_board_reads_where_this_machine_begins_to_slow_down(tree):
    assert load_board("this", machine(tree, "Raspberry Pi 3 Model B Plus Rev 1.3")).thermal_limit_c == 60
    zone = {"type": "CPU-therm\n", "trip_point_0_type": "passive\n", "trip_point_0_temp": "97000\n"}
    tree({f"sys/class/thermal/thermal_zone0/{name}": text for name, text in zone.items()})
    assert load_board("this", machine(tree, "NVIDIA Jetson Nano Developer Kit")).thermal_limit_c == 97


@pytest.mark.parametrize(
    ("model", "parts", "ram_kb", "board", "cpu"),
    [
        ("Raspberry Pi 5 Model B Rev 1.0", ["0xd0b"] * 4, 8_000_000, "rpi-5", "4 x Cortex-A76"),
        (
            "Hardkernel Odroid XU4", ["0xc07"] * 4 + ["0xc0f"] * 4, 2_000_000, "odroid-xu4",
            "4 x Cortex-A7 + 4 x Cortex-A15",
        ),
    ],
)  # fmt: skip
def test_own_profile_of_a_known_board_has_what_is_really_there(tree, model, parts, ram_kb, board, cpu):
    root = machine(tree, model, parts, ram_kb)
    found = detect(root)
    assert (found["board"], found["model"], found["cpu"], found["cores"]) == (board, model, cpu, len(parts))
    assert found["usable_cores"] == min(len(parts), len(os.sched_getaffinity(0)))
    mine, profile = written(root), load_board(board)
    assert (mine.idle_w, mine.full_w, mine.verified) == (profile.idle_w, profile.full_w, profile.verified)
    assert (mine.source, mine.benchmark_score) == (profile.source, SPEED)
    assert mine.ram_mb == pytest.approx(ram_kb * 1.024e-3, rel=0.001)
    assert mine.memory_max_mb == pytest.approx(mine.ram_mb * profile.memory_max_mb / profile.ram_mb, rel=0.01)


def test_own_profile_of_an_unknown_board_invents_nothing(tree):
    root = machine(tree, "Radxa ROCK 5B", ["0xd05"] * 4 + ["0xd0b"] * 4, 16_000_000)
    found, here = detect(root), load_board("this", root)
    assert (found["board"], found["cpu"], found["thermal_limit_c"]) == (None, "4 x Cortex-A55 + 4 x Cortex-A76", 80.0)
    assert here.benchmark_score.single is None
    assert "Radxa ROCK 5B" in here.benchmark_score.source
    assert "Radxa ROCK 5B" in here.title
    board = written(root)
    assert board.title == "Radxa ROCK 5B (4 x Cortex-A55 + 4 x Cortex-A76)"
    assert (board.recognised_by, board.cores, board.ram_mb) == ("Radxa ROCK 5B", 8, 16384.0)
    assert (board.idle_w, board.full_w, board.verified) == (0.0, 1.0, False)
    assert board.source.startswith("relative figures")
    assert board.technique == "cohog"


def test_detect_names_an_x86_machine_by_its_firmware(tree):
    root = machine(tree, cpuinfo="processor\t: 0\nmodel name\t: Intel(R) N100\nflags\t: sse\n" * 4)
    assert detect(root)["model"] is None
    tree({"sys/class/dmi/id/sys_vendor": "AAEON\n", "sys/class/dmi/id/product_name": "UP-APL03\n"})
    found, board = detect(root), written(root)
    assert (found["board"], found["model"], found["cpu"]) == (None, "AAEON UP-APL03", "Intel(R) N100")
    assert (board.title, board.recognised_by) == ("AAEON UP-APL03 (Intel(R) N100)", None)


@pytest.mark.parametrize("model", ['Board: "X" #1', "- [a, {b", "Bård ÅÄ\x07\x85 ½", "null", "'", "\\n %YAML"])
def test_profile_text_can_be_read_whatever_a_board_calls_itself(tree, model):
    assert written(machine(tree, model, ["0xd03"])).recognised_by == model
