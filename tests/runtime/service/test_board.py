"""Findings of `edgevpr doctor` about a machine, on trees of files that stand for /proc, /sys and /dev."""

import grp
import os
import shutil
from pathlib import Path

import pytest

from edgevpr.core.config import LogConfig
from edgevpr.core.files import find_shipped
from edgevpr.mavlink.address import parse_link
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.finding import check_device, check_machine
from edgevpr.runtime.service.findingcodes import FindingCode


@pytest.fixture
def root(tree) -> Path:
    """The root of a machine with cgroup v2, 512 MB and a serial port."""
    files = {
        "proc/meminfo": "MemTotal: 500000 kB\n",
        "proc/self/cgroup": "0::/user.slice\n",
        "proc/cmdline": "root=/dev/sda1",
        "sys/fs/cgroup/cgroup.controllers": "cpu memory",
        "sys/fs/cgroup/user.slice/memory.max": "300000000\n",
    }
    root = tree({f"root/{name}": text for name, text in files.items()}) / "root"
    (root / "dev").mkdir()
    (root / "dev/ttyAMA0").symlink_to("/dev/null")
    return root


def find(root: Path, link: str = "udpin:127.0.0.1:14550") -> dict:
    board, log = load_board("rpi-zero-2w"), LogConfig(path=str(root.parent / "flight.jsonl"))
    return {finding.what: finding for finding in check_machine(board, log, parse_link(link), root)}


def test_check_machine_finds_nothing_wrong_and_writes_nothing(root, tmp_path):
    assert {what: finding.ok for what, finding in find(root).items()} == {"memory": True, "log": True}
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.parametrize(
    ("file", "text", "code", "changes"),
    [
        ("user.slice/memory.max", "128000000\n", FindingCode.MEMORY_LIMIT_LOW, ("MemoryMax=256000000",)),
        ("cgroup.controllers", "cpu io", FindingCode.MEMORY_LIMIT_IGNORED, ()),
    ],
)
def test_check_machine_finds_limits_of_memory(root, file, text, code, changes):
    (root / "sys/fs/cgroup" / file).write_text(text)
    memory = find(root)["memory"]
    assert (memory.ok, memory.reason.code, memory.changes) == (False, code, changes)


def test_check_machine_finds_a_full_disk(root, monkeypatch):
    usage = type(shutil.disk_usage("/"))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(8_000_000_000, 7_995_000_000, 5_000_000))
    assert find(root)["log"].reason.code is FindingCode.DISK_FULL


def test_check_device_accepts_a_free_serial_port():
    controller, port = os.openpty()
    assert check_device("serial", os.ttyname(port)).ok
    os.close(controller)
    os.close(port)


def test_check_device_refuses_what_is_not_a_device(root):
    assert find(root, "serial:/dev/ttyACM99:57600")["serial"].reason.code is FindingCode.DEVICE_ABSENT
    (root / "dev/ttyS0").touch()
    assert check_device("serial", "/dev/ttyS0", root).reason.code is FindingCode.NOT_A_DEVICE


@pytest.mark.parametrize(
    ("gid", "what", "change"),
    [
        (0, "serial", "sudo systemctl disable --now serial-getty@null"),
        (grp.getgrnam("tty").gr_gid, "serial", "sudo systemctl disable --now serial-getty@null"),
        (0, "camera", f"sudo install -D -m 644 -t /etc/udev/rules.d {find_shipped('deploy')}/99-edgevpr.rules"),
        (5000, "serial", "sudo usermod --append --groups 5000 USER"),
        (5000, "camera", "sudo usermod --append --groups 5000 USER"),
    ],
)
def test_check_device_without_access_advises_a_group_unless_it_is_a_system_group(root, monkeypatch, gid, what, change):
    null, status = os.stat("/dev/null"), Path.stat
    owned = os.stat_result([*null[:5], gid, *null[6:]], {"st_rdev": null.st_rdev})
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(Path, "stat", lambda path, **how: owned if path.name == "ttyAMA0" else status(path, **how))
    finding = check_device(what, "/dev/ttyAMA0", root)
    assert (finding.ok, finding.reason.code, finding.changes[0]) == (False, FindingCode.DEVICE_DENIED, change)


def test_check_device_names_the_program_that_has_it_open(root):
    for number in ("812", "99"):
        (root / f"proc/{number}/fd").mkdir(parents=True)
        (root / f"proc/{number}/stat").write_text(f"{number} (a getty) S 1 {number} {number} 0 -1 4194304")
    assert check_device("serial", "/dev/ttyAMA0", root).ok
    (root / "proc/99/fd/7").symlink_to("/dev/null")
    assert check_device("serial", "/dev/ttyAMA0", root).reason.parameters["program"] == "a getty (process 99)"
    (root / "proc/99/stat").write_text("99 (ag) S 1 99 99 259 99 4194304")  # 259: major number 1, minor number 3
    assert check_device("serial", "/dev/ttyAMA0", root).changes == ("sudo systemctl disable --now serial-getty@null",)


@pytest.mark.parametrize("file", ["proc/cmdline", "boot/firmware/cmdline.txt"])
def test_check_device_finds_the_console_of_the_kernel(root, file):
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    (root / file).write_text("console=ttyAMA0,115200 console=tty1")
    assert check_device("serial", "/dev/ttyAMA0", root).reason.parameters["console"] == "ttyAMA0"
