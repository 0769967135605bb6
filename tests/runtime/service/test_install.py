"""`edgevpr service install` into a folder that stands for the system: real virtual environment, real pip, real files.
The programs that change users and services are scripts that change the folder."""

import base64
import hashlib
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from edgevpr import __version__
from edgevpr.cli.main import main
from edgevpr.core.errors import ConfigError, EdgevprError, UsageError
from edgevpr.power.boards import load_board
from edgevpr.runtime.service import program
from edgevpr.runtime.service.install import install, uninstall
from edgevpr.runtime.service.unit import render_unit

pytestmark = [pytest.mark.process, pytest.mark.slow]

SCRIPTS = {
    "useradd": 'for name; do :; done; echo "$name:x:$(id -u):$(id -g)::/var/lib/edgevpr:/none" >> "$ROOT/etc/passwd"',
    "usermod": 'sed -i "s/^\\(dialout\\|video\\):.*/&edgevpr/" "$ROOT/etc/group"',
    "systemctl": 'case "$1" in is-active) test -e "$ROOT/running";; '
    'show) test -e "$ROOT/read" && printf "LoadState=loaded\\nNeedDaemonReload=no\\n";; '
    'daemon-reload) touch "$ROOT/read";; disable) echo "$@" >> "$ROOT/disabled";; esac',
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
    (root / "etc/group").write_text("root:x:0:\ndialout:x:20:\nvideo:x:44:\n")
    for name, text in SCRIPTS.items():
        (scripts / name).write_text(f"#!/bin/sh\nROOT={root}\n{text}\n")
        (scripts / name).chmod(0o755)
    return root


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """A lock of one package, and what has pip find it."""
    folder = tmp_path_factory.mktemp("packages")
    lines = (
        'absent==2.0 ; python_version == "2.7" \\\n    --hash=sha256:00\n',
        f"tiny.one==1.0 \\\n    --hash=sha256:{tiny_wheel(folder)}\n",
    )
    (folder / "requirements.lock").write_text("# a lock\n" + "".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        real = program.shipped
        patch.setattr(program, "shipped", lambda kind: folder if kind == "deploy" else real(kind))
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


def to_do(lines: list[str]) -> list[str]:
    """What was to do, but for the last step: udev is told each time."""
    assert lines[-1].startswith("to do  udev")
    return [line.removeprefix("to do  ") for line in lines[:-1] if line.startswith("to do")]


def tree(root: Path) -> dict[str, tuple[int, float]]:
    return {str(path): (path.stat().st_size, path.stat().st_mtime) for path in root.rglob("*")}


def test_everything_is_made_once(installed_root):
    root, said = installed_root
    assert len(to_do(said)) >= 11
    assert (root / "etc/systemd/system/edgevpr.service").read_text() == render_unit(load_board("this"))
    assert (root / "etc/udev/rules.d/99-edgevpr.rules").read_text().startswith("# udev rules of edgevpr")
    assert (root / "var/lib/edgevpr").is_dir()
    assert (root / "var/log/edgevpr").stat().st_uid == os.getuid()
    assert "edgevpr" in (root / "etc/passwd").read_text()
    assert (root / "udev").read_text().split() == ["control", "trigger"]
    bytecode = list((root / "opt/edgevpr").glob("lib/python3*/site-packages/edgevpr/core/__pycache__/config.*.pyc"))
    assert len(bytecode) == 1
    done = subprocess.run([root / "opt/edgevpr/bin/edgevpr", "--version"], capture_output=True, text=True, cwd="/")
    assert done.stdout == f"edgevpr {__version__}\n", done.stderr


def test_the_first_configuration_is_one(installed):
    assert main(["check", "--offline", "--config", str(installed / "etc/edgevpr/config.yaml")]) == 1  # no map yet


def test_a_second_run_finds_it_all_so(installed):
    lines_of(installed)
    before = tree(installed)
    again = lines_of(installed)
    assert to_do(again) == []
    (installed / "udev").touch()
    assert {name for name, is_now in tree(installed).items() if is_now != before.get(name)} == {str(installed / "udev")}


def test_a_dry_run_says_the_same_and_writes_nothing(system, packages):
    before = tree(system)
    said = lines_of(system, dry_run=True)
    assert tree(system) == before
    assert len(to_do(said)) == len(said) - 1


def test_a_dry_run_says_what_the_run_before_the_first_said(installed_root, system, packages):
    dry = lines_of(system, dry_run=True)
    assert dry == installed_root[1]


@pytest.mark.parametrize(
    ("damaged", "step"),
    [
        ("etc/udev/rules.d/99-edgevpr.rules", "udev rules"),
        ("etc/systemd/system/edgevpr.service", "unit"),
        ("opt/edgevpr/bin/edgevpr", "edgevpr "),
        ("opt/edgevpr/lib/*/site-packages/edgevpr/core/config.py", "edgevpr "),
        ("opt/edgevpr/lib/*/site-packages/edgevpr/shipped/profiles/rpi-5.yaml", "edgevpr "),
        ("opt/edgevpr/lib/*/site-packages/tiny_one-1.0.dist-info/RECORD", "packages"),
        ("opt/edgevpr/lib/*/site-packages/edgevpr/core/__pycache__/config.*.pyc", "compiled bytecode"),
        ("opt/edgevpr/bin/python", "virtual environment"),
        ("read", "systemd"),
    ],
)
def test_what_is_missing_is_made_again(installed, damaged, step):
    (path,) = installed.glob(damaged)
    path.unlink()
    done = to_do(lines_of(installed))
    assert done[0].startswith(step)
    (path,) = installed.glob(damaged)
    assert to_do(lines_of(installed)) == []


def test_a_configuration_of_ones_own_is_taken_and_the_one_before_kept(installed, tmp_path):
    first = (installed / "etc/edgevpr/config.yaml").read_bytes()
    own = tmp_path / "own.yaml"
    own.write_text("board: rpi-5\n")
    done = to_do(lines_of(installed, own))
    assert [each.split(",")[0].split()[0] for each in done] == ["configuration", "unit"]
    assert (installed / "etc/edgevpr/config.yaml").read_bytes() == own.read_bytes()
    assert (installed / "etc/edgevpr/config.yaml.old").read_bytes() == first
    assert (installed / "etc/systemd/system/edgevpr.service").read_text() == render_unit(load_board("rpi-5"))
    assert to_do(lines_of(installed)) == [], "what is there stays when none is named"
    own.write_bytes(first)
    lines_of(installed, own)


def test_a_configuration_that_is_none_stops_it_before_anything_is_done(system, tmp_path):
    (tmp_path / "bad.yaml").write_text("mapp: x\n")
    before = tree(system)
    with pytest.raises(ConfigError, match="mapp"):
        lines_of(system, tmp_path / "bad.yaml")
    assert tree(system) == before


def test_the_program_is_not_changed_under_a_flight(installed):
    (installed / "running").touch()
    try:
        assert to_do(lines_of(installed)) == []
        (command,) = installed.glob("opt/edgevpr/bin/edgevpr")
        command.unlink()
        with pytest.raises(EdgevprError, match="systemctl stop"):
            lines_of(installed)
    finally:
        (installed / "running").unlink()
    lines_of(installed)


def test_uninstalling_leaves_maps_logs_and_configuration(installed):
    kept = [installed / name for name in ("var/lib/edgevpr/v.gpkg", "var/log/edgevpr/f.jsonl")]
    for path in kept:
        path.write_text("mine")
    before, said = tree(installed), []
    uninstall(True, said.append, installed)
    assert tree(installed) == before
    really: list[str] = []
    uninstall(False, really.append, installed)
    assert really == said
    assert (installed / "disabled").read_text() == "disable --now edgevpr\n"
    assert not (installed / "opt/edgevpr").exists()
    assert not (installed / "etc/systemd/system/edgevpr.service").exists()
    assert not (installed / "etc/udev/rules.d/99-edgevpr.rules").exists()
    assert all(path.read_text() == "mine" for path in (*kept,))
    assert (installed / "etc/edgevpr/config.yaml").is_file()
    again: list[str] = []
    uninstall(False, again.append, installed)
    assert [line for line in again if line.startswith("to do") and "has read" not in line] == []
    for path in kept:
        path.unlink()
    lines_of(installed)


def test_what_is_no_virtual_environment_is_left_alone(system, packages):
    (system / "opt/edgevpr").mkdir(parents=True)
    (system / "opt/edgevpr/mine").touch()
    with pytest.raises(EdgevprError, match="/opt/edgevpr"):
        lines_of(system)
    with pytest.raises(EdgevprError, match="/opt/edgevpr"):
        uninstall(False, lambda _: None, system)
    assert (system / "opt/edgevpr/mine").exists()


def test_without_the_venv_module_the_package_is_named(system, packages, monkeypatch):
    monkeypatch.setitem(sys.modules, "ensurepip", None)
    with pytest.raises(EdgevprError, match="python3-venv"):
        lines_of(system)
    assert (system / "var/lib/edgevpr").is_dir(), "what is done stays"


def test_a_package_that_cannot_be_had_is_named(system, packages, monkeypatch, tmp_path):
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    with pytest.raises(EdgevprError, match=r"^python: .*tiny[.-]one==1\.0"):
        lines_of(system)


def test_without_systemd_all_else_is_done_and_one_sentence_said(installed):
    (installed / "read").unlink()
    (installed / "run/systemd/system").rmdir()
    try:
        with pytest.raises(EdgevprError, match=r"^systemd"):
            lines_of(installed)
    finally:
        (installed / "run/systemd/system").mkdir()
    lines_of(installed)
    assert (installed / "read").exists()


def test_a_program_of_the_system_that_fails_is_named_with_what_it_said(installed):
    (installed / "no-udev").touch()
    try:
        with pytest.raises(EdgevprError, match=r"^udevadm: no udev; "):
            lines_of(installed)
    finally:
        (installed / "no-udev").unlink()


def test_a_file_that_cannot_be_written_is_one_sentence_and_the_next_run_goes_on(system, packages):
    """A limit of the size of files stands for a full disk."""
    script = (
        "import resource, sys; from pathlib import Path\n"
        "from edgevpr.core.errors import EdgevprError; from edgevpr.runtime.service.install import install\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))\n"
        f"try: install(None, False, lambda _: None, Path({str(system)!r}))\n"
        "except EdgevprError as error: sys.exit(str(error))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("configuration in /etc/edgevpr/config.yaml: File too large; ")
    assert list((system / "etc/edgevpr").iterdir()) == []
    assert not [line for line in lines_of(system, dry_run=True) if "user" in line and line.startswith("to do")]


def test_32_bits_are_refused_before_anything_is_done(system, monkeypatch):
    monkeypatch.setattr(sys, "maxsize", 2**31 - 1)
    before = tree(system)
    with pytest.raises(UsageError, match="64"):
        lines_of(system)
    assert tree(system) == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_only_root_may_change_the_system():
    script = (
        "import os; from edgevpr.runtime.service.install import install, uninstall; os.seteuid(65534)\n"
        "for action in (lambda: install(None, False, print), lambda: uninstall(False, print)):\n"
        "    try: action()\n"
        "    except Exception as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert [line.split()[:2] for line in done.stdout.splitlines()] == 2 * [["Only", "root"]]


def test_the_program_that_was_installed_installs_itself_elsewhere_without_a_network(installed, system, packages):
    """From the wheel's layout, where the shipped folders lie inside, as from a checkout."""
    script = (
        "from pathlib import Path; from edgevpr.runtime.service import program\n"
        f"venv = Path({str(system)!r}) / program.VENV\n"
        "program._make_venv(venv); program._copy_edgevpr(venv); print(program._is_copied(venv))\n"
    )
    (python,) = installed.glob("opt/edgevpr/bin/python")
    done = subprocess.run([python, "-I", "-c", script], capture_output=True, text=True, cwd="/")
    assert done.stdout == "True\n", done.stderr
    said = subprocess.run([system / "opt/edgevpr/bin/edgevpr", "--version"], capture_output=True, text=True, cwd="/")
    assert said.stdout == f"edgevpr {__version__}\n", said.stderr
