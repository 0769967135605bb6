"""The program of the service: a virtual environment (`venv`) with a copy of the running edgevpr and the packages that
it needs. The functions are steps of `install`. Each may be repeated, so that a run after an interrupted one completes
the work."""

import os
import shutil
import subprocess
import sys
from importlib import util
from pathlib import Path

import edgevpr
from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import shipped

NAME = "edgevpr"  # of the package, its command, the service, its user and the user's group
VENV = "opt/edgevpr"  # below the root; not below /home, which the service cannot see
AGAIN = "correct that and run it again: what is done stays"
_UNFINISHED = "unfinished"  # the file that is in the environment while packages are installed
_SHIPPED = ("profiles", "models", "deploy")
_SCRIPT = "#!{python}\nimport sys\n\nfrom edgevpr.cli.main import program\n\nsys.exit(program())\n"


def command(*words: str | Path, **environment: str) -> None:
    """Run a program, `words` being its name and arguments, with `environment` added to our variables. If it fails,
    raise EdgevprError with the last line of its output."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"  # `su` leaves those two out
    name, variables = Path(words[0]).name, {**os.environ, "PATH": path, **environment}
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", env=variables
        )
    except FileNotFoundError as error:
        raise EdgevprError(f"{name} is not on this machine; {AGAIN}.") from error
    if done.returncode:
        lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("ERROR: ")]  # pip's: its last line may advise an upgrade
        said = (errors or lines or [f"exit code {done.returncode}"])[-1]
        raise EdgevprError(f"{name}: {said.removeprefix('ERROR: ').rstrip('.')}; {AGAIN}.")


def is_told(*words: str | Path) -> bool:
    """Run a program and tell whether its exit code is 0; False also if the program is not installed."""
    try:
        return subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0
    except OSError:
        return False


def make_environment(venv: Path) -> None:
    """Make the virtual environment; if an interrupted run has left it unfinished, or an upgrade of the system has taken
    its Python, make it anew."""
    if util.find_spec("ensurepip") is None:
        raise EdgevprError("Python's venv module is missing: `apt install python3-venv`, then run it again.")
    is_own = (venv / "pyvenv.cfg").is_file()
    if not is_own and venv.exists() and any(venv.iterdir()):
        raise EdgevprError(f"{venv} holds something that is no virtual environment: move it away.")
    if Path(sys.prefix).resolve() == venv.resolve():  # it is this very program
        return
    if (venv / _UNFINISHED).exists() or not is_told(venv / "bin" / "python", "-I", "-m", "pip", "--version"):
        command(sys.executable, "-I", "-m", "venv", *(("--clear",) if is_own else ()), venv)


def install_packages(venv: Path) -> None:
    """Install the packages that edgevpr needs, and check them by their hashes. Without a network this succeeds if all
    are installed already."""
    pip = (venv / "bin" / "python", "-I", "-m", "pip", "--disable-pip-version-check", "--no-input", "install")
    lock = shipped("deploy") / "requirements.lock"
    (venv / _UNFINISHED).touch()
    try:  # /tmp may be memory, of which a small board has too little
        command(*pip, "--require-hashes", "--only-binary", ":all:", "--requirement", lock, TMPDIR=str(venv))
    finally:
        (venv / _UNFINISHED).unlink()


def copy_edgevpr(venv: Path) -> None:
    """Copy the running edgevpr, a checkout or an installed one, into the environment, and compile it for a quick start.
    This needs no network and no tool to build it."""
    (site,) = venv.glob("lib/python3*/site-packages")
    room = venv / "new"
    shutil.rmtree(room, ignore_errors=True)
    without_bytecode = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(edgevpr.__file__).parent, room, ignore=without_bytecode)
    for kind in _SHIPPED:  # in a checkout they lie beside the package
        shutil.copytree(shipped(kind), room / "shipped" / kind, ignore=without_bytecode, dirs_exist_ok=True)
    shutil.rmtree(site / NAME, ignore_errors=True)
    room.rename(site / NAME)
    script = venv / "bin" / NAME
    script.write_text(_SCRIPT.format(python=venv / "bin" / "python"), "utf-8")
    script.chmod(0o755)
    command(venv / "bin" / "python", "-I", "-m", "compileall", "-q", site / NAME)


def remove_program(venv: Path) -> None:
    """Remove the virtual environment, if there is one. Raises EdgevprError if something else is there."""
    if venv.exists() and not (venv / "pyvenv.cfg").is_file():
        raise EdgevprError(f"{venv} is no virtual environment: look at it, and remove it by hand.")
    if venv.exists():
        shutil.rmtree(venv)
