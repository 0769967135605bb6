"""Profiles of boards: those that come with edgevpr, the user's own, and this machine's, from simulated file trees."""

import os

import pytest

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import find_shipped
from edgevpr.power.boards import list_boards, load_board

PROFILE = (find_shipped("profiles") / "rpi-4b.yaml").read_text()


def write_profile(tmp_path, **changes):
    """The path of a copy of the Pi 4's profile with some lines changed; None leaves a line out."""
    lines = [line for line in PROFILE.splitlines() if line.split(":")[0] not in changes]
    # At the end stands a section, which an indented line belongs to: what is not indented goes before it.
    more = [f"{key}: {value}" for key, value in changes.items() if value is not None]
    lines = [line for line in more if line[0] != " "] + lines + [line for line in more if line[0] == " "]
    path = tmp_path / "mine.yaml"
    path.write_text("\n".join(lines))
    return str(path)


def write_machine(tree, model=None, ram_kb=4_000_000, **limits):
    """A root with the memory, the device tree and the control group limits of some machine."""
    files = {"proc/meminfo": f"MemTotal: {ram_kb} kB\n", "proc/self/cgroup": "0::/\n"}
    files |= {f"sys/fs/cgroup/{name.replace('_', '.')}": text for name, text in limits.items()}
    return tree(files | ({"proc/device-tree/model": model + "\0"} if model else {}))


@pytest.mark.parametrize("name", list_boards())
def test_load_board_gives_a_complete_profile_with_its_sources(name):
    board = load_board(name)
    assert board.name == name
    assert board.source
    assert board.benchmark_score.source
    assert board.benchmark_score.arm64_mips or not board.benchmark_score.verified
    assert 1 <= board.threads <= max(1, round(board.cores * board.cpu_share)), "as many as cores are spared"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"full_w": 1.5}, "`full_w` (1.5) is below `idle_w` (2.29)"),
        ({"wats": 3}, "unknown key `wats`"),
        ({"source": None}, "key `source` is missing"),
        ({"  arm64_mips": 0}, "`benchmark_score.arm64_mips` is 0,"),
        ({"budget_mb": 600}, "`budget_mb` (600) must fit in `memory_max_mb` (512)"),
    ],
)
def test_load_board_refuses_a_wrong_profile_in_one_sentence(tmp_path, changes, sentence):
    path = write_profile(tmp_path, **changes)
    with pytest.raises(ConfigError) as raised:
        load_board(path)
    assert str(raised.value).startswith(f"{path}: {sentence}")


def test_load_board_recognises_this_machine_by_its_device_tree(tree):
    root = write_machine(tree, "Raspberry Pi 4 Model B Rev 1.4", ram_kb=8_000_000)
    board, profile = load_board("this", root), load_board("rpi-4b")
    assert board.name == "rpi-4b"
    assert board.title == "this machine (Raspberry Pi 4B, 64-bit)"
    assert (board.idle_w, board.full_w, board.benchmark_score.arm64_mips) == (profile.idle_w, profile.full_w, 1741)
    assert board.ram_mb == 8192.0
    assert (board.budget_mb, board.memory_max_mb) == (2048.0, 4096.0)  # a quarter and half, as in the profile
    assert board.cores == os.cpu_count()


def test_load_board_obeys_control_groups(tree):
    root = write_machine(tree, "Raspberry Pi 4 Model B", memory_max="400000000\n", cpu_max="20000 100000\n")
    board = load_board("this", root)
    assert board.ram_mb == 4096.0
    assert (board.memory_max_mb, board.budget_mb) == (400.0, 200.0)
    assert board.cores == os.cpu_count()
    assert board.cores * board.cpu_share == pytest.approx(0.2)
    assert board.threads == 1


def test_load_board_does_not_subtract_the_limits_of_the_service_twice(tree):
    model = "Raspberry Pi 4 Model B"
    free = load_board("this", write_machine(tree, model))
    quota = f"{round(100_000 * free.cpu_share * free.cores)} 100000\n"
    memory_max = f"{round(free.memory_max_mb * 1e6)}\n"
    assert load_board("this", write_machine(tree, model, memory_max=memory_max, cpu_max=quota)) == free


def test_load_board_reads_the_throttling_temperature_of_this_machine(tree):
    assert load_board("this", write_machine(tree, "Raspberry Pi 3 Model B Plus Rev 1.3")).thermal_limit_c == 60
    zone = {"type": "CPU-therm\n", "trip_point_0_type": "passive\n", "trip_point_0_temp": "97000\n"}
    tree({f"sys/class/thermal/thermal_zone0/{name}": text for name, text in zone.items()})
    assert load_board("this", write_machine(tree, "NVIDIA Jetson Nano Developer Kit")).thermal_limit_c == 97


def test_load_board_names_the_origin_of_the_figures_of_an_unknown_board(tree):
    board = load_board("this", write_machine(tree, "Radxa ROCK 5B", ram_kb=16_000_000))
    assert (board.name, board.idle_w, board.full_w, board.verified) == ("generic-x86", 0.0, 1.0, False)
    assert "Radxa ROCK 5B" in board.title
    assert (board.ram_mb, board.thermal_limit_c) == (16384.0, 80.0)


def test_is_this_machine_matches_the_text_of_a_custom_profile(tree, tmp_path):
    mine = load_board(write_profile(tmp_path, recognised_by="ROCK 5"))
    assert mine.is_this_machine(write_machine(tree, "Radxa ROCK 5B"))
    assert not load_board("rpi-4b").is_this_machine(write_machine(tree, "Radxa ROCK 5B"))
    assert load_board("rpi-4b").is_this_machine(write_machine(tree, "Raspberry Pi 4 Model B Rev 1.4"))
    by_firmware = load_board(write_profile(tmp_path, recognised_by="UP-APL03"))
    root = tree({"sys/class/dmi/id/sys_vendor": "AAEON\n", "sys/class/dmi/id/product_name": "UP-APL03\n"})
    (root / "proc/device-tree/model").unlink()
    assert by_firmware.is_this_machine(root)
    assert not load_board("rpi-4b").is_this_machine(root)
