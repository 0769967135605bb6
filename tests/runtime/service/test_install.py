"""`edgevpr service install` into a folder that stands for the system: real files. The programs that change users and
services are scripts that change the folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.install import install, render_unit, uninstall

pytestmark = pytest.mark.process

SCRIPTS = {
    "id": 'grep -q "^$1:" "$ROOT/etc/passwd"',
    "install": 'for name; do :; done; mkdir -p "$name"',
    "useradd": 'for name; do :; done; echo "$name:x:$(id -u):$(id -g)::/var/lib/edgevpr:/none" >> "$ROOT/etc/passwd"',
    "usermod": 'echo "$@" > "$ROOT/usermod"',
    "systemctl": 'case "$1" in is-active) test -e "$ROOT/running";; daemon-reload) touch "$ROOT/read";; '
    'disable) echo "$@" >> "$ROOT/disabled";; esac',
    "udevadm": 'echo "$1" >> "$ROOT/udev"; test ! -e "$ROOT/no-udev" || { echo "no udev" >&2; exit 1; }',
}


def bare(folder: Path) -> Path:
    """Make a folder that looks like a Debian without edgevpr, and its scripts beside it."""
    root, scripts = folder / "root", folder / "scripts"
    for each in (root / "etc", root / "run/systemd/system", scripts):
        each.mkdir(parents=True)
    (root / "etc/passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")
    for name, text in SCRIPTS.items():
        (scripts / name).write_text(f"#!/bin/sh\nROOT={root}\n{text}\n")
        (scripts / name).chmod(0o755)
    return root


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A system on which this edgevpr is in /opt/edgevpr, and nothing of the service."""
    root = bare(tmp_path)
    (root / "opt/edgevpr").mkdir(parents=True)
    (root / "opt/edgevpr/pyvenv.cfg").touch()
    monkeypatch.setattr(sys, "prefix", str(root / "opt/edgevpr"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'scripts'}:{os.environ['PATH']}")
    return root


@pytest.fixture
def installed(system):
    """A system with the service."""
    lines_of(system)
    return system


def lines_of(root: Path, config: Path | None = None, dry_run: bool = False) -> list[str]:
    said: list[str] = []
    install(config, dry_run, said.append, root)
    return said


def tree(root: Path) -> dict[str, tuple[int, float]]:
    return {str(path): (path.stat().st_size, path.stat().st_mtime) for path in root.rglob("*")}


def test_install_can_be_repeated(system):
    root, said = system, lines_of(system)
    assert (root / "etc/systemd/system/edgevpr.service").read_text() == render_unit(load_board("this"))
    assert (root / "etc/udev/rules.d/99-edgevpr.rules").read_text().startswith("# udev rules of edgevpr")
    assert (root / "var/lib/edgevpr").is_dir()
    assert (root / "var/log/edgevpr").is_dir()
    assert (root / "usermod").read_text() == "--append --groups dialout,video edgevpr\n"
    assert (root / "read").exists()
    assert (root / "udev").read_text().split() == ["control", "trigger"]
    before = {name: content for name, content in tree(root).items() if "/udev" not in name}
    assert lines_of(root) == said
    assert {name: tree(root)[name][0] for name in before} == {name: size for name, (size, _) in before.items()}
    assert (root / "etc/passwd").read_text().count("edgevpr:x") == 1


def test_install_writes_a_valid_configuration(installed):
    assert main(["check", "--offline", "--config", str(installed / "etc/edgevpr/config.yaml")]) == 2  # no map


def test_install_dry_run_writes_nothing(system):
    before = tree(system)
    said = lines_of(system, dry_run=True)
    assert tree(system) == before
    assert lines_of(system) == said


def test_install_keeps_the_configuration_before(installed, tmp_path):
    first = (installed / "etc/edgevpr/config.yaml").read_bytes()
    own = tmp_path / "own.yaml"
    own.write_text("board: rpi-5\n")
    lines_of(installed, own)
    lines_of(installed)  # what is there stays when none is named
    assert (installed / "etc/edgevpr/config.yaml").read_bytes() == own.read_bytes()
    assert (installed / "etc/edgevpr/config.yaml.old").read_bytes() == first
    assert (installed / "etc/systemd/system/edgevpr.service").read_text() == render_unit(load_board("rpi-5"))


@pytest.mark.parametrize("case", ["configuration", "32 bits", "running", "elsewhere"])
def test_install_refuses_before_it_changes_anything(system, tmp_path, monkeypatch, case):
    own = tmp_path / "own.yaml"
    own.write_text("mapp: x\n" if case == "configuration" else "")
    if case == "32 bits":
        monkeypatch.setattr(sys, "maxsize", 2**31 - 1)
    if case == "running":
        (system / "running").touch()
    if case == "elsewhere":
        monkeypatch.setattr(sys, "prefix", "/usr")
    before, says = tree(system), {"configuration": "mapp", "32 bits": "64", "elsewhere": "this one is in /usr"}
    with pytest.raises(EdgevprError, match=says.get(case, "systemctl stop")):
        lines_of(system, own)
    assert tree(system) == before


def test_uninstall_leaves_alone_what_is_not_a_virtual_environment(system):
    (system / "opt/edgevpr/pyvenv.cfg").unlink()
    (system / "opt/edgevpr/mine").touch()
    with pytest.raises(EdgevprError, match="/opt/edgevpr"):
        uninstall(False, lambda _: None, system)
    assert (system / "opt/edgevpr/mine").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_install_needs_root():
    script = (
        "import os; from edgevpr.runtime.service.install import install, uninstall; os.seteuid(65534)\n"
        "for action in (lambda: install(None, False, print), lambda: uninstall(False, print)):\n"
        "    try: action()\n"
        "    except Exception as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert [line.split()[:2] for line in done.stdout.splitlines()] == 2 * [["Only", "root"]]


def test_uninstall_leaves_maps_logs_and_configuration(installed):
    kept = [installed / name for name in ("var/lib/edgevpr/v.gpkg", "var/log/edgevpr/f.jsonl")]
    for path in kept:
        path.write_text("mine")
    before, said = tree(installed), []
    uninstall(True, said.append, installed)
    assert tree(installed) == before
    for _ in range(2):
        really: list[str] = []
        uninstall(False, really.append, installed)
        assert really == said
    assert (installed / "disabled").read_text() == "disable --now edgevpr\n"
    assert not (installed / "opt/edgevpr").exists()
    assert not (installed / "etc/systemd/system/edgevpr.service").exists()
    assert not (installed / "etc/udev/rules.d/99-edgevpr.rules").exists()
    assert all(path.read_text() == "mine" for path in kept)
    assert (installed / "etc/edgevpr/config.yaml").is_file()
