"""What `edgevpr doctor` says of a machine, on trees of files that stand for /proc, /sys and /dev."""

import grp
import os
import shutil
from pathlib import Path

import pytest

from edgevpr.core.config import Config, load_config
from edgevpr.mavlink.address import parse_link
from edgevpr.runtime.service.finding import board_findings, device


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
    assert list(findings) == ["memory", "log"]
    assert all(each.ok for each in findings.values())
    assert findings["memory"].message.startswith("512 of 512 MB")
    assert list(tmp_path.iterdir()) == [root]


def test_the_limits_of_control_groups_are_told(root, tmp_path):
    (root / "proc/self/cgroup").write_text("0::/user.slice\n")
    (root / "sys/fs/cgroup/user.slice").mkdir()
    (root / "sys/fs/cgroup/user.slice/memory.max").write_text("128000000\n")
    memory = found(config(tmp_path), root)["memory"]
    assert (memory.ok, memory.changes) == (False, ("MemoryMax=256000000",))
    assert memory.message.startswith("128 of 512 MB")
    (root / "sys/fs/cgroup/user.slice/memory.max").write_text("300000000\n")
    assert found(config(tmp_path), root)["memory"].ok


def test_a_kernel_without_the_memory_controller_is_wrong(root, tmp_path):
    (root / "sys/fs/cgroup/cgroup.controllers").write_text("cpu io")
    memory = found(config(tmp_path), root)["memory"]
    assert (memory.ok, memory.changes) == (
        False,
        ("cgroup_enable=memory in /boot/firmware/cmdline.txt, and reboot",),
    )


def test_a_device_is_looked_at(root, tmp_path):
    controller, port = os.openpty()
    name = os.ttyname(port)
    good = device("serial", name)
    assert (good.ok, good.message.startswith(f"{name}, group ")) == (True, True)
    assert found(config(tmp_path), Path("/"), f"serial:{name}:57600")["serial"].ok
    assert device("camera", name).ok
    os.close(controller)
    os.close(port)


def test_the_console_of_the_kernel_is_no_place_for_a_link(root):
    (root / "dev/ttyAMA0").symlink_to("/dev/null")
    assert device("serial", "/dev/ttyAMA0", root).ok
    (root / "proc/cmdline").write_text("console=ttyAMA0,115200 console=tty1")
    finding = device("serial", "/dev/ttyAMA0", root)
    assert not finding.ok
    assert "console=ttyAMA0" in finding.changes[0]


def test_a_device_that_is_absent_or_none_is_wrong(root, tmp_path):
    absent = found(config(tmp_path), root, "serial:/dev/ttyACM99:57600")
    assert absent["serial"].message.startswith("/dev/ttyACM99: No such file")
    assert not device("camera", "/dev/video99", root).ok
    (root / "dev/ttyS0").touch()
    assert not device("serial", "/dev/ttyS0", root).ok


@pytest.mark.parametrize(("gid", "advised"), [(0, False), (grp.getgrnam("tty").gr_gid, False), (5000, True)])
def test_a_device_that_may_not_be_used_names_its_group_unless_that_is_of_consoles(root, monkeypatch, gid, advised):
    (root / "dev/ttyAMA0").symlink_to("/dev/null")
    null, status = os.stat("/dev/null"), Path.stat
    owned = os.stat_result([*null[:5], gid, *null[6:]], {"st_rdev": null.st_rdev})
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(Path, "stat", lambda path, **how: owned if path.name == "ttyAMA0" else status(path, **how))
    finding = device("serial", "/dev/ttyAMA0", root)
    assert (finding.ok, len(finding.changes)) == (False, 1)
    assert finding.changes[0].startswith(
        "sudo usermod --append --groups 5000 " if advised else "sudo systemctl disable --now serial-getty@"
    )
    assert ("usermod" in device("camera", "/dev/ttyAMA0", root).changes[0]) is advised


def test_whoever_holds_a_serial_port_is_named_and_how_to_free_it(root):
    (root / "dev/ttyAMA0").symlink_to("/dev/null")
    for number in ("812", "99"):
        (root / f"proc/{number}/fd").mkdir(parents=True)
        (root / f"proc/{number}/stat").write_text(f"{number} (a getty) S 1 {number} {number} 0 -1 4194304")
    assert device("serial", "/dev/ttyAMA0", root).ok
    (root / "proc/99/fd/7").symlink_to("/dev/null")
    open_in = device("serial", "/dev/ttyAMA0", root)
    assert (open_in.ok, open_in.changes) == (False, ("stop a getty (process 99)",))
    (root / "proc/99/stat").write_text("99 (ag) S 1 99 99 259 99 4194304")  # 259: major number 1, minor number 3
    login = device("serial", "/dev/ttyAMA0", root)
    assert "ag (process 99) lets people log in" in login.message
    assert login.changes == ("sudo systemctl disable --now serial-getty@null",)
    (root / "boot/firmware").mkdir(parents=True)
    (root / "boot/firmware/cmdline.txt").write_text("console=ttyAMA0,115200 console=tty1")
    assert len(device("serial", "/dev/ttyAMA0", root).changes) == 2
    (root / "proc/device-tree").mkdir()
    (root / "proc/device-tree/model").write_text("Raspberry Pi 4 Model B Rev 1.4\0")
    assert device("serial", "/dev/ttyAMA0", root).changes[0].startswith("sudo raspi-config, Interface Options")


def test_room_for_the_log_is_looked_at(root, tmp_path, monkeypatch):
    usage = type(shutil.disk_usage("/"))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(8_000_000_000, 7_995_000_000, 5_000_000))
    assert "5.0 MB" in found(config(tmp_path), root)["log"].message
