"""Paths of map files and of the files that SQLite keeps beside them, and the lock of the program that adds places."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from edgevpr.core.errors import MapBusyError, MapError, UsageError

_BESIDE = ("-wal", "-shm", "-journal")


def beside(path: Path) -> list[Path]:
    """Return the paths at which SQLite may keep files of a map: write-ahead log, index of the log, rollback journal."""
    return [path.with_name(path.name + end) for end in _BESIDE]


def map_path(name: str | Path) -> Path:
    """Return `name` as a path. Raises UsageError for a name that no file can have."""
    text = str(name)
    with suppress(UnicodeEncodeError):
        if Path(text).name and b"\0" not in os.fsencode(text):
            return Path(text)
    raise UsageError(f"{text!r} cannot be the name of a map: give the path of a file, e.g. valley.gpkg.")


def existing(name: str | Path) -> Path:
    """Return the path of an existing map file. Raises UsageError as `map_path` does, and MapError if the file is
    missing or is not a regular file."""
    path = map_path(name)
    try:
        if not path.exists():
            raise MapError(f"There is no map {path}: make one with `edgevpr map build {path} --images DIR`.")
        require_regular(path)
    except OSError as error:
        raise _closed(path, error) from error
    return path


def require_regular(path: Path) -> None:
    """Raise MapError if the map, or a file of SQLite beside it, exists but is not a regular file: a folder, or a pipe,
    from which a program would read for ever."""
    for each in (path, *beside(path)):
        if each.exists() and not each.is_file():
            raise MapError(f"{each} is no regular file but a folder, pipe or device: give the path of a map file.")


def lock(path: Path, make: bool = False) -> int:
    """Lock a map for the one program that may add places; return a file descriptor, whose closing ends the lock.

    Readers need no lock. SQLite's own lock is not enough, since it lasts for one transaction only: two programs that
    map the same pictures would add every place twice. `make` creates a missing file. Raises MapBusyError if another
    program has the lock, and MapError if the file cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if make else 0), 0o644)
    except OSError as error:
        raise _closed(path, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise MapBusyError(
            f"{path}: another program is adding places to this map: wait until it has finished, or stop it."
        ) from None
    except OSError:
        pass  # a file system without locks: go on
    return descriptor


@contextmanager
def whole_or_none(out: Path) -> Iterator[Path]:
    """Yield the path of a temporary file to write a new map to, and rename it to `out` at the end of `with`. Remove it
    if the body fails: half a map would look like a complete one. Raises MapError if `out` has content already."""
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
    """Delete a map file, if it exists, and the files that SQLite keeps beside it."""
    for each in (path, *beside(path)):
        each.unlink(missing_ok=True)


def _closed(path: Path, error: OSError) -> MapError:
    return MapError(
        f"{path}: it cannot be opened ({error.strerror}): check the path, and the permissions of the file and its "
        "folder."
    )
