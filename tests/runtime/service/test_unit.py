"""The systemd unit, judged by systemd's own tools, and the udev rules."""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.power.boards import list_boards, load_board
from edgevpr.runtime.service.unit import render_unit

DEPLOY = Path(__file__).parents[3] / "deploy"
UNIT = DEPLOY / "edgevpr.service"

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None,
    reason="systemd-analyze is not on this machine (Debian: apt install systemd)",
)


def verify(text: str, folder: Path) -> str:
    """What `systemd-analyze verify` complains of; a real program stands in for one that may not be installed."""
    unit = folder / "edgevpr.service"
    unit.write_text(text.replace("/opt/edgevpr/bin/edgevpr", shutil.which("true")))
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    return done.stderr + ("" if done.returncode == 0 else f"exit code {done.returncode}")


def read_directives(text: str) -> dict[str, str]:
    """The last value of each directive of a unit."""
    return dict(re.findall(r"(?m)^(\w+)=(.*)$", text))


@pytest.mark.slow
@needs_systemd
def test_render_unit_passes_systemds_verification(tmp_path):
    for name in list_boards():
        assert verify(render_unit(load_board(name)), tmp_path) == ""


@needs_systemd
def test_unit_keeps_its_exposure_under_two(tmp_path):
    unit = tmp_path / "edgevpr.service"
    unit.write_text(UNIT.read_text())
    judged = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", unit],
        capture_output=True,
        text=True,
    )
    if "unrecognized option" in judged.stderr:
        pytest.skip("this systemd-analyze (before 250) cannot judge a unit that is not loaded")
    assert judged.returncode == 0, judged.stdout


def test_unit_requires_no_removable_storage():
    """systemd stops a service with the mount that it requires, and starts neither again."""
    said = read_directives(UNIT.read_text())
    requiring = {"WorkingDirectory", "StateDirectory", "LogsDirectory", "RequiresMountsFor", "Requires", "BindsTo"}
    assert not requiring & said.keys()
    folders = {path.removeprefix("-") for path in said["ReadWritePaths"].split()}
    assert folders == {"/var/lib/edgevpr", "/var/log/edgevpr"}
    assert {f"{folder[1:].replace('/', '-')}.mount" for folder in folders} < set(said["After"].split())


def test_unit_file_in_deploy_is_that_of_the_default_board():
    assert UNIT.read_text() == render_unit(load_board("rpi-zero-2w"))


def test_render_unit_has_the_limits_of_the_board():
    unit = render_unit(replace(load_board("rpi-zero-2w"), name="mine", cores=8, cpu_share=0.3, memory_max_mb=777.0))
    assert read_directives(unit)["MemoryMax"] == "777000000"
    assert read_directives(unit)["CPUQuota"] == "240%"
    assert read_directives(unit)["ExecStart"] == "/opt/edgevpr/bin/edgevpr run --config /etc/edgevpr/config.yaml"
    assert "# Board: mine\n" in unit
    assert "rpi-zero-2w" not in unit


def test_render_unit_escapes_the_name_of_the_board():
    unit = render_unit(replace(load_board("rpi-zero-2w"), name="x\nExecStartPre=/bin/sh"))
    assert "\n# Board: x\\nExecStartPre=/bin/sh\n" in unit
    assert read_directives(unit)["ExecStartPre"] == read_directives(UNIT.read_text())["ExecStartPre"]


def test_unit_finds_the_files_installed_by_the_documented_commands():
    said, page = read_directives(UNIT.read_text()), (DEPLOY / "README.md").read_text()
    commands = "".join(re.findall(r"(?ms)^```sh$(.*?)^```$", page))
    program, config = said["ExecStart"].split()[0], said["ExecStart"].split()[-1]
    assert f"venv {program.removesuffix('/bin/edgevpr')}\n" in commands
    assert f" {config}\n" in commands
    assert f"--groups {said['SupplementaryGroups'].replace(' ', ',')} " in commands
    user = said["User"]
    assert re.search(f"useradd .* {user}\n", commands)
    assert f"install -d -o {user} -g {user} {said['ReadWritePaths'].replace('-/', '/')}\n" in commands


def test_unit_keeps_trying_in_flight_but_not_after_a_usage_error():
    unit = read_directives(UNIT.read_text())
    assert unit["Restart"] == "always"
    assert unit["StartLimitIntervalSec"] == "0"
    assert unit["RestartPreventExitStatus"] == str(UsageError.exit_code)
    assert "\nEnvironment=EDGEVPR_MODELS=/var/lib/edgevpr/models\n" in UNIT.read_text()


def test_unit_allows_serial_ports_and_cameras():
    unit = read_directives(UNIT.read_text())
    # /dev/video*, /dev/media* and /run/udev, which libcamera and GStreamer read, are not hidden.
    hidden = {"PrivateDevices", "InaccessiblePaths", "TemporaryFileSystem", "RootDirectory", "MountAPIVFS"}
    assert not hidden & unit.keys()
    assert unit["DeviceAllow"] == "char-* rw"  # ProtectClock alone would shut them out
    assert unit["SupplementaryGroups"] == "dialout video"
    assert (unit["PrivateTmp"], unit["BindPaths"]) == ("yes", "-/tmp/argus_socket"), "of a Jetson's camera"
