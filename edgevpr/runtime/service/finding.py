"""Findings of `edgevpr check` and `edgevpr doctor`, and the checks of this machine: memory, devices, and the disk of
the logs."""

import grp
import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from edgevpr.core.config import Config, LogConfig
from edgevpr.core.errors import EdgevprError
from edgevpr.mavlink.address import LinkAddress
from edgevpr.power import machine
from edgevpr.power.boards import load_board

LOG_ROOM_MB = 10  # some hours of queries
_SYSTEM_GROUPS = ("root", "tty")  # no user is to join them: a login shell holds the device, or a udev rule is missing


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of one check. `what`: name of what was checked. `message`: a description of it or, if it is not `ok`, one
    sentence that says what is wrong. `changes`: the exact changes that put it right, such as `GPS2_TYPE=14`.
    `exit_code`: that of a command with such a result, and of a flight that would end by it."""

    what: str
    ok: bool
    message: str
    changes: tuple[str, ...] = ()
    exit_code: int = 0


def fine(what: str, message: str) -> Finding:
    """Return a finding with nothing to change."""
    return Finding(what=what, ok=True, message=message)


def wrong(what: str, message: str, *changes: str, exit_code: int = 1) -> Finding:
    """Return a finding with something wrong, which `changes` put right."""
    return Finding(what=what, ok=False, message=message, changes=changes, exit_code=exit_code)


def judge(what: str, ok: bool, good: str, bad: str, *changes: str) -> Finding:
    """Return a fine finding with the text `good` if `ok`, else a wrong one with the text `bad` and the `changes`."""
    return fine(what, good) if ok else wrong(what, bad, *changes)


def run_check(what: str, check: Callable[[], str]) -> Finding:
    """Return a finding: fine with the text that `check` returns, or wrong with the error that it raises."""
    try:
        return fine(what, check())
    except EdgevprError as error:
        return wrong(what, str(error), exit_code=error.exit_code)
    except OSError as error:
        return wrong(what, f"{error.filename}: {error.strerror}: check the path and its permissions.")


def format_findings(findings: Iterable[Finding]) -> Iterator[str]:
    """Yield the findings as lines of text: one for each finding, then one for each of its changes."""
    for finding in findings:
        yield f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}"
        yield from (f"{'':<22}change: {change}" for change in finding.changes)


def check_machine(config: Config, address: LinkAddress | None, root: Path = Path("/")) -> Iterator[Finding]:
    """Check this machine for a flight with `config` over the link `address` (None: no link). `root` is the root of the
    file system with /proc, /sys and /dev. Raises ConfigError if the board is unknown."""
    yield _check_memory(load_board(config.board).memory_max_mb, root)
    if address and address.kind == "serial":
        yield check_device("serial", address.where, root)
    yield check_log(config.log)


def check_device(what: str, path: str, root: Path = Path("/")) -> Finding:
    """Check that a device file exists, that no other program has it open, and that this user may use it; and that a
    serial port is not a console. `what` names the check in the finding."""
    file = root / path.lstrip("/")
    try:
        status, port = file.stat(), file.resolve()
    except OSError as error:
        return wrong(what, f"{path}: {error.strerror}: connect it, or correct the name.")
    if not stat.S_ISCHR(status.st_mode):
        return wrong(what, f"{path} is not a device: correct the name.")
    is_serial, no_login = what == "serial", f"sudo systemctl disable --now serial-getty@{port.name}"
    if is_serial and (console := _find_console(port, root)):
        no_console = f"remove console={console} from the kernel's command line (cmdline.txt), and reboot"
        return wrong(what, f"{path} is the console of the kernel, which writes into the link.", no_console, no_login)
    program, is_login = _find_program(port, root)
    if program:
        return wrong(what, f"{path} is in use by {program}.", no_login if is_login else f"stop {program}")
    group = str(status.st_gid)
    with suppress(KeyError):
        group = grp.getgrgid(status.st_gid).gr_name
    mode = f"{path}, group {group}, mode {stat.S_IMODE(status.st_mode):04o}"
    if os.access(file, os.R_OK | os.W_OK):
        return fine(what, mode)
    change = f"sudo usermod --append --groups {group} USER, and log in; in a container --group-add {status.st_gid}"
    if group in _SYSTEM_GROUPS:
        change = no_login if is_serial else "install the udev rules 99-edgevpr.rules of edgevpr"
    return wrong(what, f"{mode}: user {os.getuid()} has no access.", change)


def check_log(log: LogConfig) -> Finding:
    """Check that the flight log can be written."""
    if path := log.path:
        return run_check("log", lambda: _require_room(path))
    return fine("log", "none, so nothing of the flight is kept")


def _require_room(file: str) -> str:
    # A log is not opened for the check: if root checked, it would leave a file that the service may not write.
    path = Path(file).absolute()
    if path.is_dir() or not path.parent.is_dir():
        raise EdgevprError(f"{path} is not a file in an existing folder: correct `log: {{path: ...}}`.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise EdgevprError(f"{path} may not be written by this user: change its permissions or `log: {{path: ...}}`.")
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    if free_mb < LOG_ROOM_MB:
        raise EdgevprError(f"{path}: only {free_mb:.1f} MB are free there, {LOG_ROOM_MB} are needed: make room.")
    return str(path)


def _check_memory(needed_mb: float, root: Path) -> Finding:
    limit_mb = machine.ram_limit_mb(root)
    limit = f"{limit_mb:.0f} of {machine.ram_mb(root):.0f} MB for this process"
    controllers = machine.text(root / "sys/fs/cgroup/cgroup.controllers")
    if controllers is not None and "memory" not in controllers.split():
        without = f"{limit}; the kernel runs without the memory controller, so no limit of the service is kept."
        return wrong("memory", without, "cgroup_enable=memory in /boot/firmware/cmdline.txt, and reboot")
    if limit_mb < needed_mb:
        less = f"{limit}: less than what the profile of the board spares for edgevpr."
        return wrong("memory", less, f"MemoryMax={1e6 * needed_mb:.0f}")
    return fine("memory", limit)


def _find_console(port: Path, root: Path) -> str | None:
    """Return the name of a port as the kernel's console, now or after the next start, e.g. "ttyS0"; None if the kernel
    has no console on it."""
    texts = (machine.text(root / name) or "" for name in ("proc/cmdline", "boot/firmware/cmdline.txt"))
    words = " ".join(texts).split()
    consoles = (word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console="))
    return next((console for console in consoles if (root / "dev" / console).resolve() == port), None)


def _find_program(port: Path, root: Path) -> tuple[str | None, bool]:
    """Return the program that uses a device, as "NAME (process PID)", None if none is seen; and whether the device is
    its terminal, as it is of a login shell. Only root sees the open files of other users' programs."""
    device = port.stat().st_rdev
    major, minor = os.major(device), os.minor(device)
    terminal = str(minor & 0xFF | major << 8 | (minor & ~0xFF) << 12)  # the number that proc(5) calls tty_nr
    for process in sorted((root / "proc").glob("[0-9]*"), key=lambda folder: int(folder.name)):
        if process.name == str(os.getpid()):
            continue
        start, _, stat_fields = (machine.text(process / "stat") or "").rpartition(")")
        name = f"{start.partition('(')[2]} (process {process.name})"
        if stat_fields.split()[4:5] == [terminal]:
            return name, True
        with suppress(OSError):
            if any(file.resolve() == port for file in (process / "fd").iterdir()):
                return name, False
    return None, False
