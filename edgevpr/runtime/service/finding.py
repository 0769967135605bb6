"""Findings of `edgevpr check` and `edgevpr doctor`, and the checks of this machine: memory, devices and log disk."""

import grp
import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edgevpr.core.config import LogConfig
from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import find_shipped
from edgevpr.core.reasons import Code, Reason, ReasonCode
from edgevpr.mavlink.address import LinkAddress
from edgevpr.power import machine
from edgevpr.power.boards import Board
from edgevpr.runtime.service.findingcodes import FindingCode

MIN_LOG_SPACE_MB = 10  # a few hours of queries
_SYSTEM_GROUPS = ("root", "tty")  # users are not members: a login shell uses the device, or a udev rule is missing


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of one check. `what`: name of the item checked. `reason`: the result, as a code with parameters.
    `changes`: the exact changes that fix the item if it is not `ok`, such as `GPS2_TYPE=14`. `exit_code`: exit code of
    the command, and of a flight that would end because of this fault."""

    what: str
    ok: bool
    reason: Reason
    changes: tuple[str, ...] = ()
    exit_code: int = 0

    def fields(self) -> dict[str, Any]:
        """Return the finding as fields of JSON."""
        return {
            "what": self.what,
            "level": "ok" if self.ok else "wrong",
            **self.reason.fields(),
            "changes": self.changes,
            "exit_code": self.exit_code,
        }


def report_ok(what: str, code: Code, **parameters: float | str | None) -> Finding:
    """Return a finding that needs no change."""
    return Finding(what=what, ok=True, reason=Reason(code, parameters))


def report_fault(what: str, code: Code, *changes: str, **parameters: float | str | None) -> Finding:
    """Return a finding of a fault that `changes` fix."""
    return Finding(what=what, ok=False, reason=Reason(code, parameters), changes=changes, exit_code=1)


def report_error(what: str, error: EdgevprError) -> Finding:
    """Return the finding for an error that would end a flight."""
    return replace(report_fault(what, ReasonCode.UNUSABLE, problem=str(error)), exit_code=error.exit_code)


def run_check(what: str, check: Callable[[str], Finding]) -> Finding:
    """Call `check` with the name `what`. Return its finding or, if it raises an error, a finding for that error."""
    try:
        return check(what)
    except EdgevprError as error:
        return report_error(what, error)
    except OSError as error:
        return report_fault(what, FindingCode.FILE_UNUSABLE, path=str(error.filename), problem=error.strerror)


def format_findings(findings: Iterable[Finding]) -> Iterator[str]:
    """Yield lines of text: one for each finding, each followed by one line for each of its changes."""
    for finding in findings:
        yield f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.reason}"
        yield from (f"{'':<22}change: {change}" for change in finding.changes)


def check_machine(
    board: Board, log: LogConfig, address: LinkAddress | None, root: Path = Path("/")
) -> Iterator[Finding]:
    """Check this machine's memory, serial port and log disk against the needs of a flight with the profile `board`.
    `address`: the MAVLink link (None: no link). `root`: root of the file system that contains /proc, /sys and /dev."""
    yield _check_memory(board.memory_max_mb, root)
    if address and address.kind == "serial":
        yield check_device("serial", address.target, root)
    yield run_check("log", lambda what: check_log(what, log.path))


def check_device(what: str, path: str, root: Path = Path("/")) -> Finding:
    """Check that a device file exists, that no other program has it open, and that this user may access it. If `what`,
    the name of the finding, is "serial", also check that the port is not a console."""
    file = root / path.lstrip("/")
    try:
        status, port = file.stat(), file.resolve()
    except OSError as error:
        return report_fault(what, FindingCode.DEVICE_ABSENT, path=path, problem=error.strerror)
    if not stat.S_ISCHR(status.st_mode):
        return report_fault(what, FindingCode.NOT_A_DEVICE, path=path)
    is_serial, disable_login = what == "serial", f"sudo systemctl disable --now serial-getty@{port.name}"
    if is_serial and (console := _find_console(port, root)):
        return report_fault(what, FindingCode.PORT_IS_CONSOLE, disable_login, path=path, console=console)
    program, is_login = _find_program(port, root)
    if program:
        changes = [disable_login] if is_login else []
        return report_fault(what, FindingCode.DEVICE_IN_USE, *changes, path=path, program=program)
    group = str(status.st_gid)
    with suppress(KeyError):
        group = grp.getgrgid(status.st_gid).gr_name
    access = {"path": path, "group": group, "mode": f"{stat.S_IMODE(status.st_mode):04o}"}
    if os.access(file, os.R_OK | os.W_OK):
        return report_ok(what, FindingCode.DEVICE_READY, **access)
    changes = [f"sudo usermod --append --groups {group} USER", f"docker run --group-add {status.st_gid}"]
    if group in _SYSTEM_GROUPS:
        rules = find_shipped("deploy") / "99-edgevpr.rules"
        changes = [disable_login if is_serial else f"sudo install -D -m 644 -t /etc/udev/rules.d {rules}"]
    return report_fault(what, FindingCode.DEVICE_DENIED, *changes, user=os.getuid(), **access)


def check_log(what: str, file: str | None) -> Finding:
    """Check that the flight log `file` can be written (None or empty: no log is configured)."""
    if not file:
        return report_ok(what, FindingCode.NO_LOG)
    # Do not open the log for this check: as root, this would create a file that the service cannot write.
    path = Path(file).absolute()
    if path.is_dir() or not path.parent.is_dir():
        return report_fault(what, FindingCode.LOG_NOT_A_FILE, path=str(path))
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        return report_fault(what, FindingCode.LOG_NOT_WRITABLE, path=str(path))
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    if free_mb < MIN_LOG_SPACE_MB:
        return report_fault(what, FindingCode.DISK_FULL, path=str(path), free_mb=free_mb, needed_mb=MIN_LOG_SPACE_MB)
    return report_ok(what, FindingCode.FILE_USABLE, path=str(path))


def _check_memory(needed_mb: float, root: Path) -> Finding:
    limit_mb, ram_mb = machine.read_ram_limit_mb(root), machine.read_ram_mb(root)
    controllers = machine.read_text(root / "sys/fs/cgroup/cgroup.controllers")
    if controllers is not None and "memory" not in controllers.split():
        return report_fault("memory", FindingCode.MEMORY_LIMIT_IGNORED)
    if limit_mb < needed_mb:
        change = f"MemoryMax={1e6 * needed_mb:.0f}"
        low = FindingCode.MEMORY_LIMIT_LOW
        return report_fault("memory", low, change, limit_mb=limit_mb, ram_mb=ram_mb, needed_mb=needed_mb)
    return report_ok("memory", FindingCode.MEMORY_LIMIT, limit_mb=limit_mb, ram_mb=ram_mb)


def _find_console(port: Path, root: Path) -> str | None:
    """Return the name, e.g. "ttyS0", under which the kernel uses a port as its console, now or after the next boot;
    None if the port is not a console."""
    texts = (machine.read_text(root / name) or "" for name in ("proc/cmdline", "boot/firmware/cmdline.txt"))
    words = " ".join(texts).split()
    consoles = (word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console="))
    return next((console for console in consoles if (root / "dev" / console).resolve() == port), None)


def _find_program(port: Path, root: Path) -> tuple[str | None, bool]:
    """Return the program that uses a device, as "NAME (process PID)" (None: none found), and whether the device is the
    program's terminal, as with a login shell. Only root can see the open files of other users' programs."""
    device = port.stat().st_rdev
    major, minor = os.major(device), os.minor(device)
    terminal = str(minor & 0xFF | major << 8 | (minor & ~0xFF) << 12)  # tty_nr of proc(5)
    for process in sorted((root / "proc").glob("[0-9]*"), key=lambda folder: int(folder.name)):
        if process.name == str(os.getpid()):
            continue
        start, _, stat_fields = (machine.read_text(process / "stat") or "").rpartition(")")
        name = f"{start.partition('(')[2]} (process {process.name})"
        if stat_fields.split()[4:5] == [terminal]:
            return name, True
        with suppress(OSError):
            if any(file.resolve() == port for file in (process / "fd").iterdir()):
                return name, False
    return None, False
