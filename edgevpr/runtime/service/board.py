"""This machine, as `edgevpr doctor` finds it: Python, limits of its control groups, devices, room on disk."""

import getpass
import grp
import importlib.util
import os
import shutil
import stat
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from edgevpr.core.config import Config
from edgevpr.core.errors import UsageError
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.tlog import SPARED_BYTES
from edgevpr.places.mapfiles import map_path
from edgevpr.power import machine
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.finding import Finding, looked_at

LOG_ROOM_MB = 10  # some hours of queries
_MAP_ROOM_MB = 100  # a thousand places of cohog, learnt in flight
_PYTHONS = ((3, 10), (3, 13))
_LARGEST = ("pymavlink.dialects.v20.ardupilotmega", "numpy", "edgevpr.mavlink.link")
_SERVICE = Path("sys/fs/cgroup/system.slice/edgevpr.service")


def board_findings(config: Config, address: LinkAddress | None, root: Path = Path("/")) -> Iterator[Finding]:
    """Examine this machine for a flight with a configuration over a link. Raises ConfigError for a board that
    is unknown."""
    yield python(sys.version_info[:2], sys.maxsize > 2**32)
    specs = (importlib.util.find_spec(name) for name in _LARGEST)
    yield bytecode([Path(spec.origin) for spec in specs if spec and spec.origin])
    yield _memory(config, root)
    yield Finding("cores", True, f"{machine.cores(root):g} for this process{_service_limit(root, 'cpu.max')}")
    if address and address.kind == "serial":
        yield device("serial", address.where, root)
    if config.source.uri and config.source.uri.startswith("/dev/"):
        yield device("camera", config.source.uri, root)
    yield from log_findings(config)
    if config.map:
        yield _map_room(config)


def python(version: tuple[int, ...], is_64_bit: bool) -> Finding:
    """Judge the version of Python, and whether it is one for 64 bits."""
    name = ".".join(map(str, version))
    if not is_64_bit:
        return Finding("python", False, f"Python {name} for 32 bits: no network runs on it.", ("a 64-bit OS",))
    if not _PYTHONS[0] <= tuple(version) <= _PYTHONS[1]:
        return Finding("python", False, f"Python {name} is not supported.", ("Python 3.10 to 3.13",))
    return Finding("python", True, f"{name}, 64 bits")


def bytecode(sources: Iterable[Path]) -> Finding:
    """Tell whether modules are compiled, or will be when they are imported: where not, every start takes long."""
    slow = []
    for source in sources:
        compiled = Path(importlib.util.cache_from_source(str(source)))
        folder = compiled.parent if compiled.parent.is_dir() else source.parent
        if not compiled.exists() and not os.access(folder, os.W_OK):
            slow.append(source)
    if slow:
        return Finding(
            "bytecode",
            False,
            f"{slow[0]} is not compiled and this user cannot store the result: every start takes up to 40 s longer.",
            (f"sudo {sys.executable} -m compileall -q {_packages(slow[0])}",),
        )
    return Finding("bytecode", True, "compiled, or will be at the next start")


def device(what: str, path: str, root: Path = Path("/")) -> Finding:
    """Judge a device file: is it there, may this user use it, does the kernel's console have it?"""
    file = root / path.lstrip("/")
    try:
        status = file.stat()
    except OSError as error:
        return Finding(what, False, f"{path}: {error.strerror}: connect it, or correct the name.")
    if not stat.S_ISCHR(status.st_mode):
        return Finding(what, False, f"{path} is no device: correct the name.")
    group = _group_name(status.st_gid)
    mode = f"group {group}, mode {stat.S_IMODE(status.st_mode):04o}"
    if not os.access(file, os.R_OK | os.W_OK):
        return Finding(
            what, False, f"{path} may not be used by {_user()} ({mode}): log in again after the change.",
            (f"sudo usermod --append --groups {group} {_user()}",),
        )  # fmt: skip
    if console := _console_on(file.resolve(), root):
        return Finding(
            what,
            False,
            f"{path} is the console of the kernel, which writes into the link.",
            (f"remove console={console} from the kernel's command line (cmdline.txt), and reboot",),
        )
    return Finding(what, True, f"{path}, {mode}")


def log_findings(config: Config) -> Iterator[Finding]:
    """Tell where the flight log goes, and the tlog if there is to be one, and whether they can be written."""
    log = config.log
    if log.path is None:
        yield Finding("log", True, "none, so nothing of the flight is kept")
    else:
        yield looked_at("log", lambda: _room(log.path, "path", LOG_ROOM_MB))
    if log.tlog is not None and config.mavlink.link is None:
        yield Finding("tlog", True, "none, since there is no link")
    elif log.tlog is not None:
        yield looked_at("tlog", lambda: _room(log.tlog, "tlog", SPARED_BYTES / 1e6 + LOG_ROOM_MB))


def _room(file: str, key: str, needed_mb: float) -> str:
    # Unlike all else, a log is not opened: a check as root would leave a file that the service may not write.
    path = Path(file).absolute()
    if path.is_dir() or not path.parent.is_dir():
        raise UsageError(f"{path} is no file in a folder that is there: correct `log: {{{key}: ...}}`.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UsageError(f"{path} may not be written by this user: change its permissions or `log: {{{key}: ...}}`.")
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    if free_mb < needed_mb:
        raise UsageError(f"{path}: only {free_mb:.1f} MB are free there, {needed_mb:g} are needed: make room.")
    return str(path)


def _map_room(config: Config) -> Finding:
    path = map_path(config.map).absolute()
    folder = next(each for each in path.parents if each.is_dir())
    free_mb = shutil.disk_usage(folder).free / 1e6
    if config.mapping.learn and free_mb < _MAP_ROOM_MB:
        return Finding("map", False, f"{path}: only {free_mb:.0f} MB are free there, too few for learning: make room.")
    if not path.exists() and not config.mapping.learn:
        return Finding("map", False, f"{path} is not there: copy it to the board, or build it.")
    return Finding("map", True, f"{path}, {free_mb:.0f} MB free")


def _memory(config: Config, root: Path) -> Finding:
    limit_mb = machine.ram_limit_mb(root)
    said = f"{limit_mb:.0f} of {machine.ram_mb(root):.0f} MB for this process{_service_limit(root, 'memory.max')}"
    controllers = machine.text(root / "sys/fs/cgroup/cgroup.controllers")
    if controllers is not None and "memory" not in controllers.split():
        return Finding(
            "memory",
            False,
            f"{said}; the kernel runs without the memory controller, so no limit of the service is kept.",
            ("cgroup_enable=memory in /boot/firmware/cmdline.txt, and reboot",),
        )
    needed_mb = load_board(config.board).memory_max_mb
    if limit_mb < needed_mb:
        return Finding(
            "memory",
            False,
            f"{said}: less than what the profile of the board spares for edgevpr.",
            (f"MemoryMax={1e6 * needed_mb:.0f}",),
        )
    return Finding("memory", True, said)


def _service_limit(root: Path, name: str) -> str:
    """Write the limit that a running service has, "" where none runs."""
    limit = machine.text(root / _SERVICE / name)
    return f"; the service has {name} {limit}" if limit else ""


def _console_on(device_file: Path, root: Path) -> str | None:
    """Return the name by which the kernel has its console on a device, None where it has not."""
    words = (machine.text(root / "proc/cmdline") or "").split()
    consoles = (word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console="))
    return next((each for each in consoles if (root / "dev" / each).resolve() == device_file), None)


def _group_name(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def _packages(source: Path) -> Path:
    """Return the folder of all packages that a module lies in."""
    return next((each for each in source.parents if each.name in ("site-packages", "dist-packages")), source.parent)
