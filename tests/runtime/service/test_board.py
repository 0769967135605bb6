"""What `edgevpr doctor` says of a machine, on trees of files that stand for /proc, /sys and /dev."""

import grp
import os
import shutil
import sys
from pathlib import Path

import pytest

from edgevpr.core.config import Config, load_config
from edgevpr.mavlink.address import parse_link
from edgevpr.runtime.service.board import board_findings, bytecode, device, python


@pytest.fixture
def root(tmp_path) -> Path:
    """The root of a machine with cgroup v2 and 512 MB."""
    for name, text in {
        "proc/meminfo": "MemTotal: 500000 kB\n",
        "proc/self/cgroup": "0::/\n",
        "proc/cmdline": "root=/dev/sda1",
        "sys/fs/cgroup/cgroup.controllers": "cpu memory",
    }.items():
        path = tmp_path / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "root" / "dev").mkdir()
    return tmp_path / "root"


def config(tmp_path, **keys) -> Config:
    return load_config(None, {"log.path": str(tmp_path / "flight.jsonl"), "board": "rpi-zero-2w", **keys})


def found(configuration: Config, root: Path, link: str = "udpin:127.0.0.1:14550") -> dict:
    return {each.what: each for each in board_findings(configuration, parse_link(link), root)}


def test_a_board_that_is_fine(root, tmp_path):
    findings = found(config(tmp_path), root)
    assert list(findings) == ["python", "bytecode", "memory", "cores", "log"]
    assert all(each.ok for each in findings.values() if each.what != "bytecode")
    assert findings["memory"].message == "512 of 512 MB for this process"
    assert list(tmp_path.iterdir()) == [root]


def test_the_limits_of_control_groups_are_told(root, tmp_path):
    service = root / "sys/fs/cgroup/system.slice/edgevpr.service"
    service.mkdir(parents=True)
    (service / "memory.max").write_text("256000000\n")
    (service / "cpu.max").write_text("100000 100000\n")
    (root / "proc/self/cgroup").write_text("0::/user.slice\n")
    (root / "sys/fs/cgroup/user.slice").mkdir()
    (root / "sys/fs/cgroup/user.slice/memory.max").write_text("128000000\n")
    findings = found(config(tmp_path), root)
    assert not findings["memory"].ok
    assert findings["memory"].changes == ("MemoryMax=256000000",)
    assert findings["memory"].message.startswith("128 of 512 MB for this process; the service has memory.max 256000000")
    (root / "sys/fs/cgroup/user.slice/memory.max").write_text("300000000\n")
    findings = found(config(tmp_path), root)
    assert findings["memory"].message == "300 of 512 MB for this process; the service has memory.max 256000000"
    assert findings["cores"].message.endswith("the service has cpu.max 100000 100000")


def test_a_kernel_without_the_memory_controller_is_wrong(root, tmp_path):
    (root / "sys/fs/cgroup/cgroup.controllers").write_text("cpu io")
    memory = found(config(tmp_path), root)["memory"]
    assert (memory.ok, memory.changes) == (
        False,
        ("cgroup_enable=memory in /boot/firmware/cmdline.txt, and reboot",),
    )


@pytest.mark.parametrize(
    ("version", "is_64_bit", "ok"),
    [
        ((3, 10), True, True),
        ((3, 13), True, True),
        ((3, 9), True, False),
        ((3, 14), True, False),
        ((3, 11), False, False),
    ],
)
def test_python_is_judged_by_version_and_bits(version, is_64_bit, ok):
    assert python(version, is_64_bit).ok == ok


def test_what_is_compiled_or_can_be_is_fine(tmp_path):
    source = tmp_path / "site-packages" / "big.py"
    source.parent.mkdir()
    source.write_text("")
    assert bytecode([source]).ok


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_what_nobody_compiles_is_wrong(tmp_path):
    source = tmp_path / "site-packages" / "big" / "big.py"
    source.parent.mkdir(parents=True)
    source.write_text("")
    source.parent.chmod(0o500)
    finding = bytecode([source])
    assert not finding.ok
    assert finding.changes == (f"sudo {sys.executable} -m compileall -q {tmp_path / 'site-packages'}",)


def test_a_device_is_looked_at(root, tmp_path):
    controller, port = os.openpty()
    name = os.ttyname(port)
    good = device("serial", name)
    assert (good.ok, good.message.startswith(f"{name}, group ")) == (True, True)
    assert found(config(tmp_path, **{"source.uri": name}), Path("/"), f"serial:{name}:57600")["camera"].ok
    os.close(controller)
    os.close(port)


def test_the_console_of_the_kernel_is_no_place_for_a_link(root):
    (root / "dev/ttyAMA0").symlink_to("/dev/null")
    assert device("serial", "/dev/ttyAMA0", root).ok
    (root / "proc/cmdline").write_text("console=ttyAMA0,115200 console=tty1")
    finding = device("serial", "/dev/ttyAMA0", root)
    assert (finding.ok, "console of the kernel" in finding.message) == (False, True)
    assert finding.changes[0].startswith("remove console=ttyAMA0 from the kernel's command line")


def test_a_device_that_is_absent_or_none_is_wrong(root, tmp_path):
    absent = found(config(tmp_path, **{"source.uri": "/dev/video99"}), root, "serial:/dev/ttyACM99:57600")
    assert absent["serial"].message == "/dev/ttyACM99: No such file or directory: connect it, or correct the name."
    assert not absent["camera"].ok
    (root / "dev/ttyS0").touch()
    assert device("serial", "/dev/ttyS0", root).message == "/dev/ttyS0 is no device: correct the name."


@pytest.mark.skipif(os.getuid() == 0, reason="root may open everything")
def test_a_device_that_may_not_be_used_names_its_group():
    controller, port = os.openpty()
    os.chmod(os.ttyname(port), 0)
    finding = device("serial", os.ttyname(port))
    group = grp.getgrgid(os.fstat(port).st_gid).gr_name
    assert "may not be used by" in finding.message
    assert finding.changes[0].startswith(f"sudo usermod --append --groups {group} ")
    os.close(controller)
    os.close(port)


def test_room_for_log_and_map_is_looked_at(root, tmp_path, monkeypatch):
    absent = config(tmp_path, map=str(tmp_path / "valley.gpkg"))
    assert found(absent, root)["map"].message.endswith("is not there: copy it to the board, or build it.")
    learning = config(tmp_path, map=str(tmp_path / "valley.gpkg"), **{"mapping.learn": True})
    assert found(learning, root)["map"].ok
    usage = type(shutil.disk_usage("/"))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(8_000_000_000, 7_995_000_000, 5_000_000))
    findings = found(learning, root)
    assert findings["map"].message.endswith("only 5 MB are free there, too few for learning: make room.")
    assert "only 5.0 MB are free there" in findings["log"].message
