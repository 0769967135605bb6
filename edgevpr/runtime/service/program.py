"""The program of the service: a virtual environment with a copy of the running edgevpr and the packages that it needs.

It is made in steps, which `install` takes. Each says what it does, or that this is done already, so that a run after an
interrupted one continues where that stopped.
"""

import filecmp
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import util
from pathlib import Path

import edgevpr
from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import shipped

NAME = "edgevpr"  # of the package, its command, the service, its user and the user's group
VENV = "opt/edgevpr"  # below the root; not below /home, which the service cannot see
_AGAIN = "correct that and run it again: what is done stays"
_SHIPPED = ("profiles", "models", "deploy")
_SCRIPT = "#!{python}\nimport sys\n\nfrom edgevpr.cli.main import program\n\nsys.exit(program())\n"


@dataclass(frozen=True, slots=True)
class Step:
    """One step of an installation. `what`: the state after it, in words. `is_so` tells whether that state is reached
    already, and `do` reaches it."""

    what: str
    is_so: Callable[[], bool]
    do: Callable[[], object]


def walk(steps: Iterable[Step], dry_run: bool, say: Callable[[str], None]) -> None:
    """Take each step whose state is not reached yet. `say` is called with a line about each step, before it is taken.
    With `dry_run` none is taken. Raises EdgevprError for the first step that fails."""
    before = os.umask(0o022)  # the service's user is to read what root writes
    try:
        for step in steps:
            is_so = step.is_so()
            say(f"{'is so' if is_so else 'to do'}  {step.what}")
            if is_so or dry_run:
                continue
            try:
                step.do()
                os.sync()  # so that a finished step stays finished after a power cut
            except OSError as error:
                where = f"{error.filename}: " if error.filename else ""
                raise EdgevprError(f"{step.what}: {where}{error.strerror or error}; {_AGAIN}.") from error
    finally:
        os.umask(before)


def command(*words: str | Path, **environment: str) -> None:
    """Run a program with `environment` added to ours. If it fails, raise EdgevprError with the last line of its
    output."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"  # `su` leaves those two out
    name = Path(words[0]).name
    try:
        done = subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            env={**os.environ, "PATH": path, **environment},
        )
    except FileNotFoundError as error:
        raise EdgevprError(f"{name} is not on this machine; {_AGAIN}.") from error
    if done.returncode:
        lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("ERROR: ")]  # pip's: its last line may advise an upgrade
        said = (errors or lines or [f"exit code {done.returncode}"])[-1]
        raise EdgevprError(f"{name}: {said.removeprefix('ERROR: ').rstrip('.')}; {_AGAIN}.")


def is_told(*words: str | Path) -> bool:
    """Run a program and tell whether its exit code is 0; False also if the program is not installed."""
    try:
        return subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0
    except OSError:
        return False


def program_steps(venv: Path) -> tuple[Step, ...]:
    """Return the steps that make the virtual environment `venv`, with the packages that edgevpr needs, a copy of the
    running edgevpr, and compiled bytecode."""
    lock = shipped("deploy") / "requirements.lock"
    compileall = (venv / "bin" / "python", "-I", "-m", "compileall", "-q")
    return (
        Step(f"virtual environment in /{VENV}", lambda: is_told(*_pip(venv), "--version"), lambda: _make_venv(venv)),
        Step(
            f"packages of {lock.name}, by their hashes",
            lambda: _has_packages(venv, lock),
            lambda: _install_packages(venv, lock),
        ),
        Step(f"edgevpr {edgevpr.__version__}", lambda: _is_copied(venv), lambda: _copy_edgevpr(venv)),
        Step(
            "compiled bytecode, for a quick start",
            lambda: _is_compiled(venv),
            lambda: command(*compileall, _site(venv) / NAME),
        ),
    )


def remove_program(path: Path) -> None:
    """Remove the virtual environment at `path`. Raises EdgevprError if something else is there."""
    if not (path / "pyvenv.cfg").is_file():
        raise EdgevprError(f"{path} is no virtual environment: look at it, and remove it by hand.")
    shutil.rmtree(path)


def _pip(venv: Path) -> tuple[str | Path, ...]:
    return venv / "bin" / "python", "-I", "-m", "pip", "--disable-pip-version-check", "--no-input"


def _site(venv: Path) -> Path:
    """Return the site-packages folder of an environment; if it has none, its `lib`, in which nothing will be found."""
    return next(venv.glob("lib/python3*/site-packages"), venv / "lib")


def _make_venv(path: Path) -> None:
    if util.find_spec("ensurepip") is None:
        raise EdgevprError("Python's venv module is missing: `apt install python3-venv`, then run it again.")
    is_own = (path / "pyvenv.cfg").is_file()
    if not is_own and path.exists() and any(path.iterdir()):
        raise EdgevprError(f"{path} holds something that is no virtual environment: move it away.")
    _require_stopped()
    # If an upgrade of the system has removed the environment's Python, it cannot be mended: it is made anew.
    clear = ("--clear",) if is_own and Path(sys.prefix).resolve() != path.resolve() else ()
    command(sys.executable, "-I", "-m", "venv", *clear, path)


def _require_stopped() -> None:
    """Raise EdgevprError while the service runs: what it imports later would be of another version."""
    if is_told("systemctl", "is-active", "--quiet", NAME):
        raise EdgevprError(f"The service runs: `systemctl stop {NAME}` on the ground, then run it again.")


def _broken(venv: Path) -> list[Path]:
    """List the packages that an interrupted run has left incomplete (without RECORD), which pip takes for complete."""
    return [folder for folder in _site(venv).glob("*.dist-info") if not (folder / "RECORD").is_file()]


def _has_packages(venv: Path, lock: Path) -> bool:
    """Tell whether all packages of the file `lock` for this Python are completely installed. If so, pip succeeds
    although it is given no place to get packages from."""
    asked = ("--isolated", "install", "--no-index", "--require-hashes", "--requirement", lock)
    return not _broken(venv) and is_told(*_pip(venv), *asked)


def _install_packages(venv: Path, lock: Path) -> None:
    _require_stopped()
    for folder in _broken(venv):
        shutil.rmtree(folder)
    room = venv / "unfinished"  # /tmp may be memory, of which a small board has too little
    shutil.rmtree(room, ignore_errors=True)
    room.mkdir()
    try:
        words = ("install", "--require-hashes", "--only-binary", ":all:", "--requirement", lock)
        command(*_pip(venv), *words, TMPDIR=str(room))
    finally:
        shutil.rmtree(room)


def _own_files() -> dict[str, Path]:
    """Return the files of the running edgevpr, by their path relative to site-packages. Shipped data files may lie
    beside the package, in a checkout."""
    package = Path(edgevpr.__file__).parent
    folders = {NAME: package} | {f"{NAME}/shipped/{kind}": shipped(kind) for kind in _SHIPPED}
    return {
        f"{name}/{path.relative_to(folder).as_posix()}": path
        for name, folder in folders.items()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name != "__pycache__"
    }


def _is_copied(venv: Path) -> bool:
    site, script = _site(venv), venv / "bin" / NAME
    return script.is_file() and all(
        (site / name).is_file() and filecmp.cmp(path, site / name, shallow=False) for name, path in _own_files().items()
    )


def _copy_edgevpr(venv: Path) -> None:
    """Copy the running edgevpr into the environment. It may be a checkout, an installed one, or that of the service
    itself. No network and no tool to build it is needed."""
    _require_stopped()
    site, room = _site(venv), venv / "unfinished"
    shutil.rmtree(room, ignore_errors=True)
    for name, path in _own_files().items():
        (room / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, room / name)
    for old in (site / NAME, *site.glob(f"{NAME}-*.dist-info")):
        shutil.rmtree(old, ignore_errors=True)
    (room / NAME).rename(site / NAME)
    room.rmdir()
    script = venv / "bin" / NAME
    script.write_text(_SCRIPT.format(python=venv / "bin" / "python"), "utf-8")
    script.chmod(0o755)


def _is_compiled(venv: Path) -> bool:
    modules = list((_site(venv) / NAME).rglob("*.py"))
    return bool(modules) and all(any((path.parent / "__pycache__").glob(f"{path.stem}.*.pyc")) for path in modules)
