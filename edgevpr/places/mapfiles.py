"""Paths of map files and of SQLite's files next to them; the lock of the program that adds places; opening and closing
with SQLite, and the translation of its errors into messages for the user."""

import fcntl
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from edgevpr.core.errors import MapBusyError, MapError, UsageError
from edgevpr.places.geopackage import decode_point_or_none

_SQLITE_SUFFIXES = ("-wal", "-shm", "-journal")
MAX_WAIT_S = 5.0  # longest wait for another program that is writing
# SQLite instructions after which a statement is interrupted. A table of a million places takes a tenth of this; a view,
# or a damaged table that refers to itself, may never end.
_MAX_SQLITE_STEPS = 500_000_000

# Words in SQLite's messages, and advice for the user.
_ADVICE = {
    "full": "the disk is full: free some space; all places confirmed so far are kept",
    "not a database": "this is not a place map: use a .gpkg file made by `edgevpr map build`",
    "readonly": "it is not writable: check the permissions of the file and its folder",
    "unable to open": "it cannot be opened: check the path, and the permissions of the file and its folder",
    "": "the file or its disk is damaged, or it is not a place map ({message}): restore a copy or build it again",
}


def list_sqlite_files(path: Path) -> list[Path]:
    """Return the paths of the files that SQLite may keep next to a map file, whether or not they exist."""
    return [path.with_name(path.name + end) for end in _SQLITE_SUFFIXES]


def parse_map_path(name: str | Path) -> Path:
    """Return `name` as a path. Raises UsageError for an impossible file name."""
    text = str(name)
    with suppress(UnicodeEncodeError):
        if Path(text).name and b"\0" not in os.fsencode(text):
            return Path(text)
    raise UsageError(f"{text!r} cannot be the name of a map: use the path of a file, such as valley.gpkg.")


def require_map_file(name: str | Path) -> Path:
    """Return the path of an existing map file. Raises UsageError as `parse_map_path` does, and MapError if the file is
    missing or is not a regular file."""
    path = parse_map_path(name)
    with translate_errors(path):
        if not path.exists():
            raise MapError(f"There is no map {path}: build one with `edgevpr map build {path} --images DIR`.")
        require_regular(path)
    return path


def require_regular(path: Path) -> None:
    """Raise MapError if the map, or a file of SQLite next to it, exists but is not a regular file. It may be a folder,
    or a pipe, which a program would read for ever."""
    if path.is_dir():
        raise MapError(
            f"{path} is a folder, but a map is one file: extract the map of a mission from a folder of maps with "
            f"`edgevpr map subset {path} --mission FILE --out flight.gpkg`."
        )
    for file in (path, *list_sqlite_files(path)):
        if file.exists() and not file.is_file():
            raise MapError(f"{file} is not a regular file but a folder, pipe or device: use the path of a map file.")


def lock_map(path: Path, make: bool = False) -> int:
    """Lock a map so that only this program can add places. Returns a file descriptor; closing it releases the lock.

    Readers need no lock. SQLite's own lock is not enough, because it lasts for only one transaction: two programs that
    map the same pictures would add every place twice. `make` creates a missing file. Raises MapBusyError if another
    program holds the lock, and MapError if the file cannot be opened."""
    with translate_errors(path):
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if make else 0), 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise MapBusyError(
            f"{path}: another program is adding places to this map: wait until it has finished, or stop that program."
        ) from None
    except OSError:
        pass  # the file system has no locks: continue
    return descriptor


@contextmanager
def write_atomically(out: Path) -> Iterator[Path]:
    """Yield the path of a temporary file for a new map, and rename it to `out` at the end of `with`. Remove it if the
    body fails, because half a map would look complete. Raises MapError if `out` has content already."""
    require_regular(out)
    if out.exists() and out.stat().st_size:
        raise MapError(f"{out} exists already: choose another name.")
    temp_path = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        yield temp_path
        temp_path.replace(out)
    finally:
        remove_map(temp_path)


def remove_map(path: Path) -> None:
    """Delete a map file, if it exists, and the files that SQLite keeps next to it."""
    for file in (path, *list_sqlite_files(path)):
        file.unlink(missing_ok=True)


def connect(path: Path, mode: str, wait_s: float = MAX_WAIT_S) -> sqlite3.Connection:
    """Open a map file in SQLite's `mode`, ro or rw. `wait_s`: longest wait in seconds for another program that is
    writing. Raises sqlite3.Error."""
    # Autocommit: transactions are begun explicitly, so that nothing is ever committed partially.
    db = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True,
        isolation_level=None,
        timeout=wait_s,
        check_same_thread=False,
    )
    db.text_factory = _decode_text
    db.set_progress_handler(lambda: 1, _MAX_SQLITE_STEPS)
    # The triggers of the spatial index (OGC 12-128r18, annex F.3) call these functions, which SQLite itself lacks. QGIS
    # or GDAL may have added such an index. A damaged geometry is treated as an empty one.
    db.create_function("ST_IsEmpty", 1, lambda geom: decode_point_or_none(geom) is None)
    for name, axis in {"ST_MinX": 1, "ST_MaxX": 1, "ST_MinY": 0, "ST_MaxY": 0}.items():
        db.create_function(name, 1, lambda geom, axis=axis: (decode_point_or_none(geom) or (None, None))[axis])
    return db


def enable_write_ahead_log(db: sqlite3.Connection) -> None:
    # A write-ahead log, synced at every commit: a confirmed place survives a power loss.
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")


def merge_write_ahead_log(db: sqlite3.Connection) -> None:
    """Merge the write-ahead log into the map file and remove it, unless another program uses the map."""
    with suppress(sqlite3.Error):
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.execute("PRAGMA journal_mode = DELETE")


def merge_leftover_log(path: Path) -> None:
    """Merge the log that a killed program left behind into the map file; do nothing if it is not writable."""
    if list_sqlite_files(path)[0].exists():
        with suppress(sqlite3.Error), closing(connect(path, "rw")) as db:
            merge_write_ahead_log(db)


def is_row_error(error: sqlite3.Error) -> bool:
    """Return True if other rows may still be readable: a damaged page, a lost sector, or an oversized value."""
    return any(words in str(error) for words in ("malformed", "disk I/O", "too big"))


@contextmanager
def translate_errors(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and the file system in the body of `with` into a MapError that tells the user what to do,
    or into a MapBusyError if another program is writing."""
    try:
        yield
    except OSError as error:
        raise MapError(f"{path}: {_ADVICE['unable to open']} ({error.strerror}).") from error
    except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter if SQLite quotes a damaged schema
        message = str(error)
        if "locked" in message:
            raise MapBusyError(f"{path}: another program is writing to it: close that program, then retry.") from error
        advice = next(advice for words, advice in _ADVICE.items() if words in message)
        raise MapError(f"{path}: {advice.format(message=message)}.") from error


def _decode_text(raw: bytes) -> str | bytes:
    """Decode a text value of the file. If it is not UTF-8, return the bytes, which the checks in `rows` reject."""
    try:
        return raw.decode()
    except UnicodeDecodeError:
        return raw
