"""The program of the service: a virtual environment of its own, with the edgevpr that runs and what it needs."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata, util
from pathlib import Path

from edgevpr import __version__
from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import shipped
from edgevpr.runtime.service import ownwheel
from edgevpr.runtime.service.steps import Step, command

NAME = "edgevpr"  # of the package, its command, the service, its user and the user's group
VENV = "opt/edgevpr"  # below the root; not below /home, which the service cannot see

_PROBE = "import json, pip, sys, sysconfig; print(json.dumps([sysconfig.get_path('purelib'), sys.version_info[:2]]))"


def program_steps(venv: Path) -> tuple[Step, ...]:
    """Return the steps to a virtual environment with this edgevpr, the packages it needs, and compiled bytecode."""
    python = venv / "bin" / "python"
    lock = shipped("deploy") / "requirements.lock"

    def site() -> Path | None:
        return (found := _probed(python)) and found[0]

    def pip(folder: Path, *words: str | Path) -> None:
        for broken in site().glob("*.dist-info"):  # left by a run that was broken off, and a package to pip
            if not (broken / "RECORD").is_file():
                shutil.rmtree(broken)
        quiet = "--disable-pip-version-check", "--no-input"
        command(python, "-I", "-m", "pip", *quiet, "install", *words, TMPDIR=str(folder))

    def install_packages() -> None:
        with _room(venv) as folder:
            pip(folder, "--require-hashes", "--only-binary", ":all:", "--requirement", lock)

    def install_own() -> None:
        with _room(venv) as folder:
            wheel = ownwheel.write_wheel(folder)
            pip(folder, "--no-deps", "--no-index", "--no-compile", "--force-reinstall", wheel)

    return (
        Step(f"virtual environment in /{VENV}", lambda: site() is not None, lambda: _make_venv(venv)),
        Step(
            f"packages of {lock.name}, by their hashes",
            lambda: (found := _probed(python)) is not None and _has_packages(*found, lock.read_text("utf-8")),
            install_packages,
        ),
        Step(
            f"edgevpr {__version__}",
            lambda: (venv / "bin" / NAME).is_file() and (found := site()) is not None and ownwheel.is_in(found),
            install_own,
        ),
        Step(
            "compiled bytecode, for a quick start",
            lambda: site() is not None and _is_compiled(site() / NAME),
            lambda: command(python, "-I", "-m", "compileall", "-q", site() / NAME),
        ),
    )


def _probed(python: Path) -> tuple[Path, tuple[int, int]] | None:
    """Return the folder of packages of a virtual environment and the version of its Python, None where it does not
    work or has no pip."""
    try:
        done = subprocess.run([python, "-I", "-c", _PROBE], stdin=subprocess.DEVNULL, capture_output=True, check=True)
        folder, (major, minor) = json.loads(done.stdout)
    except (OSError, subprocess.CalledProcessError, ValueError):
        return None
    return Path(folder), (major, minor)


def _make_venv(path: Path) -> None:
    if util.find_spec("ensurepip") is None:
        raise EdgevprError("Python's venv module is missing: `apt install python3-venv`, then run it again.")
    is_own = (path / "pyvenv.cfg").is_file()
    if not is_own and path.exists() and any(path.iterdir()):
        raise EdgevprError(f"{path} holds something that is no virtual environment: move it away.")
    _require_stopped()
    # One whose Python has gone with an upgrade of the system cannot be mended.
    clear = ("--clear",) if is_own and Path(sys.prefix).resolve() != path.resolve() else ()
    command(sys.executable, "-I", "-m", "venv", *clear, path)


def _require_stopped() -> None:
    """Raise EdgevprError while the service runs: what it imports later would be another version's."""
    if shutil.which("systemctl") is None:
        return
    if subprocess.run(["systemctl", "is-active", "--quiet", NAME], capture_output=True).returncode == 0:
        raise EdgevprError(f"The service runs: `systemctl stop {NAME}` on the ground, then run it again.")


def _has_packages(site: Path, python: tuple[int, int], lock: str) -> bool:
    """Tell whether all that the lock names for this Python is there, in its version and installed to the end."""
    there = {
        _canonical(each.name or ""): each.version
        for each in metadata.distributions(path=[str(site)])
        if each.read_text("RECORD")
    }
    wanted = re.findall(r"(?m)^([\w.-]+)==(\S+)(?: ; (.*?))? *\\?$", lock)
    own = f'"{python[0]}.{python[1]}"'
    return all(there.get(_canonical(name)) == version for name, version, when in wanted if not when or own in when)


@contextmanager
def _room(venv: Path) -> Iterator[Path]:
    """Give a folder for what is unfinished. /tmp may be memory, of which a small board has too little."""
    _require_stopped()
    folder = venv / "unfinished"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _is_compiled(package: Path) -> bool:
    modules = list(package.rglob("*.py"))
    return bool(modules) and all(any((path.parent / "__pycache__").glob(f"{path.stem}.*.pyc")) for path in modules)


def remove_program(path: Path) -> None:
    """Remove the virtual environment; raises EdgevprError for something else in its place."""
    if not (path / "pyvenv.cfg").is_file():
        raise EdgevprError(f"{path} is no virtual environment: look at it, and remove it by hand.")
    shutil.rmtree(path)
