"""Findings of `edgevpr check` and `edgevpr doctor`: what was checked, whether it is fine, and what to change; and the
checks of this machine: limits of its control groups, devices, and free room on disk."""

import getpass
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
from edgevpr.mavlink.tlog import SPARED_BYTES
from edgevpr.power import machine
from edgevpr.power.boards import load_board

LOG_ROOM_MB = 10  # some hours of queries
_NOBODYS_GROUPS = ("root", "tty")  # devices of these are held by a login shell, or kept from all users: none is to join


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


def judged(what: str, ok: bool, good: str, bad: str, *changes: str) -> Finding:
    """Return a fine finding with the text `good` if `ok`, else a wrong one with the text `bad` and the `changes`."""
    return fine(what, good) if ok else wrong(what, bad, *changes)


def looked_at(what: str, look: Callable[[], str]) -> Finding:
    """Return a finding: fine with the text that `look` returns, or wrong with the error that it raises."""
    try:
        return fine(what, look())
    except EdgevprError as error:
        return wrong(what, str(error), exit_code=error.exit_code)
    except OSError as error:
        return wrong(what, f"{error.filename}: {error.strerror}: check the path and its permissions.")


def lines(findings: Iterable[Finding]) -> Iterator[str]:
    """Yield the findings as lines of text: one for each finding, then one for each of its changes."""
    for finding in findings:
        yield f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}"
        yield from (f"{'':<22}change: {change}" for change in finding.changes)


def board_findings(config: Config, address: LinkAddress | None, root: Path = Path("/")) -> Iterator[Finding]:
    """Check this machine for a flight with `config` over the link `address` (None: no link). `root` is the root of the
    file system with /proc, /sys and /dev. Raises ConfigError if the board is unknown."""
    yield _memory(load_board(config.board).memory_max_mb, root)
    if address and address.kind == "serial":
        yield device("serial", address.where, root)
    yield from log_findings(config.log, has_link=config.mavlink.link is not None)


def device(what: str, path: str, root: Path = Path("/")) -> Finding:
    """Check that a device file exists, that this user may use it, and that no other program holds it, nor a console if
    it is a serial port. `what` names the check in the finding."""
    file = root / path.lstrip("/")
    try:
        status = file.stat()
    except OSError as error:
        return wrong(what, f"{path}: {error.strerror}: connect it, or correct the name.")
    if not stat.S_ISCHR(status.st_mode):
        return wrong(what, f"{path} is no device: correct the name.")
    group = str(status.st_gid)
    with suppress(KeyError):
        group = grp.getgrgid(status.st_gid).gr_name
    mode = f"group {group}, mode {stat.S_IMODE(status.st_mode):04o}"
    may_use, user = os.access(file, os.R_OK | os.W_OK), _user_name()
    held, changes = _held(file.resolve(), root) if what == "serial" else _opened(file.resolve(), root)
    if held:
        return wrong(what, f"{path} ({mode}) is not free: {held}.", *changes)
    denied = f"{path} may not be used by {user or f'user {os.getuid()}'} ({mode})"
    if not may_use and group in _NOBODYS_GROUPS:
        why = ": a login shell on it is the usual reason" if changes else ""
        return wrong(what, f"{denied}{why}.", *(changes or ("install the udev rules 99-edgevpr.rules of edgevpr",)))
    if not may_use and user is None:
        return wrong(what, f"{denied}: start the container with the group.", f"--group-add {status.st_gid}")
    if not may_use:
        return wrong(
            what, f"{denied}: log in again after the change.", f"sudo usermod --append --groups {group} {user}"
        )
    return fine(what, f"{path}, {mode}")


def _user_name() -> str | None:
    """Return the name of this user; None for a user of a number only, as of `docker run --user`."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the latter from Python 3.13 on
        return None


def log_findings(log: LogConfig, has_link: bool) -> Iterator[Finding]:
    """Check that the flight log can be written and, if there is a link, the tlog (the log of all MAVLink packets)."""
    if path := log.path:
        yield looked_at("log", lambda: _room(path, "path", LOG_ROOM_MB))
    else:
        yield fine("log", "none, so nothing of the flight is kept")
    if (tlog := log.tlog) and has_link:
        yield looked_at("tlog", lambda: _room(tlog, "tlog", SPARED_BYTES / 1e6 + LOG_ROOM_MB))
    elif tlog:
        yield fine("tlog", "none, since there is no link")


def _room(file: str, key: str, needed_mb: float) -> str:
    # A log is not opened for the check: if root checked, it would leave a file that the service may not write.
    path = Path(file).absolute()
    if path.is_dir() or not path.parent.is_dir():
        raise EdgevprError(f"{path} is no file in a folder that is there: correct `log: {{{key}: ...}}`.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise EdgevprError(f"{path} may not be written by this user: change its permissions or `log: {{{key}: ...}}`.")
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    if free_mb < needed_mb:
        raise EdgevprError(f"{path}: only {free_mb:.1f} MB are free there, {needed_mb:g} are needed: make room.")
    return str(path)


def _memory(needed_mb: float, root: Path) -> Finding:
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


def _held(port: Path, root: Path) -> tuple[str | None, tuple[str, ...]]:
    """Return what holds the serial port (None: nothing is found), and the changes that free it from it; if nothing is
    found, those that free it from a login shell."""
    console = _console_on(port, root)
    program, is_login = _program_on(port, root)
    held = [f"console={console} makes it the console of the kernel, which writes into the link"] if console else []
    held += [f"{program} {'lets people log in on it' if is_login else 'has it open'}"] if program else []
    if program and not (console or is_login):
        return held[0], (f"stop {program}",)
    if "Raspberry Pi" in (machine.model(root) or ""):
        change = "sudo raspi-config, Interface Options, Serial Port: login shell no, hardware yes; then reboot"
        return " and ".join(held) or None, (change,)
    changes = [f"remove console={console} from the kernel's command line (cmdline.txt), and reboot"] if console else []
    return " and ".join(held) or None, (*changes, f"sudo systemctl disable --now serial-getty@{console or port.name}")


def _opened(file: Path, root: Path) -> tuple[str | None, tuple[str, ...]]:
    """Return what has a device open (None: nothing is found), and the change that frees it."""
    program, _ = _program_on(file, root)
    return (f"{program} has it open", (f"stop {program}",)) if program else (None, ())


def _console_on(port: Path, root: Path) -> str | None:
    """Return the name of a port as the kernel's console, now or after the next start, e.g. "ttyS0"; None if the kernel
    has no console on it."""
    lines = (machine.text(root / name) or "" for name in ("proc/cmdline", "boot/firmware/cmdline.txt"))
    words = " ".join(lines).split()
    consoles = (word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console="))
    return next((console for console in consoles if (root / "dev" / console).resolve() == port), None)


def _program_on(port: Path, root: Path) -> tuple[str | None, bool]:
    """Return the program that uses a port, as "NAME (process PID)", None if none is seen; and whether the port is its
    terminal, as it is of a getty and a login shell. Open files are seen of this user's programs only, or by root."""
    device = port.stat().st_rdev
    major, minor = os.major(device), os.minor(device)
    terminal = str(minor & 0xFF | major << 8 | (minor & ~0xFF) << 12)  # the number that proc(5) calls tty_nr
    others = [each for each in (root / "proc").glob("[0-9]*") if each.name != str(os.getpid())]
    for process in sorted(others, key=lambda each: int(each.name)):
        start, _, stat_fields = (machine.text(process / "stat") or "").rpartition(")")
        named = f"{start.partition('(')[2]} (process {process.name})"
        if stat_fields.split()[4:5] == [terminal]:
            return named, True
        with suppress(OSError):
            if any(each.resolve() == port for each in (process / "fd").iterdir()):
                return named, False
    return None, False
