"""Profiles of boards: those that travel with edgevpr, the user's own, and the machine itself."""

import os

import pytest

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import shipped
from edgevpr.power.boards import board_names, load_board

PROFILE = (shipped("profiles") / "rpi-4b.yaml").read_text()


def own_profile(tmp_path, **changes):
    """The path of a copy of the Pi 4's profile with some lines changed; None leaves a line out."""
    lines = [line for line in PROFILE.splitlines() if line.split(":")[0] not in changes]
    # At the end stands a section, which an indented line belongs to: what is not indented goes before it.
    more = [f"{key}: {value}" for key, value in changes.items() if value is not None]
    lines = [line for line in more if line[0] != " "] + lines + [line for line in more if line[0] == " "]
    path = tmp_path / "mine.yaml"
    path.write_text("\n".join(lines))
    return str(path)


def this_root(tmp_path, model=None, ram_kb=4_000_000, **limits):
    """A root with the memory, the device tree and the control group limits of some machine."""
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text(f"MemTotal: {ram_kb} kB\n")
    (tmp_path / "proc/self/cgroup").write_text("0::/\n")
    (tmp_path / "sys/fs/cgroup").mkdir(parents=True)
    for name, text in limits.items():
        (tmp_path / "sys/fs/cgroup" / name.replace("_", ".")).write_text(text)
    if model:
        (tmp_path / "proc/device-tree").mkdir()
        (tmp_path / "proc/device-tree/model").write_text(model + "\0")
    return tmp_path


@pytest.mark.parametrize("name", board_names())
def test_a_profile_that_travels_is_whole_and_says_where_its_figures_are_from(name):
    board = load_board(name)
    assert board.name == name
    assert board.source
    assert board.benchmark_score.source
    assert board.benchmark_score.single or not board.benchmark_score.verified
    assert board.technique == "cohog"


def test_a_profile_of_ones_own_is_named_by_its_path(tmp_path):
    board = load_board(own_profile(tmp_path, full_w=7.5))
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
    path = own_profile(tmp_path, **changes)
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


def test_this_machine_is_recognised_by_its_device_tree(tmp_path):
    root = this_root(tmp_path, model="Raspberry Pi 4 Model B Rev 1.4", ram_kb=8_000_000)
    board, profile = load_board("this", root), load_board("rpi-4b")
    assert board.name == "rpi-4b"
    assert board.title == "this machine (Raspberry Pi 4B, 64-bit)"
    assert (board.idle_w, board.full_w, board.benchmark_score.single) == (profile.idle_w, profile.full_w, 0.38)
    assert board.ram_mb == 8192.0
    assert (board.budget_mb, board.memory_max_mb) == (2048.0, 4096.0)  # a quarter and half, as in the profile
    assert board.cores == os.cpu_count()


def test_a_machine_without_a_device_tree_is_any_x86(tmp_path):
    board = load_board("this", this_root(tmp_path))
    assert (board.name, board.verified) == ("generic-x86", False)
    score = board.benchmark_score
    assert (score.single, score.products, score.passes, score.verified) == (1.0, 1.0, 1.0, False)


def test_a_board_nobody_has_profiled_has_no_known_speed(tmp_path):
    board = load_board("this", this_root(tmp_path, "Radxa ZERO 3"))
    assert board.benchmark_score.single is None
    assert "Radxa ZERO 3" in board.benchmark_score.source
    assert "Radxa ZERO 3" in board.title
    assert not board.verified


def test_a_control_group_lowers_what_edgevpr_may_take_but_not_what_the_machine_is(tmp_path):
    root = this_root(tmp_path, "Raspberry Pi 4 Model B", memory_max="400000000\n", cpu_max="20000 100000\n")
    board = load_board("this", root)
    assert board.ram_mb == 4096.0
    assert (board.memory_max_mb, board.budget_mb) == (400.0, 200.0)
    assert board.cores == os.cpu_count()
    assert board.cores * board.cpu_share == pytest.approx(0.2)


def test_a_network_gets_no_more_threads_than_the_board_spares_cores(tmp_path):
    assert [load_board(name).threads for name in ("rpi-zero-2w", "rpi-4b", "jetson-orin-nano")] == [1, 2, 3]
    for name in board_names():
        board = load_board(name)
        assert 1 <= board.threads <= max(1, round(board.cores * board.cpu_share))
    assert load_board(own_profile(tmp_path, threads=None)).threads == 1
    root = this_root(tmp_path / "this", "Raspberry Pi 4 Model B", cpu_max="20000 100000\n")
    assert load_board("this", root).threads == 1


def test_the_services_own_limits_are_not_taken_off_twice(tmp_path):
    model = "Raspberry Pi 4 Model B"
    free = load_board("this", this_root(tmp_path / "free", model))
    quota = f"{round(100_000 * free.cpu_share * free.cores)} 100000\n"
    memory_max = f"{round(free.memory_max_mb * 1e6)}\n"
    served = load_board("this", this_root(tmp_path / "served", model, memory_max=memory_max, cpu_max=quota))
    assert served == free


def test_this_machine_knows_where_it_begins_to_slow_down(tmp_path):
    assert load_board("this", this_root(tmp_path / "pi", "Raspberry Pi 3 Model B Plus Rev 1.3")).thermal_limit_c == 60
    root = this_root(tmp_path / "nano", "NVIDIA Jetson Nano Developer Kit")
    zone = root / "sys/class/thermal/thermal_zone0"
    zone.mkdir(parents=True)
    for name, content in {"type": "CPU-therm", "trip_point_0_type": "passive", "trip_point_0_temp": "97000"}.items():
        (zone / name).write_text(content + "\n")
    assert load_board("this", root).thermal_limit_c == 97
