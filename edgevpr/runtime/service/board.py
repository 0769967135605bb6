"""Checks of this machine for `edgevpr doctor`: limits of its control groups, devices, and free room on disk."""

import getpass
import grp
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from edgevpr.core.config import Config, LogConfig
from edgevpr.core.errors import UsageError
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.tlog import SPARED_BYTES
from edgevpr.power import machine
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.finding import Finding, fine, looked_at, wrong

LOG_ROOM_MB = 10  # some hours of queries


def board_findings(config: Config, address: LinkAddress | None, root: Path = Path("/")) -> Iterator[Finding]:
    """Check this machine for a flight with `config` over the link `address` (None: no link), and yield a finding for
    each check. `root` is the root of the file system with /proc, /sys and /dev. Raises ConfigError if the board is
    unknown."""
    yield _memory(load_board(config.board).memory_max_mb, root)
    yield fine("cores", f"{machine.cores(root):g} for this process")
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
