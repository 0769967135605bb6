"""The connection to an open map file, the lock held by the one program that may add places, and the check that the file
has not been replaced. `mapfile.PlaceMap` extends it with the meaning of the rows."""

import os
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.places import geopackage, mapfiles, rows
from edgevpr.places.mapspec import read_spec, read_stored, write_spec

if TYPE_CHECKING:
    from typing_extensions import Self

_MAX_METADATA_BYTES = 100_000  # of a row without its descriptor: mostly the image's name


class MapConnection:
    """A connection to a map file. Create it with `create`, `open` or `open_for_writing`, and close it or use `with`.

    `stored` holds the values of the table edgevpr_map (see `mapspec`), and `spec` describes the technique that made the
    descriptors. `db` is the current SQLite connection: `require_unchanged` may replace it."""

    def __init__(self, path: Path, db: sqlite3.Connection, lock: int | None = None) -> None:
        self.path, self.stored = path, read_stored(path, db)
        self.spec = read_spec(path, self.stored)
        self._lock = lock  # file descriptor of the write lock; None: open for reading only
        self.left_out: dict[int, str] = {}  # see `mapfile.PlaceMap`
        self._wait_s = mapfiles.MAX_WAIT_S
        self._use_connection(db)
        self._file_state = self._read_file_state()

    @classmethod
    def create(cls, path: str | Path, spec: TechniqueSpec) -> "Self":
        """Create an empty map for descriptors of `spec`; if writing fails, remove the file. Raises MapError if the file
        is not empty or cannot be written, and UsageError for a name that no file can have."""
        path = mapfiles.parse_map_path(path)
        mapfiles.require_regular(path)
        with ExitStack() as undo:
            lock = mapfiles.lock_map(path, make=True)
            undo.callback(os.close, lock)
            if os.fstat(lock).st_size:
                raise MapError(f"{path} exists already: choose another name, or add to it with --append.")
            undo.callback(mapfiles.remove_map, path)
            with mapfiles.translate_errors(path):
                db = mapfiles.connect(path, "rw")
                undo.callback(db.close)
                db.execute(f"PRAGMA application_id = {geopackage.APPLICATION_ID}")
                db.execute(f"PRAGMA user_version = {geopackage.USER_VERSION}")
                mapfiles.enable_write_ahead_log(db)
                db.executescript("BEGIN;" + geopackage.SCHEMA)
                write_spec(db, spec)
                db.execute("COMMIT")
                place_map = cls(path, db, lock)
            undo.pop_all()
        return place_map

    @classmethod
    def open(cls, path: str | Path) -> "Self":
        """Open a map for reading. Raises MapError if the file is missing, damaged, not a place map, or of an unknown
        format version, and UsageError for a name that no file can have."""
        path = mapfiles.require_map_file(path)
        mapfiles.merge_leftover_log(path)
        return cls._open(path, is_writable=False)

    @classmethod
    def open_for_writing(cls, path: str | Path) -> "Self":
        """Open an existing map to add places. Raises the errors of `open`, and MapBusyError if another program adds."""
        return cls._open(mapfiles.require_map_file(path), is_writable=True)

    @classmethod
    def _open(cls, path: Path, is_writable: bool) -> "Self":
        with ExitStack() as undo, mapfiles.translate_errors(path):
            lock = mapfiles.lock_map(path) if is_writable else None
            if lock is not None:
                undo.callback(os.close, lock)
            db = mapfiles.connect(path, "rw" if is_writable else "ro")
            undo.callback(db.close)
            place_map = cls(path, db, lock)
            undo.pop_all()
        return place_map

    def __enter__(self) -> "Self":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. If it was open for writing, first merge the write-ahead log into it, so that the single file
        that remains is readable even on a read-only medium."""
        if self._lock is not None:
            mapfiles.merge_write_ahead_log(self.db)
        self.db.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def require_unchanged(self) -> None:
        """Raise MapError if the file is missing, cannot be read, or has been replaced by another map since it was
        opened. If another program has modified the file, it is reopened, and its map_id and technique are compared,
        because the old connection may have cached pages of a replaced file."""
        with mapfiles.translate_errors(self.path):
            state = self._read_file_state()
            if state == self._file_state:
                return
            mapfiles.require_map_file(self.path)
            new_db = mapfiles.connect(self.path, "ro" if self._lock is None else "rw", self._wait_s)
            try:
                if read_stored(self.path, new_db) != self.stored:
                    raise MapError(f"{self.path} was replaced by another map: restore the original.")
            except BaseException:
                new_db.close()
                raise
            self.db.close()
            self._use_connection(new_db)
            self._file_state = self._read_data_version(), *state[1:]

    def set_max_wait(self, wait_s: float) -> None:
        """Set the number of seconds to wait for another program that is writing before raising MapBusyError."""
        self._wait_s = wait_s
        self.db.execute(f"PRAGMA busy_timeout = {round(1000 * wait_s)}")

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Run the body of `with` as one transaction: commit everything that it writes, or roll back if it raises an
        exception. Raises MapError for SQLite errors."""
        with mapfiles.translate_errors(self.path):
            self.db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self.db.execute("COMMIT")
            except BaseException:
                if self.db.in_transaction:  # SQLite has already rolled back if the disk is full
                    self.db.execute("ROLLBACK")
                raise

    def scan_rows(self, columns: str) -> Iterator[tuple[int, rows.Values | None]]:
        """Yield (place id, values of `columns` or None if unreadable) of every place. Raises MapError."""
        with mapfiles.translate_errors(self.path):
            yield from rows.scan_rows(self.db, columns)

    def read_row(self, place_id: int, columns: str) -> rows.Content:
        """Return the values of `columns` of one place, by name. Raises PlaceError if it cannot be read."""
        with mapfiles.translate_errors(self.path):
            try:
                row = self.db.execute(f"SELECT {columns} FROM places WHERE place_id = ?", (place_id,)).fetchone()
            except sqlite3.Error as error:
                if not mapfiles.is_row_error(error):
                    raise
                raise PlaceError(self.path, place_id, f"SQLite reports: {error}") from error
        if not row:
            raise PlaceError(self.path, place_id, "its row is missing")
        return rows.read_columns(columns, row)

    def __len__(self) -> int:
        """Return the number of places; in a damaged file, count only the readable ones. Raises MapError."""
        with mapfiles.translate_errors(self.path):
            try:  # not count(*): no progress handler can interrupt it in a table that refers to itself
                return int(self.db.execute("SELECT total(1) FROM places").fetchone()[0])
            except sqlite3.Error as error:
                if not mapfiles.is_row_error(error):
                    raise
        return sum(row is not None for _, row in self.scan_rows("1"))

    def _use_connection(self, connection: sqlite3.Connection) -> None:
        """Make `connection` the current one. From Python 3.11 on, also make SQLite refuse values larger than any row of
        this map can hold, such as those of a damaged file."""
        self.db = connection
        if self._lock is not None:
            mapfiles.enable_write_ahead_log(connection)
        if sys.version_info >= (3, 11):
            fine_bytes = self.spec.fine.nbytes if self.spec.fine else 0
            max_bytes = self.spec.coarse.nbytes + fine_bytes + _MAX_METADATA_BYTES
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_bytes)

    def _read_data_version(self) -> int | None:
        """Return SQLite's data_version, which changes when other programs write; None if the file cannot be read."""
        try:
            return int(self.db.execute("PRAGMA data_version").fetchone()[0])
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if "locked" in str(error):
                raise
            return None

    def _read_file_state(self) -> tuple[int | None, ...]:
        """Return values that change whenever another program writes to the file or replaces it."""
        try:
            file = self.path.stat()
        except OSError as error:
            raise MapError(f"{self.path} is missing ({error.strerror}): restore the file.") from error
        return self._read_data_version(), file.st_dev, file.st_ino, file.st_size, file.st_mtime_ns
