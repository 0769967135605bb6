"""An open map file: its one connection, the lock of the program that adds places, and the watch for another file in its
place.

What the rows mean is not known here (see `mapfile`), only how SQLite is asked for them.
"""

import os
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.places import geopackage, mapfiles, rows, sqlite
from edgevpr.places.mapspec import read_stored, spec_of, write_spec
from edgevpr.places.rows import Values
from edgevpr.places.sqlite import is_of_one_row, sentences

if TYPE_CHECKING:
    from typing_extensions import Self

_BESIDE_BLOBS_BYTES = 100_000  # what a row may have beside its descriptor: the name of its image


class MapConnection:
    """An open map file. Use `create`, `open` or `open_for_adding`, and close it (it is a context manager).

    `stored` is what the file says of the map, `spec` the technique in it. `db` is the connection of SQLite for this
    moment: `require_unchanged` may put another one in its place.
    """

    def __init__(self, path: Path, db: sqlite3.Connection, lock: int | None = None) -> None:
        self.path, self.stored = path, read_stored(path, db)
        self.spec = spec_of(path, self.stored)
        self._lock = lock  # the lock of the program that adds places; None: only read
        if lock is not None:
            sqlite.start_log(db)
        self._wait_s = sqlite.WAIT_S
        self._take(db)
        self._state = self._state_now()

    @classmethod
    def create(cls, path: str | Path, spec: TechniqueSpec) -> "Self":
        """Make an empty map for descriptors of `spec`: all of it, or no file. Raises MapError if the file has content
        or cannot be written, and UsageError for a name that no file can have."""
        path = mapfiles.map_path(path)
        mapfiles.require_regular(path)
        lock = mapfiles.lock(path, make=True)
        try:
            if os.fstat(lock).st_size:
                raise MapError(f"{path} is there already: choose another name, or add to it with --append.")
            try:
                with sentences(path):
                    db = sqlite.connect(path, "rw")
                    db.execute(f"PRAGMA application_id = {geopackage.APPLICATION_ID}")
                    db.execute(f"PRAGMA user_version = {geopackage.USER_VERSION}")
                    sqlite.start_log(db)
                    db.executescript("BEGIN;" + geopackage.SCHEMA)
                    write_spec(db, spec)
                    db.execute("COMMIT")
                    return cls(path, db, lock)
            except BaseException:
                mapfiles.remove(path)
                raise
        except BaseException:
            os.close(lock)
            raise

    @classmethod
    def open(cls, path: str | Path) -> "Self":
        """Open a map for reading. Raises MapError for a file that is missing, damaged, no place map, or of another
        format, and UsageError for a name that no file can have."""
        path = mapfiles.existing(path)
        sqlite.settle_left_log(path)
        with sentences(path):
            db = sqlite.connect_to_read(path)
            try:
                return cls(path, db)
            except BaseException:
                db.close()
                raise

    @classmethod
    def open_for_adding(cls, path: str | Path) -> "Self":
        """Open an existing map to add places to it. Raises MapError as `open` does, and MapBusyError where another
        program adds places to it."""
        path = mapfiles.existing(path)
        lock = mapfiles.lock(path)
        try:
            with sentences(path):
                return cls(path, sqlite.connect(path, "rw"), lock)
        except BaseException:
            os.close(lock)
            raise

    def __enter__(self) -> "Self":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. A map that was written becomes one plain file again, readable from a read-only card."""
        if self._lock is not None:
            sqlite.settle(self.db)
        self.db.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def require_unchanged(self) -> None:
        """Raise MapError where the file is gone, cannot be read, or is another map than the one that was opened.

        This is cheap: only when another program has touched the file is it opened anew, and its map_id compared. The
        new connection is then used, since the old one may have kept pages of another file.
        """
        with sentences(self.path):
            state = self._state_now()
            if state == self._state:
                return
            mapfiles.existing(self.path)
            fresh = sqlite.connect_to_read(self.path, self._wait_s)
            try:
                if read_stored(self.path, fresh) != self.stored:
                    raise MapError(f"{self.path} is another map than the one that was opened: put that one back.")
                if self._lock is not None:
                    fresh.close()
                    fresh = sqlite.connect(self.path, "rw", wait_s=self._wait_s)
                    sqlite.start_log(fresh)
            except BaseException:
                fresh.close()
                raise
            self.db.close()
            self._take(fresh)
            self._state = self._version(), *state[1:]

    def wait_at_most(self, wait_s: float) -> None:
        """From now on, wait at most so long for another program that is writing; then MapBusyError is raised."""
        self._wait_s = wait_s
        self.db.execute(f"PRAGMA busy_timeout = {round(1000 * wait_s)}")

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Commit what is written inside this context, or nothing of it. Raises sqlite3.Error."""
        self.db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self.db.execute("COMMIT")
        except BaseException:
            if self.db.in_transaction:  # SQLite has already rolled back where the disk is full
                self.db.execute("ROLLBACK")
            raise

    def scan(self, columns: str) -> Iterator[tuple[int, Values | None]]:
        """Yield (place id, row) of every place (see `rows.scan`). Raises MapError."""
        with sentences(self.path):
            yield from rows.scan(self.db, columns, self._file_bytes())

    def row(self, place_id: int, columns: str) -> Values | None:
        """Read the row of one place, None where it is gone. Raises PlaceError for one that SQLite cannot read."""
        with sentences(self.path):
            try:
                found = self.db.execute(f"SELECT {columns} FROM places WHERE place_id = ?", (place_id,)).fetchone()
            except sqlite3.Error as error:
                if not is_of_one_row(error):
                    raise
                raise PlaceError(self.path, place_id, f"SQLite says: {error}") from error
        return tuple(found) if found else None

    def __len__(self) -> int:
        """Return the number of places; in a damaged file, of those that can be read. Raises MapError."""
        with sentences(self.path):
            try:
                # Counted row by row: SQLite's own count of a table that refers to itself need not end.
                query = "SELECT count(*) FROM (SELECT 1 FROM places LIMIT ?)"
                return int(self.db.execute(query, (rows.most_rows(self._file_bytes()),)).fetchone()[0])
            except sqlite3.Error as error:
                if not is_of_one_row(error):
                    raise
        return sum(row is not None for _, row in self.scan("1"))

    def _file_bytes(self) -> int:
        (pages,), (page_bytes,) = (self.db.execute(f"PRAGMA page_{name}").fetchone() for name in ("count", "size"))
        return int(pages * page_bytes)

    def _take(self, connection: sqlite3.Connection) -> None:
        """Use this connection, and refuse to read any row that is larger than one of this map, before it is in
        memory. Python 3.10 cannot ask SQLite for this."""
        self.db = connection
        if sys.version_info >= (3, 11):
            fine_bytes = self.spec.fine.nbytes if self.spec.fine else 0
            most_bytes = self.spec.coarse.nbytes + fine_bytes + _BESIDE_BLOBS_BYTES
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most_bytes)

    def _version(self) -> int | None:
        """Return a number that changes when another program has written to the file; None where this connection cannot
        read it any more."""
        try:
            return int(self.db.execute("PRAGMA data_version").fetchone()[0])
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if "locked" in str(error):
                raise
            return None

    def _state_now(self) -> tuple[int | None, ...]:
        """Return numbers that change when another program writes to the file, or puts another one in its place."""
        try:
            file = self.path.stat()
        except OSError as error:
            raise MapError(f"{self.path} is gone ({error.strerror}): put it back.") from error
        return self._version(), file.st_dev, file.st_ino, file.st_size, file.st_mtime_ns
