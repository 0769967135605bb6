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
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.tlog import SPARED_BYTES
from edgevpr.power import machine
from edgevpr.power.boards import load_board

LOG_ROOM_MB = 10  # some hours of queries


@dataclass(frozen=True, slots=True)
class FlightIntent:
    """Intent of a flight, for the checks of an autopilot: `sends_fixes` (False: a dry run), and `every_s`, the
    seconds between two queries."""

    sends_fixes: bool
    every_s: float


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check. `what`: name of what was checked. `message`: a description of it or, if it is not `ok`, one
    sentence that says what is wrong. `changes`: the exact changes that put it right, such as `GPS2_TYPE=14`."""

    what: str
    ok: bool
    message: str
    changes: tuple[str, ...] = ()


def fine(what: str, message: str) -> Finding:
    """Return a finding with nothing to change."""
    return Finding(what, True, message)


def wrong(what: str, message: str, *changes: str) -> Finding:
    """Return a finding with something wrong, which `changes` put right."""
    return Finding(what, False, message, changes)


def judged(what: str, ok: bool, good: str, bad: str, *changes: str) -> Finding:
    """Return a fine finding with the text `good` if `ok`, else a wrong one with the text `bad` and the `changes`."""
    return fine(what, good) if ok else wrong(what, bad, *changes)


def looked_at(what: str, look: Callable[[], str]) -> Finding:
    """Return a finding: fine with the text that `look` returns, or wrong with the error that it raises."""
    try:
        return fine(what, look())
    except EdgevprError as error:
        return wrong(what, str(error))
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
    if config.source.uri and config.source.uri.startswith("/dev/"):
        yield device("camera", config.source.uri, root)
    yield from log_findings(config.log, has_link=config.mavlink.link is not None)


def device(what: str, path: str, root: Path = Path("/")) -> Finding:
    """Check that a device file exists, that this user may use it, and that it is not the kernel's console. `what` names
    the check in the finding."""
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
    if not os.access(file, os.R_OK | os.W_OK):
        user = getpass.getuser()
        denied = f"{path} may not be used by {user} ({mode}): log in again after the change."
        return wrong(what, denied, f"sudo usermod --append --groups {group} {user}")
    if console := _console_on(file.resolve(), root):
        return wrong(
            what,
            f"{path} is the console of the kernel, which writes into the link.",
            f"remove console={console} from the kernel's command line (cmdline.txt), and reboot",
        )
    return fine(what, f"{path}, {mode}")


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
        raise UsageError(f"{path} is no file in a folder that is there: correct `log: {{{key}: ...}}`.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UsageError(f"{path} may not be written by this user: change its permissions or `log: {{{key}: ...}}`.")
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    if free_mb < needed_mb:
        raise UsageError(f"{path}: only {free_mb:.1f} MB are free there, {needed_mb:g} are needed: make room.")
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


def _console_on(device_file: Path, root: Path) -> str | None:
    """Return the name of a device as the kernel's console, e.g. "ttyS0"; None if the kernel has no console on it."""
    words = (machine.text(root / "proc/cmdline") or "").split()
    consoles = (word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console="))
    return next((console for console in consoles if (root / "dev" / console).resolve() == device_file), None)
