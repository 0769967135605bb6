"""`edgevpr service`: prints the unit of the service; makes its user, folders, configuration, unit and udev rules, and
removes them again. Maps, flight logs and the configuration stay.

The program is the running edgevpr, which pip has installed in a virtual environment (deploy/README.md). Each step may
be repeated, so that a run after an interrupted one completes the work."""

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import shipped, write_whole
from edgevpr.core.text import printable
from edgevpr.power.boards import Board, load_board

NAME = "edgevpr"  # of the package, its command, the service, its user and the user's group
_VENV = "opt/edgevpr"  # below the root; not below /home, which the service cannot see
_AGAIN = "correct that and run it again: what is done stays"
_CONFIG = "etc/edgevpr/config.yaml"
_UNIT, _RULES = "etc/systemd/system/edgevpr.service", "etc/udev/rules.d/99-edgevpr.rules"
_MAPS, _LOGS = "var/lib/edgevpr", "var/log/edgevpr"
_GROUPS = "dialout,video"  # of serial ports and cameras
_BOOTED = "run/systemd/system"  # sd_booted(3)
# The unit's ProtectHome and PrivateTmp show the service empty folders instead of these.
_HIDDEN_FROM_THE_SERVICE = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")

Step = tuple[str, Callable[[], object]]  # what it brings about, in words, and what to call

_FIRST_CONFIG = """\
# Written by `edgevpr service install`. It needs only the keys that differ from the defaults; deploy/config.yaml of
# edgevpr explains them all. Before the first flight: the map, the camera and the flight controller.
# map: /var/lib/edgevpr/valley.gpkg
# source: {uri: /dev/edgevpr-camera}
# mavlink: {link: "serial:/dev/edgevpr-fc:921600"}
log: {path: /var/log/edgevpr/flight.jsonl}
"""


def render_unit(board: Board) -> str:
    """Return the text of deploy/edgevpr.service with the limits of a board."""
    changed = {
        "# Board: ": printable(board.name),
        "MemoryMax=": f"{board.memory_max_mb * 1e6:.0f}",
        "CPUQuota=": f"{100 * board.cpu_share * board.cores:.0f}%",
    }
    keys = re.compile(f"(?m)^({'|'.join(changed)}).*$")
    text = (shipped("deploy") / "edgevpr.service").read_text(encoding="utf-8")
    return keys.sub(lambda line: line[1] + changed[line[1]], text)


def install(config: Path | None, dry_run: bool, say: Callable[[str], None], root: Path = Path("/")) -> None:
    """Install the service on this machine. Raises EdgevprError, one sentence, if a step fails.

    The file `config` is copied and becomes the configuration of the service (None: an existing one stays; without one,
    a first one is written). With `dry_run` nothing is changed. `say` is called with a line about each step. `root` is
    the root of the file system, another folder in tests.
    """
    if not dry_run:
        _require_right_to_change(root)
    if sys.maxsize < 2**32:
        raise UsageError(f"This system has not 64 bits ({platform.machine()}): install the 64-bit edition of it first.")
    there = root / _CONFIG
    written = config or (there if there.exists() else None)
    content = written.read_bytes() if written else _FIRST_CONFIG.encode()
    unit = render_unit(load_board(load_config(written).board if written else "this"))
    rules = (shipped("deploy") / "99-edgevpr.rules").read_bytes()
    steps: tuple[Step, ...] = (
        (f"system user {NAME}, without a login, in the groups {_GROUPS}", _make_user),
        *(
            (f"folder /{name}", partial(_run, "install", "-d", "-o", NAME, "-g", NAME, root / name))
            for name in (_MAPS, _LOGS)
        ),
        (f"configuration in /{_CONFIG}", lambda: _put(root / _CONFIG, content)),
        (f"unit, with the limits of the board, in /{_UNIT}", lambda: _put(root / _UNIT, unit.encode())),
        (f"udev rules in /{_RULES}", lambda: _put(root / _RULES, rules)),
        ("systemd has read the unit", lambda: _reload_units(root)),
        ("udev has read its rules, and named what is plugged in", _reload_rules),
    )
    _take_steps(steps, dry_run, say)


def uninstall(dry_run: bool, say: Callable[[str], None], root: Path = Path("/")) -> None:
    """Stop the service and remove what `install` has made, except maps, flight logs, the configuration and the user."""
    if not dry_run:
        _require_root(root)
    stop = ("systemctl", "disable", "--now", NAME)
    steps: tuple[Step, ...] = (
        ("service stopped and not started any more", lambda: _run(*stop) if (root / _UNIT).exists() else None),
        *((f"no /{name}", partial((root / name).unlink, missing_ok=True)) for name in (_UNIT, _RULES)),
        ("systemd has read that the unit is gone", lambda: _reload_units(root)),
        ("udev has read that its rules are gone", _reload_rules),
        # Last, since this may be the very program that runs.
        (f"no /{_VENV}", lambda: _remove_environment(root / _VENV)),
    )
    _take_steps(steps, dry_run, say)
    say(f"kept   /{_CONFIG}, /{_MAPS}, /{_LOGS} and the user {NAME}, to whom they belong")


def _take_steps(steps: Iterable[Step], dry_run: bool, say: Callable[[str], None]) -> None:
    """Carry out the steps in order, or none with `dry_run`; `say` gets a line about each. Raises EdgevprError for the
    first step that fails."""
    before = os.umask(0o022)  # the service's user is to read what root writes
    try:
        for what, take in steps:
            say(f"step   {what}")
            if not dry_run:
                try:
                    take()
                    os.sync()  # so that a finished step stays finished after a power cut
                except OSError as error:
                    where = f"{error.filename}: " if error.filename else ""
                    raise EdgevprError(f"{what}: {where}{error.strerror or error}; {_AGAIN}.") from error
    finally:
        os.umask(before)


def _require_right_to_change(root: Path) -> None:
    _require_root(root)
    if Path(sys.prefix).resolve() != (root / _VENV).resolve():
        raise UsageError(
            f"The service runs the edgevpr in /{_VENV}, and this one is in {sys.prefix}: install it there by pip "
            f"(deploy/README.md), and run /{_VENV}/bin/edgevpr service install."
        )
    for folder in _HIDDEN_FROM_THE_SERVICE if root == Path("/") else ():
        if Path(sys.base_prefix).resolve().is_relative_to(folder):
            raise EdgevprError(
                f"The service cannot see {sys.base_prefix}, where this Python is: make /{_VENV} with the system's "
                "(/usr/bin/python3 -m venv)."
            )
    if _succeeds("systemctl", "is-active", "--quiet", NAME):
        raise EdgevprError(f"The service runs: `systemctl stop {NAME}` on the ground, then run it again.")


def _require_root(root: Path) -> None:
    if root == Path("/") and os.geteuid() != 0:
        raise EdgevprError("Only root may change the system: run it again with sudo (--dry-run needs none).")


def _make_user() -> None:
    if not _succeeds("id", NAME):
        shell = ("--home-dir", f"/{_MAPS}", "--shell", "/usr/sbin/nologin")
        _run("useradd", "--system", "--user-group", *shell, NAME)
    _run("usermod", "--append", "--groups", _GROUPS, NAME)


def _put(path: Path, content: bytes) -> None:
    """Write a file, completely or not at all. A different file in its place is kept, as NAME.old."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and path.read_bytes() != content:
        shutil.copy2(path, path.with_name(f"{path.name}.old"))
    write_whole(path, lambda unfinished: unfinished.write_bytes(content))


def _reload_units(root: Path) -> None:
    if not (root / _BOOTED).is_dir():
        raise EdgevprError(f"systemd, which the service needs, does not run here: start the machine with it; {_AGAIN}.")
    _run("systemctl", "daemon-reload")


def _reload_rules() -> None:
    _run("udevadm", "control", "--reload")
    subsystems = ("tty", "video4linux", "media", "dma_heap")
    _run("udevadm", "trigger", *(f"--subsystem-match={name}" for name in subsystems))


def _run(*words: str | Path) -> None:
    """Run a program, `words` being its name and arguments. If it fails, raise EdgevprError with the last line of its
    output."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"  # `su` leaves those two out
    name, variables = Path(words[0]).name, {**os.environ, "PATH": path}
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", env=variables
        )
    except FileNotFoundError as error:
        raise EdgevprError(f"{name} is not on this machine; {_AGAIN}.") from error
    if done.returncode:
        lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        problem = (lines or [f"exit code {done.returncode}"])[-1]
        raise EdgevprError(f"{name}: {problem.rstrip('.')}; {_AGAIN}.")


def _succeeds(*words: str | Path) -> bool:
    """Run a program; return True if its exit code is 0, False also if it is not installed."""
    try:
        return subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0
    except OSError:
        return False


def _remove_environment(venv: Path) -> None:
    """Remove the virtual environment, if there is one. Raises EdgevprError if something else is there."""
    if venv.exists() and not (venv / "pyvenv.cfg").is_file():
        raise EdgevprError(f"{venv} is not a virtual environment: remove it by hand.")
    if venv.exists():
        shutil.rmtree(venv)
