"""`edgevpr service install` and `uninstall`: make user, folders, program, configuration, unit and udev rules of the
service, and remove them again. Maps, flight logs and the configuration stay."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import shipped, write_whole
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.program import NAME, VENV, Step, command, program_steps, remove_program, walk
from edgevpr.runtime.service.unit import HIDDEN_FROM_THE_SERVICE, render_unit

_CONFIG = "etc/edgevpr/config.yaml"
_UNIT, _RULES = "etc/systemd/system/edgevpr.service", "etc/udev/rules.d/99-edgevpr.rules"
_MAPS, _LOGS = "var/lib/edgevpr", "var/log/edgevpr"
_GROUPS = ("dialout", "video")  # of serial ports and cameras
_BOOTED = "run/systemd/system"  # sd_booted(3)

_FIRST_CONFIG = """\
# Written by `edgevpr service install`. It needs only the keys that differ from the defaults; deploy/config.yaml of
# edgevpr explains them all. Before the first flight: the map, the camera and the flight controller.
# map: /var/lib/edgevpr/valley.gpkg
# source: {uri: /dev/edgevpr-camera}
# mavlink: {link: "serial:/dev/edgevpr-fc:921600"}
log: {path: /var/log/edgevpr/flight.jsonl}
"""


def install(config: Path | None, dry_run: bool, say: Callable[[str], None], root: Path = Path("/")) -> None:
    """Install the service on this machine. Raises EdgevprError, one sentence, if a step fails.

    `config` becomes its configuration (None: an existing one stays, else a first one is written). With `dry_run`
    nothing is changed. `say` is called with a line about each step. `root` is the folder that holds the system.
    """
    if root == Path("/") and not dry_run:
        _require_root()
        _require_visible_python()
    if sys.maxsize < 2**32:
        raise UsageError(f"This system has not 64 bits ({platform.machine()}): install the 64-bit edition of it first.")
    there = root / _CONFIG
    written = config or (there if there.exists() else None)
    unit = render_unit(load_board(load_config(written).board if written else "this"))
    put = partial(_put, root)
    useradd = ("useradd", "--system", "--user-group", "--home-dir", f"/{_MAPS}", "--shell", "/usr/sbin/nologin", NAME)
    usermod = ("usermod", "--append", "--groups", ",".join(_GROUPS), NAME)
    steps = (
        Step(f"system user {NAME}, without a login", lambda: _ids(root) is not None, partial(command, *useradd)),
        Step(
            f"{NAME} in the groups {' and '.join(_GROUPS)}",
            lambda: all(NAME in _members(root, group) for group in _GROUPS),
            partial(command, *usermod),
        ),
        _own_folder(root, _MAPS, "maps"),
        _own_folder(root, _LOGS, "flight logs"),
        put(_CONFIG, "configuration", written.read_bytes() if written else _FIRST_CONFIG.encode()),
        *program_steps(root / VENV),
        put(_UNIT, "unit, with the limits of the board", unit.encode()),
        put(_RULES, "udev rules", (shipped("deploy") / "99-edgevpr.rules").read_bytes()),
        Step("systemd has read the unit", lambda: _is_loaded(root), lambda: _reload_units(root)),
        Step("udev has read its rules, and named what is plugged in", lambda: False, _reload_rules),
    )
    walk(steps, dry_run, say)


def uninstall(dry_run: bool, say: Callable[[str], None], root: Path = Path("/")) -> None:
    """Stop the service and remove what `install` has made, except maps, flight logs, the configuration and the user."""
    if root == Path("/") and not dry_run:
        _require_root()
    is_booted = (root / _BOOTED).is_dir()
    stop = ("systemctl", "disable", *(("--now",) if is_booted else ()), NAME)
    reloads = (
        Step("systemd has read that the unit is gone", lambda: False, lambda: _reload_units(root)),
        Step("udev has read that its rules are gone", lambda: False, _reload_rules),
    )
    steps = (
        Step("service stopped and not started any more", partial(_is_gone, root / _UNIT), partial(command, *stop)),
        *(Step(f"no /{name}", partial(_is_gone, root / name), (root / name).unlink) for name in (_UNIT, _RULES)),
        *(reloads if is_booted else ()),
        # Last, since this may be the very program that runs.
        Step(f"no /{VENV}", partial(_is_gone, root / VENV), lambda: remove_program(root / VENV)),
    )
    walk(steps, dry_run, say)
    say(f"kept   /{_CONFIG}, /{_MAPS}, /{_LOGS} and the user {NAME}, to whom they belong")


def _require_root() -> None:
    if os.geteuid() != 0:
        raise EdgevprError("Only root may change the system: run it again with sudo (--dry-run needs none).")


def _require_visible_python() -> None:
    for folder in HIDDEN_FROM_THE_SERVICE:
        if Path(sys.base_prefix).resolve().is_relative_to(folder):
            raise EdgevprError(
                f"This Python lies in {sys.base_prefix}, out of sight of the service: install edgevpr with the "
                "system's (/usr/bin/python3 -m venv) and run it from there."
            )


def _put(root: Path, name: str, what: str, content: bytes) -> Step:
    """Return the step that writes a file, completely or not at all. A different file in its place is kept, as
    NAME.old."""
    path = root / name
    old = path.with_name(f"{path.name}.old")

    def do() -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            shutil.copy2(path, old)
        write_whole(path, lambda unfinished: unfinished.write_bytes(content))

    return Step(f"{what} in /{name}", lambda: path.is_file() and path.read_bytes() == content, do)


def _own_folder(root: Path, name: str, what: str) -> Step:
    path = root / name

    def do() -> None:
        path.mkdir(parents=True, exist_ok=True)
        if ids := _ids(root):
            os.chown(path, *ids)

    def is_so() -> bool:
        ids = _ids(root)
        return ids is not None and path.is_dir() and path.stat().st_uid == ids[0]

    return Step(f"folder /{name} for {what}", is_so, do)


def _is_gone(path: Path) -> bool:
    return not os.path.lexists(path)


def _ids(root: Path) -> tuple[int, int] | None:
    """Return (user id, group id) of the service's user; None if there is no such user."""
    entry = _entry(root / "etc/passwd", NAME)
    return (int(entry[2]), int(entry[3])) if entry else None


def _members(root: Path, group: str) -> list[str]:
    entry = _entry(root / "etc/group", group)
    return entry[3].split(",") if entry else []


def _entry(path: Path, name: str) -> list[str] | None:
    lines = path.read_text("utf-8", "replace").splitlines() if path.is_file() else ()
    return next((fields for fields in (line.split(":") for line in lines) if fields[0] == name), None)


def _is_loaded(root: Path) -> bool:
    """Tell whether systemd runs and has read the unit as it is on the disk."""
    if not (root / _BOOTED).is_dir():
        return False
    show = ["systemctl", "show", "--property=LoadState,NeedDaemonReload", NAME]
    said = subprocess.run(show, stdin=subprocess.DEVNULL, capture_output=True, text=True).stdout.split()
    return set(said) == {"LoadState=loaded", "NeedDaemonReload=no"}


def _reload_units(root: Path) -> None:
    if not (root / _BOOTED).is_dir():
        raise EdgevprError(
            "systemd does not run here, and the service needs it: start the machine with it, then run this again; what "
            "is done stays."
        )
    command("systemctl", "daemon-reload")


def _reload_rules() -> None:
    command("udevadm", "control", "--reload")
    command("udevadm", "trigger", "--subsystem-match=tty", "--subsystem-match=video4linux")
