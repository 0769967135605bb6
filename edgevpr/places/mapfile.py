"""The place map: one GeoPackage file, and the places in it.

Every place is committed before it is confirmed, so a battery pulled while mapping loses at most the place that was
being written, and never the file. What is read is checked (see `rows`): a place that cannot be read is left out, and
the others are used. The open file itself is a `MapConnection`.
"""

import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

import numpy as np

from edgevpr.core.contract import Descriptor, TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Frame, Place, Pose, Position, Salience
from edgevpr.places import geopackage, mapspec, rows
from edgevpr.places.connection import MapConnection
from edgevpr.places.mapspec import differences, has_checksums, has_pose, has_salience, read_text, write_text
from edgevpr.places.rows import Content, Point, Unreadable
from edgevpr.places.sqlite import sentences

_OTHERS = 0.05  # of the numbers of a coarse part
_SAME_PICTURE = 0.01  # of the length of a coarse part: far more than rounding, far less than another picture


class PlaceMap:
    """An open map. Use `create`, `open` or `open_for_adding`, and close it (it is a context manager).

    `left_out` are the places that could not be read so far, with what is wrong with each in a few words, in the order
    in which they were found. `salience`, `pose`, `landmarks` and `checksums` are the SQL expressions of a place's
    salience, pose and landmarks, and of the checksums of position, coarse part, fine part, pose and landmarks.
    """

    def __init__(self, file: MapConnection) -> None:
        self._file = file
        self.path, self.spec, self.has_checksums = file.path, file.spec, has_checksums(file.found)
        self.left_out: dict[int, str] = {}
        made_by = file.found.get("made_by")
        self.made_by = made_by if isinstance(made_by, str) else None
        map_id = file.found.get("map_id")
        self.map_id = map_id if isinstance(map_id, str) else None
        self.has_salience = has_salience(file.found)
        self.salience = rows.SALIENCE if self.has_salience else "NULL, NULL, NULL, NULL"
        self.has_pose = has_pose(file.found)
        self.pose = rows.POSE if self.has_pose else ", ".join(["NULL"] * rows.POSES)
        self.landmarks = rows.LANDMARKS if self.has_pose else "NULL"
        new = rows.NEW_CHECKSUMS if self.has_pose else "NULL, NULL"
        self.checksums = f"{rows.CHECKSUMS if self.has_checksums else 'NULL, NULL, NULL'}, {new}"
        checksums = self.checksums.split(", ")
        self._geom_checksum, self._coarse_checksum, self._fine_checksum = checksums[:3]
        self._pose_checksum, self._landmarks_checksum = checksums[3:]

    @classmethod
    def create(cls, path: str | Path, spec: TechniqueSpec) -> "PlaceMap":
        """Make an empty map for descriptors of `spec`: all of it, or no file. Raises MapError if the file has content
        or cannot be written, and UsageError for a name that no file can have."""
        return cls(MapConnection.create(path, spec))

    @classmethod
    def open(cls, path: str | Path) -> "PlaceMap":
        """Open a map for reading. Raises MapError for a file that is missing, damaged, no place map, or of a newer
        format, and UsageError for a name that no file can have."""
        return cls(MapConnection.open(path))

    @classmethod
    def open_for_adding(cls, path: str | Path) -> "PlaceMap":
        """Open an existing map to add places to it. Raises MapError as `open` does, and MapBusyError where another
        program adds places to it."""
        return cls(MapConnection.open_for_adding(path))

    def __enter__(self) -> "PlaceMap":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. A map that was written becomes one plain file again, readable from a read-only card."""
        self._file.close()

    @property
    def db(self) -> sqlite3.Connection:
        """The connection of SQLite, for this moment: `require_unchanged` may put another one in its place."""
        return self._file.db

    def require(self, spec: TechniqueSpec) -> None:
        """Raise MapError, naming what differs, unless the map's descriptors were made by exactly `spec`."""
        if different := differences(self.spec, spec):
            raise MapError(
                f"{self.path} was made differently ({'; '.join(different)}): use it with its own technique and "
                "parameters, or build a map with these."
            )

    def require_unchanged(self) -> None:
        """Raise MapError where the file is gone, cannot be read, or is another map than the one that was opened. This
        is cheap."""
        self._file.require_unchanged()

    def wait_at_most(self, wait_s: float) -> None:
        """From now on, wait at most so long for another program that is writing; then MapBusyError is raised."""
        self._file.wait_at_most(wait_s)

    def transaction(self) -> AbstractContextManager[None]:
        """Commit what is written inside this context, or nothing of it. Raises sqlite3.Error."""
        return self._file.transaction()

    def add(
        self, frame: Frame, descriptor: Descriptor, salience: Salience | None = None, landmarks: bytes | None = None
    ) -> int:
        """Add one place and return its id once it is safe on the disk. Raises MapError (disk full, ...).

        A time that is no date is unknown, and so is an altitude at which nothing flies. In a name that is not UTF-8,
        the bytes that are not are written as escapes. A map of an older format takes no pose and no landmarks.
        """
        content = Content(
            values=rows.values_of(frame, descriptor.quality),
            salience=rows.salience_values(salience),
            pose=rows.pose_values(frame.pose),
            coarse=rows.blob_of(descriptor.coarse, self.spec.coarse),
            fine=rows.blob_of(descriptor.fine, self.spec.fine),
            landmarks=landmarks,
        )
        with sentences(self.path), self.transaction():
            place_id = self.insert(content)
        return place_id

    def insert(self, content: Content, place_id: int | None = None) -> int:
        """Insert a place inside a `transaction`, as far as the map has columns for it. Raises sqlite3.Error."""
        geom, coarse, fine = content.values[0], content.coarse, content.fine
        columns, row = f"place_id, {rows.VALUES}, {rows.BLOBS}", (place_id, *content.values, coarse, fine)
        if self.has_salience:
            columns, row = f"{columns}, {rows.SALIENCE}", row + content.salience
        if self.has_checksums:
            columns, row = f"{columns}, {rows.CHECKSUMS}", row + tuple(map(rows.crc32, (geom, coarse, fine)))
        if self.has_pose:
            columns = f"{columns}, {rows.POSE}, {rows.LANDMARKS}, {rows.NEW_CHECKSUMS}"
            row += (*content.pose, content.landmarks, rows.pose_crc32(content.pose), rows.crc32(content.landmarks))
        marks = ", ".join("?" * len(row))
        cursor = self.db.execute(f"INSERT INTO places ({columns}) VALUES ({marks})", row)
        if geom is not None:
            lat_deg, lon_deg = geopackage.read_point(geom)
            self.db.execute(geopackage.GROW_EXTENT, {"lat": lat_deg, "lon": lon_deg})
        return cursor.lastrowid

    def lay(self, place_id: int, position: Position, pose: Pose | None) -> None:
        """Move a place inside a `transaction`, and keep how its picture lies there (None: unknown). Raises
        sqlite3.Error."""
        geom, values = geopackage.point_blob(position.lat_deg, position.lon_deg), rows.pose_values(pose)
        # The trigger that follows a move takes away what is written after it.
        self.db.execute("UPDATE places SET geom = ? WHERE place_id = ?", (geom, place_id))
        columns = ", ".join(f"{name} = ?" for name in f"geom_crc32, {rows.POSE}, pose_crc32".split(", "))
        row = (rows.crc32(geom), *values, rows.pose_crc32(values), place_id)
        self.db.execute(f"UPDATE places SET {columns} WHERE place_id = ?", row)
        self.db.execute(geopackage.GROW_EXTENT, {"lat": position.lat_deg, "lon": position.lon_deg})

    @property
    def mask_sha256(self) -> str | None:
        """The overlay mask that the places were made with; None: none, or unknown."""
        with sentences(self.path):
            return read_text(self.db, mapspec.MASK)

    def record_mask(self, sha256: str | None) -> None:
        """Record the overlay mask that the places are made with (None: none). Raises MapError."""
        with sentences(self.path), self.transaction():
            write_text(self.db, mapspec.MASK, sha256)

    @property
    def calibration(self) -> str | None:
        """Text that was recorded of how sure the map can be (see `calibrate`); None: none, or none that is a text."""
        with sentences(self.path):
            return read_text(self.db, mapspec.CALIBRATION)

    def record_calibration(self, text: str | None) -> None:
        """Record how sure the map can be (None: unknown). Raises MapError."""
        with sentences(self.path), self.transaction():
            write_text(self.db, mapspec.CALIBRATION, text)

    def places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]:
        """Yield the places of `place_ids` in the order given, or (None) all places in the order they were added.

        Raises PlaceError for one that is missing or damaged.
        """
        columns = f"{rows.VALUES}, {self.salience}, {self.pose}, {self._geom_checksum}, {self._pose_checksum}"
        if place_ids is None:
            found = self.scan(columns)
        else:
            found = ((int(place_id), self._file.row(int(place_id), columns)) for place_id in place_ids)
        for place_id, row in found:
            with self._named(place_id):
                *parts, geom_checksum, pose_checksum = rows.there(row)
                values, salience, pose = rows.split(parts)
                place = rows.place_of(place_id, values, salience, pose, geom_checksum, pose_checksum)
            yield place

    def coarse_parts(self) -> Iterator[tuple[int, Point | None, float | None, np.ndarray]]:
        """Yield (place_id, (lat_deg, lon_deg) or None, heading_deg or None, coarse part) of every place that can be
        read, in the order they were added; the others are added to `left_out`."""
        columns = f"{rows.VALUES}, {self._geom_checksum}, coarse, {self._coarse_checksum}"
        for place_id, row in self.scan(columns):
            try:
                *values, geom_checksum, coarse, checksum = rows.there(row)
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
                coarse, checksum = rows.there(row)
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
            geom, geom_checksum, fine, checksum = rows.there(self._file.row(place_id, columns))
            point = rows.point_of(geom, geom_checksum)
            return rows.part_of(fine, self.spec.fine, checksum, "fine part"), point

    def footprint_m(self) -> float | None:
        """Return the median footprint of the places whose pose is known, None where none is."""
        footprints_m = [row[0] for _, row in self.scan(self.pose.split(", ")[1]) if row]
        known = [each for each in footprints_m if isinstance(each, float) and 0 < each < math.inf]
        return float(np.median(known)) if known else None

    def landmarks_of(self, place_id: int) -> bytes | None:
        """Read the landmarks of one place from the file, None where it has none. Raises PlaceError for one that is
        missing or damaged."""
        columns = f"{self.landmarks}, {self._landmarks_checksum}"
        with self._named(place_id):
            return rows.landmarks_of(*rows.there(self._file.row(int(place_id), columns)))

    def ids_by(self, columns: str) -> dict[tuple, list[int]]:
        """Return the ids of the places that can be read, by their values in these columns."""
        found: dict[tuple, list[int]] = {}
        for place_id, row in self.scan(columns):
            if row:
                found.setdefault(row, []).append(place_id)
        return found

    def is_of(self, place_id: int, coarse: np.ndarray) -> bool:
        """Tell whether a place was made of the picture with this coarse part; False for a place that cannot be read.

        The last bits of a descriptor may differ from one run of a program to the next: sums depend on where an array
        lies in memory. Of numbers that stand for something, a few are then others.
        """
        try:
            (blob,) = rows.there(self._file.row(place_id, "coarse"))
            there = rows.part_of(blob, self.spec.coarse, None, "coarse part").astype(np.float32)
        except (Unreadable, PlaceError):
            return False
        here = np.asarray(coarse, np.float32).reshape(there.shape)
        near = np.linalg.norm(there - here) <= _SAME_PICTURE * np.linalg.norm(there)
        return bool(near or np.mean(there != here) <= _OTHERS)

    def outlines(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield (place_id, lat_deg, lon_deg, quality) of every place that can be read; NaN where it has no position."""
        columns = f"geom, quality, {self._geom_checksum}"
        for place_id, row in self.scan(columns):
            try:
                geom, quality, checksum = rows.there(row)
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
        return self._file.count()

    def scan(self, columns: str) -> Iterator[tuple[int, tuple | None]]:
        """Yield (place id, row) of every place (see `rows.scan`)."""
        return self._file.scan(columns)

    @contextmanager
    def _named(self, place_id: int) -> Iterator[None]:
        """Turn what is wrong with a row into a PlaceError."""
        try:
            yield
        except Unreadable as error:
            raise PlaceError(self.path, place_id, str(error)) from error
