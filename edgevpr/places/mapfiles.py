"""Names of map files and of the files that SQLite keeps beside them, and the lock of the one program that adds."""

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from edgevpr.core.errors import MapBusyError, MapError, UsageError

_BESIDE = ("-wal", "-shm", "-journal")


def beside(path: Path) -> list[Path]:
    """Return the files that SQLite keeps beside a map: its log, the index of the log, and the journal."""
    return [path.with_name(path.name + end) for end in _BESIDE]


def map_path(name: str | Path) -> Path:
    """Return the path of a map. Raises UsageError for a name that no file can have."""
    text = str(name)
    possible = False
    with suppress(UnicodeEncodeError):
        possible = bool(Path(text).name) and b"\0" not in os.fsencode(text)
    if not possible:
        raise UsageError(f"{text!r} cannot be the name of a map: give the path of a file, e.g. valley.gpkg.")
    return Path(text)


def existing(name: str | Path) -> Path:
    """Return the path of a map that is there. Raises UsageError as `map_path`, and MapError for a map that is missing
    or is no regular file."""
    path = map_path(name)
    try:
        if not path.exists():
            raise MapError(f"There is no map {path}: make one with `edgevpr map build {path} --images DIR`.")
        require_regular(path)
    except OSError as error:
        raise MapError(
            f"{path}: it cannot be opened ({error.strerror}): check the path, and the permissions of the file and its "
            "folder."
        ) from error
    return path


def require_regular(path: Path) -> None:
    """Raise MapError where the map, or a file of SQLite's beside it, is anything but a file: a folder, or a pipe, whose
    reading would never end."""
    for each in (path, *beside(path)):
        if each.exists() and not stat.S_ISREG(each.stat().st_mode):
            raise MapError(f"{each} is no regular file but a folder, pipe or device: give the path of a map file.")


def lock(path: Path, make: bool = False) -> int:
    """Lock a map for the one program that adds places to it, until the descriptor that is returned is closed.

    Readers need no lock. It is not SQLite's own, which holds for one place only: two programs that map the same
    pictures would add every place twice. With `make`, a missing file is made. Raises MapBusyError where another program
    has the lock, and MapError where the file cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if make else 0), 0o644)
    except OSError as error:
        raise MapError(
            f"{path}: it may not be written ({error.strerror}): check the path, and the permissions of the file and "
            "its folder."
        ) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise MapBusyError(
            f"{path}: another program is adding places to this map: wait until it has finished, or stop it."
        ) from None
    except OSError:
        pass  # a file system without locks
    return descriptor


@contextmanager
def whole_or_none(out: Path) -> Iterator[Path]:
    """Give the path of a file to write a new map to; at the end it becomes `out`. Where anything fails it is removed:
    half a map would look like a whole one. Raises MapError where a map is there already."""
    require_regular(out)
    if out.exists() and out.stat().st_size:
        raise MapError(f"{out} is there already: choose another name.")
    unfinished = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        yield unfinished
        unfinished.replace(out)
    finally:
        remove(unfinished)


def remove(path: Path) -> None:
    """Remove a map that was not finished, with the files beside it."""
    for each in (path, *beside(path)):
        each.unlink(missing_ok=True)
