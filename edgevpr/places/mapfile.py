"""The place map: one GeoPackage file.

Every place is committed before it is confirmed, so a battery pulled while mapping loses at most the place that was
being written, and never the file. What is read is checked (see `rows`): a place that cannot be read is left out, and
the others are used.
"""

import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from edgevpr.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.errors import MapError, PlaceError
from edgevpr.places import geopackage, mapfiles, rows
from edgevpr.places.mapspec import (
    Stored,
    differences,
    has_checksums,
    read_mask,
    require_layer,
    spec_of,
    stored,
    write_mask,
    write_spec,
)  # fmt: skip
from edgevpr.places.rows import Point, Unreadable
from edgevpr.places.sqlite import (
    WAIT_S,
    connect,
    connect_to_read,
    is_of_one_row,
    most_bytes,
    sentences,
    settle,
    settle_left_log,
    start_log,
    wait_at_most,
)  # fmt: skip
from edgevpr.types import Frame, Place

_BESIDE_BLOBS_BYTES = 100_000  # what a row may have beside its descriptor: the name of its image


class PlaceMap:
    """An open map file. Use `create`, `open` or `open_for_adding`, and close it (it is a context manager).

    `left_out` are the places that could not be read so far, with what is wrong with each in a few words, in the order
    in which they were found. `checksums` are the SQL expressions of the checksums of position, coarse and fine part.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, found: Stored, lock: int | None = None) -> None:
        self.path, self.spec = path, spec_of(path, found)
        self.has_checksums = has_checksums(found)
        self.left_out: dict[int, str] = {}
        self.made_by = found["made_by"] if isinstance(found.get("made_by"), str) else None
        self._found, self._lock = found, lock  # the lock of the program that adds places; None: only read
        self.checksums = rows.CHECKSUMS if self.has_checksums else "NULL, NULL, NULL"
        self._geom_checksum, self._coarse_checksum, self._fine_checksum = self.checksums.split(", ")
        self._wait_s = WAIT_S
        self._take(connection)
        self._seen = self._state()

    @classmethod
    def create(cls, path: str | Path, spec: TechniqueSpec) -> "PlaceMap":
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
                    db = connect(path, "rw")
                    db.execute(f"PRAGMA application_id = {geopackage.APPLICATION_ID}")
                    db.execute(f"PRAGMA user_version = {geopackage.USER_VERSION}")
                    start_log(db)
                    db.executescript("BEGIN;" + geopackage.SCHEMA)
                    write_spec(db, spec)
                    db.execute("COMMIT")
                    return cls(path, db, stored(path, db), lock)
            except BaseException:
                mapfiles.remove(path)
                raise
        except BaseException:
            os.close(lock)
            raise

    @classmethod
    def open(cls, path: str | Path) -> "PlaceMap":
        """Open a map for reading. Raises MapError for a file that is missing, damaged, no place map, or of a newer
        format, and UsageError for a name that no file can have."""
        path = mapfiles.existing(path)
        settle_left_log(path)
        with sentences(path):
            db = connect_to_read(path)
            try:
                return cls(path, db, _checked(path, db))
            except BaseException:
                db.close()
                raise

    @classmethod
    def open_for_adding(cls, path: str | Path) -> "PlaceMap":
        """Open an existing map to add places to it. Raises MapError as `open` does, and MapBusyError where another
        program adds places to it."""
        path = mapfiles.existing(path)
        lock = mapfiles.lock(path)
        try:
            with sentences(path):
                db = connect(path, "rw")
                found = _checked(path, db)
                start_log(db)
                return cls(path, db, found, lock)
        except BaseException:
            os.close(lock)
            raise

    def __enter__(self) -> "PlaceMap":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. A map that was written becomes one plain file again, readable from a read-only card."""
        if self._lock is not None:
            settle(self.db)
        self.db.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def require(self, spec: TechniqueSpec) -> None:
        """Raise MapError, naming what differs, unless the map's descriptors were made by exactly `spec`."""
        if different := differences(self.spec, spec):
            raise MapError(
                f"{self.path} was made differently ({'; '.join(different)}): use it with its own technique and "
                "parameters, or build a map with these."
            )

    def require_unchanged(self) -> None:
        """Raise MapError where the file is gone, cannot be read, or is another map than the one that was opened.

        This is cheap: only when another program has touched the file is it opened anew, and its map_id compared. The
        new connection is then used, since the old one may have kept pages of another file.
        """
        with sentences(self.path):
            state = self._state()
            if state == self._seen:
                return
            mapfiles.existing(self.path)
            fresh = connect_to_read(self.path, self._wait_s)
            try:
                if _checked(self.path, fresh) != self._found:
                    raise MapError(f"{self.path} is another map than the one that was opened: put that one back.")
                if self._lock is not None:
                    fresh.close()
                    fresh = connect(self.path, "rw", wait_s=self._wait_s)
                    start_log(fresh)
            except BaseException:
                fresh.close()
                raise
            self.db.close()
            self._take(fresh)
            self._seen = self._version(), *state[1:]

    def wait_at_most(self, wait_s: float) -> None:
        """From now on, wait at most so long for another program that is writing; then MapBusyError is raised."""
        self._wait_s = wait_s
        wait_at_most(self.db, wait_s)

    def add(self, frame: Frame, descriptor: Descriptor) -> int:
        """Add one place and return its id once it is safe on the disk. Raises MapError (disk full, ...).

        A time that is no date is unknown, and so is an altitude at which nothing flies. In a name that is not UTF-8,
        the bytes that are not are written as escapes.
        """
        position = frame.position
        geom = geopackage.point_blob(position.lat_deg, position.lon_deg) if position else None
        coarse, fine = _blob(descriptor.coarse, self.spec.coarse), _blob(descriptor.fine, self.spec.fine)
        values = (
            geom,
            geopackage.utc_text(frame.t_utc_s),
            rows.altitude(position.alt_m) if position else None,
            frame.heading_deg,
            _readable(frame.name),
            descriptor.quality,
        )
        with sentences(self.path), self.transaction():
            place_id = self.insert(values, coarse, fine)
        return place_id

    def insert(self, values: tuple, coarse: bytes, fine: bytes | None, place_id: int | None = None) -> int:
        """Insert a row inside a `transaction`; `values` are those of `rows.VALUES`. Raises sqlite3.Error."""
        columns, row = f"place_id, {rows.VALUES}, {rows.BLOBS}", (place_id, *values, coarse, fine)
        if self.has_checksums:
            columns += f", {rows.CHECKSUMS}"
            row += tuple(map(rows.crc32, (values[0], coarse, fine)))
        marks = ", ".join("?" * len(row))
        cursor = self.db.execute(f"INSERT INTO places ({columns}) VALUES ({marks})", row)
        if values[0] is not None:
            lat_deg, lon_deg = geopackage.read_point(values[0])
            self.db.execute(geopackage.GROW_EXTENT, {"lat": lat_deg, "lon": lon_deg})
        return cursor.lastrowid

    @property
    def mask_sha256(self) -> str | None:
        """The overlay mask that the places were made with; None: none, or unknown."""
        with sentences(self.path):
            return read_mask(self.db)

    def record_mask(self, sha256: str | None) -> None:
        """Record the overlay mask that the places are made with (None: none). Raises MapError."""
        with sentences(self.path), self.transaction():
            write_mask(self.db, sha256)

    def places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]:
        """Yield the places of `place_ids` in the order given, or (None) all places in the order they were added.

        Raises PlaceError for one that is missing or damaged.
        """
        columns = f"{rows.VALUES}, {self._geom_checksum}"
        if place_ids is None:
            found = self.scan(columns)
        else:
            found = ((int(place_id), self._row(int(place_id), columns)) for place_id in place_ids)
        for place_id, row in found:
            with self._named(place_id):
                *values, checksum = _there(row)
                place = rows.place_of(place_id, values, checksum)
            yield place

    def coarse_parts(self) -> Iterator[tuple[int, Point | None, float | None, np.ndarray]]:
        """Yield (place_id, (lat_deg, lon_deg) or None, heading_deg or None, coarse part) of every place that can be
        read, in the order they were added; the others are added to `left_out`."""
        columns = f"{rows.VALUES}, {self._geom_checksum}, coarse, {self._coarse_checksum}"
        for place_id, row in self.scan(columns):
            try:
                *values, geom_checksum, coarse, checksum = _there(row)
                point, heading_deg = rows.where_of(values, geom_checksum)
                part = rows.part_of(coarse, self.spec.coarse, checksum, "coarse part")
            except Unreadable as error:
                self.left_out.setdefault(place_id, str(error))
                continue
            yield place_id, point, heading_deg, part

    def mean_coarse(self) -> np.ndarray:
        """Return the mean of all coarse parts that can be read, float32 with the shape of one part."""
        mean, count = np.zeros(self.spec.coarse.shape), 0
        for _, row in self.scan(f"coarse, {self._coarse_checksum}"):
            with suppress(Unreadable):
                coarse, checksum = _there(row)
                part = rows.part_of(coarse, self.spec.coarse, checksum, "coarse part")
                count += 1
                mean += (part - mean) / count
        return mean.astype(np.float32)

    def fine_part(self, place_id: int) -> tuple[np.ndarray, Point | None]:
        """Read the fine part of one place from the file (read-only array of `spec.fine`), and its position.

        Raises PlaceError for one that is missing or damaged.
        """
        place_id = int(place_id)
        columns = f"geom, {self._geom_checksum}, fine, {self._fine_checksum}"
        with self._named(place_id):
            geom, geom_checksum, fine, checksum = _there(self._row(place_id, columns))
            point = rows.point_of(geom, geom_checksum)
            return rows.part_of(fine, self.spec.fine, checksum, "fine part"), point

    def fingerprint(self, source_image: str, descriptor: Descriptor) -> tuple[str, int]:
        """Return the values that identify a frame: its name, and a hash of its coarse part."""
        return _readable(source_image), hash(_blob(descriptor.coarse, self.spec.coarse))

    def fingerprints(self) -> set[tuple[str, int]]:
        """Return the `fingerprint` of every place of the map that can be read."""
        found = (row for _, row in self.scan("source_image, coarse") if row)
        return {(name, hash(coarse)) for name, coarse in found if isinstance(name, str)}

    def outlines(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield (place_id, lat_deg, lon_deg, quality) of every place that can be read; NaN where it has no position."""
        columns = f"geom, quality, {self._geom_checksum}"
        for place_id, row in self.scan(columns):
            try:
                geom, quality, checksum = _there(row)
                lat_deg, lon_deg = rows.point_of(geom, checksum) or (np.nan, np.nan)
                yield place_id, lat_deg, lon_deg, rows.quality_of(quality)
            except Unreadable as error:
                self.left_out.setdefault(place_id, str(error))

    def qualities(self, place_ids: Iterable[int]) -> Iterator[float]:
        """Yield the quality of each of the places; 0 for one that cannot be read, which is added to `left_out`."""
        for place_id in place_ids:
            try:
                (place,) = self.places([place_id])
                yield place.quality
            except PlaceError as error:
                self.left_out.setdefault(error.place_id, error.problem)
                yield 0.0

    def __len__(self) -> int:
        with sentences(self.path):
            try:
                # Counted row by row: SQLite's own count of a table that refers to itself need not end.
                asked = "SELECT count(*) FROM (SELECT 1 FROM places LIMIT ?)"
                return self.db.execute(asked, (rows.most_rows(self._file_bytes()),)).fetchone()[0]
            except sqlite3.Error as error:
                if not is_of_one_row(error):
                    raise
        return sum(row is not None for _, row in self.scan("1"))

    def scan(self, columns: str) -> Iterator[tuple[int, tuple | None]]:
        """Yield (place id, row) of every place (see `rows.scan`)."""
        with sentences(self.path):
            yield from rows.scan(self.db, columns, self._file_bytes())

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Commit what is written inside this context, or nothing of it."""
        self.db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self.db.execute("COMMIT")
        except BaseException:
            if self.db.in_transaction:  # SQLite has already rolled back where the disk is full
                self.db.execute("ROLLBACK")
            raise

    def _row(self, place_id: int, columns: str) -> tuple | None:
        with sentences(self.path):
            try:
                return self.db.execute(f"SELECT {columns} FROM places WHERE place_id = ?", (place_id,)).fetchone()
            except sqlite3.Error as error:
                if not is_of_one_row(error):
                    raise
                raise PlaceError(self.path, place_id, f"SQLite says: {error}") from error

    @contextmanager
    def _named(self, place_id: int) -> Iterator[None]:
        """Turn what is wrong with a row into a PlaceError."""
        try:
            yield
        except Unreadable as error:
            raise PlaceError(self.path, place_id, str(error)) from error

    def _file_bytes(self) -> int:
        (pages,), (page_bytes,) = (self.db.execute(f"PRAGMA page_{name}").fetchone() for name in ("count", "size"))
        return pages * page_bytes

    def _take(self, connection: sqlite3.Connection) -> None:
        self.db = connection
        fine_bytes = self.spec.fine.nbytes if self.spec.fine else 0
        most_bytes(connection, self.spec.coarse.nbytes + fine_bytes + _BESIDE_BLOBS_BYTES)

    def _version(self) -> int | None:
        """Return a number that changes when another program has written to the file; None where this connection cannot
        read it any more."""
        try:
            return self.db.execute("PRAGMA data_version").fetchone()[0]
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if "locked" in str(error):
                raise
            return None

    def _state(self) -> tuple[int | None, ...]:
        """Return numbers that change when another program writes to the file, or puts another one in its place."""
        try:
            file = self.path.stat()
        except OSError as error:
            raise MapError(f"{self.path} is gone ({error.strerror}): put it back.") from error
        return self._version(), file.st_dev, file.st_ino, file.st_size, file.st_mtime_ns


def _checked(path: Path, db: sqlite3.Connection) -> Stored:
    """Return what the file says of the map, after a look at the form of its table of places."""
    found = stored(path, db)
    require_layer(path, db, has_checksums(found))
    return found


def _there(row: tuple | None) -> tuple:
    if row is None:
        raise Unreadable("its row is gone")
    return row


def _blob(part: np.ndarray | None, spec: PartSpec | None) -> bytes | None:
    if spec is None:
        return None
    return np.ascontiguousarray(part, spec.dtype).reshape(spec.shape).tobytes()


def _readable(name: str) -> str:
    return name.encode("utf-8", "backslashreplace").decode()
