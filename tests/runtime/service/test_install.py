"""`edgevpr service install` into a folder that stands for the system: real virtual environment, real pip, real files.
The programs that change users and services are scripts that change the folder."""

import base64
import hashlib
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from edgevpr import __version__
from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError
from edgevpr.power.boards import load_board
from edgevpr.runtime.service import install as module
from edgevpr.runtime.service.install import install, render_unit, uninstall

pytestmark = [pytest.mark.process, pytest.mark.slow]

SCRIPTS = {
    "id": 'grep -q "^$1:" "$ROOT/etc/passwd"',
    "install": 'for name; do :; done; mkdir -p "$name"',
    "useradd": 'for name; do :; done; echo "$name:x:$(id -u):$(id -g)::/var/lib/edgevpr:/none" >> "$ROOT/etc/passwd"',
    "usermod": 'echo "$@" > "$ROOT/usermod"',
    "systemctl": 'case "$1" in is-active) test -e "$ROOT/running";; daemon-reload) touch "$ROOT/read";; '
    'disable) echo "$@" >> "$ROOT/disabled";; esac',
    "udevadm": 'echo "$1" >> "$ROOT/udev"; test ! -e "$ROOT/no-udev" || { echo "no udev" >&2; exit 1; }',
}


def tiny_wheel(folder: Path) -> str:
    """Write the wheel of a package that the lock names, and return its hash."""
    path, info = folder / "tiny_one-1.0-py3-none-any.whl", "tiny_one-1.0.dist-info"
    files = {
        "tiny_one.py": "",
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: tiny-one\nVersion: 1.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = ""
    with zipfile.ZipFile(path, "w") as wheel:
        for name, text in files.items():
            wheel.writestr(name, text)
            digest = base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).decode().rstrip("=")
            record += f"{name},sha256={digest},{len(text)}\n"
        wheel.writestr(f"{info}/RECORD", f"{record}{info}/RECORD,,\n")
    return hashlib.sha256(path.read_bytes()).hexdigest()


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


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """A lock of one package, beside the files to deploy, and what has pip find it."""
    folder = shutil.copytree(module.shipped("deploy"), tmp_path_factory.mktemp("packages"), dirs_exist_ok=True)
    lines = (
        'absent==2.0 ; python_version == "2.7" \\\n    --hash=sha256:00\n',
        f"tiny.one==1.0 \\\n    --hash=sha256:{tiny_wheel(folder)}\n",
    )
    (folder / "requirements.lock").write_text("# a lock\n" + "".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        real = module.shipped
        patch.setattr(module, "shipped", lambda kind: folder if kind == "deploy" else real(kind))
        patch.setenv("PIP_NO_INDEX", "1")
        patch.setenv("PIP_FIND_LINKS", str(folder))
        yield folder


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A system without edgevpr."""
    root = bare(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path / 'scripts'}:{os.environ['PATH']}")
    return root


@pytest.fixture(scope="module")
def installed_root(tmp_path_factory, packages):
    """A system with edgevpr, and what was said on the way."""
    folder = tmp_path_factory.mktemp("installed")
    root = bare(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{folder / 'scripts'}:{os.environ['PATH']}")
        yield root, lines_of(root)


@pytest.fixture
def installed(installed_root, monkeypatch):
    """A system with edgevpr; who damages it has it mended by another run."""
    monkeypatch.setenv("PATH", f"{installed_root[0].parent / 'scripts'}:{os.environ['PATH']}")
    return installed_root[0]


def lines_of(root: Path, config: Path | None = None, dry_run: bool = False) -> list[str]:
    said: list[str] = []
    install(config, dry_run, said.append, root)
    return said


def tree(root: Path) -> dict[str, tuple[int, float]]:
    return {str(path): (path.stat().st_size, path.stat().st_mtime) for path in root.rglob("*")}


def version_of(root: Path) -> str:
    command = [root / "opt/edgevpr/bin/edgevpr", "--version"]
    return subprocess.run(command, capture_output=True, text=True, cwd="/").stdout


def test_install_can_be_repeated(installed_root):
    root, said = installed_root
    assert (root / "etc/systemd/system/edgevpr.service").read_text() == render_unit(load_board("this"))
    assert (root / "etc/udev/rules.d/99-edgevpr.rules").read_text().startswith("# udev rules of edgevpr")
    assert (root / "var/lib/edgevpr").is_dir()
    assert (root / "var/log/edgevpr").is_dir()
    assert (root / "usermod").read_text() == "--append --groups dialout,video edgevpr\n"
    assert (root / "read").exists()
    assert (root / "udev").read_text().split() == ["control", "trigger"]
    bytecode = list((root / "opt/edgevpr").glob("lib/python3*/site-packages/edgevpr/core/__pycache__/config.*.pyc"))
    assert len(bytecode) == 1
    assert version_of(root) == f"edgevpr {__version__}\n"
    before = {name: content for name, content in tree(root).items() if "/opt/" not in name and "/udev" not in name}
    assert lines_of(root) == said
    assert {name: tree(root)[name][0] for name in before} == {name: size for name, (size, _) in before.items()}
    assert (root / "etc/passwd").read_text().count("edgevpr:x") == 1


def test_install_writes_a_valid_configuration(installed):
    assert main(["check", "--offline", "--config", str(installed / "etc/edgevpr/config.yaml")]) == 2  # no map


def test_install_dry_run_writes_nothing(installed_root, system, packages):
    before = tree(system)
    assert lines_of(system, dry_run=True) == installed_root[1]
    assert tree(system) == before


def test_install_repairs_what_is_missing(installed):
    (package,) = installed.glob("opt/edgevpr/lib/*/site-packages/tiny_one-1.0.dist-info/RECORD")
    (profile,) = installed.glob("opt/edgevpr/lib/*/site-packages/edgevpr/shipped/profiles/rpi-5.yaml")
    missing = (package, profile, installed / "opt/edgevpr/bin/edgevpr", installed / "opt/edgevpr/bin/python")
    for path in missing:
        path.unlink()
    (installed / "opt/edgevpr/unfinished").touch()
    lines_of(installed)
    assert all(path.exists() for path in missing)
    assert not (installed / "opt/edgevpr/unfinished").exists()
    assert version_of(installed) == f"edgevpr {__version__}\n"


def test_install_keeps_the_configuration_before(installed, tmp_path):
    first = (installed / "etc/edgevpr/config.yaml").read_bytes()
    own = tmp_path / "own.yaml"
    own.write_text("board: rpi-5\n")
    lines_of(installed, own)
    lines_of(installed)  # what is there stays when none is named
    assert (installed / "etc/edgevpr/config.yaml").read_bytes() == own.read_bytes()
    assert (installed / "etc/edgevpr/config.yaml.old").read_bytes() == first
    assert (installed / "etc/systemd/system/edgevpr.service").read_text() == render_unit(load_board("rpi-5"))


@pytest.mark.parametrize("case", ["configuration", "32 bits", "running"])
def test_install_refuses_before_it_changes_anything(system, tmp_path, monkeypatch, case):
    own = tmp_path / "own.yaml"
    own.write_text("mapp: x\n" if case == "configuration" else "")
    if case == "32 bits":
        monkeypatch.setattr(sys, "maxsize", 2**31 - 1)
    if case == "running":
        (system / "running").touch()
    before = tree(system)
    with pytest.raises(EdgevprError, match={"configuration": "mapp", "32 bits": "64"}.get(case, "systemctl stop")):
        lines_of(system, own)
    assert tree(system) == before


def test_install_leaves_alone_what_is_not_a_virtual_environment(system, packages):
    (system / "opt/edgevpr").mkdir(parents=True)
    (system / "opt/edgevpr/mine").touch()
    with pytest.raises(EdgevprError, match="/opt/edgevpr"):
        lines_of(system)
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
    """The last test: what it leaves is not installed again."""
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
