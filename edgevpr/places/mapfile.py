"""The place map: one GeoPackage file, and the places in it.

Every place is committed before it is confirmed, so a battery pulled while mapping loses at most the place that was
being written, and never the file. What is read is checked (see `rows`): a place that cannot be read is left out, and
the others are used. The open file itself is a `MapConnection`.
"""

import json
import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Array, LatLon, Singles
from edgevpr.core.contract import Descriptor, TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Frame, Place, Pose, Position, Salience
from edgevpr.places import geopackage, mapspec, rows
from edgevpr.places.connection import MapConnection
from edgevpr.places.rows import Content, Unreadable, Values
from edgevpr.places.sqlite import is_of_one_row, sentences

_OTHERS = 0.05  # of the numbers of a coarse part
_SAME_PICTURE = 0.01  # of the length of a coarse part: far more than rounding, far less than another picture


class PlaceMap(MapConnection):
    """An open map. Use `create`, `open` or `open_for_adding`, and close it (it is a context manager).

    `left_out` are the places that could not be read so far, with what is wrong with each in a few words, in the order
    in which they were found.
    """

    def __init__(self, path: Path, db: sqlite3.Connection, lock: int | None = None) -> None:
        super().__init__(path, db, lock)
        self.left_out: dict[int, str] = {}

    @property
    def map_id(self) -> str | None:
        """The id that was drawn when the map was made; None where the file does not say it."""
        return self._stored_text("map_id")

    @property
    def made_by(self) -> str | None:
        """The program that made the map; None where the file does not say it."""
        return self._stored_text("made_by")

    def require(self, spec: TechniqueSpec) -> None:
        """Raise MapError, naming what differs, unless the map's descriptors were made by exactly `spec`."""
        if different := mapspec.differences(self.spec, spec):
            raise MapError(
                f"{self.path} was made differently ({'; '.join(different)}): use it with its own technique and "
                "parameters, or build a map with these."
            )

    def add(
        self, frame: Frame, descriptor: Descriptor, salience: Salience | None = None, landmarks: bytes | None = None
    ) -> int:
        """Add one place and return its id once it is safe on the disk. Raises MapError (disk full, ...).

        A time that is no date is unknown, and so is an altitude at which nothing flies. In a name that is not UTF-8,
        the bytes that are not are written as escapes.
        """
        content = rows.frame_content(frame, descriptor, self.spec, salience, landmarks)
        with sentences(self.path), self.transaction():
            return self.insert(content)

    def insert(self, content: Content, place_id: int | None = None) -> int:
        """Insert a place inside a `transaction`, with the checksums of its content. Raises sqlite3.Error."""
        row = {"place_id": place_id, **content, **rows.checksums_of(content)}
        marks = ", ".join("?" * len(row))
        cursor = self.db.execute(f"INSERT INTO places ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))
        if row["geom"] is not None:
            self._grow_extent(*geopackage.read_point(row["geom"]))
        return int(cursor.lastrowid or 0)

    def lay(self, place_id: int, position: Position, pose: Pose | None) -> None:
        """Move a place inside a `transaction`, and keep how its picture lies there (None: unknown). Raises
        sqlite3.Error."""
        geom, content = geopackage.point_blob(position.lat_deg, position.lon_deg), rows.pose_content(pose)
        # The trigger that follows a move takes away what is written after it.
        self.db.execute("UPDATE places SET geom = ? WHERE place_id = ?", (geom, place_id))
        row = {**content, "geom_crc32": rows.crc32(geom), "pose_crc32": rows.pose_crc32(tuple(content.values()))}
        columns = ", ".join(f"{name} = ?" for name in row)
        self.db.execute(f"UPDATE places SET {columns} WHERE place_id = ?", (*row.values(), place_id))
        self._grow_extent(position.lat_deg, position.lon_deg)

    @property
    def mask_sha256(self) -> str | None:
        """The overlay mask that the places were made with; None: none, or unknown."""
        return self._text_beside(mapspec.MASK)

    def record_mask(self, sha256: str | None) -> None:
        """Record the overlay mask that the places are made with (None: none). Raises MapError."""
        self._record_beside(mapspec.MASK, sha256)

    @property
    def calibration(self) -> str | None:
        """Text that was recorded of how sure the map can be (see `calibrate`); None: none, or none that is a text."""
        return self._text_beside(mapspec.CALIBRATION)

    def record_calibration(self, text: str | None) -> None:
        """Record how sure the map can be (None: unknown). Raises MapError."""
        self._record_beside(mapspec.CALIBRATION, text)

    def places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]:
        """Yield the places of `place_ids` in the order given, or (None) all places in the order they were added.

        Raises PlaceError for one that is missing or damaged.
        """
        found: Iterable[tuple[int, Values | None]]
        if place_ids is None:
            found = self.scan(rows.OF_PLACE)
        else:
            found = ((int(place_id), self.row(int(place_id), rows.OF_PLACE)) for place_id in place_ids)
        for place_id, row in found:
            with self._named(place_id):
                place = rows.place_of(place_id, rows.content_of(rows.OF_PLACE, row))
            yield place

    def coarse_parts(self) -> Iterator[tuple[int, LatLon | None, float | None, Array]]:
        """Yield (place_id, (lat_deg, lon_deg) or None, heading_deg or None, coarse part) of every place that can be
        read, in the order they were added; the others are added to `left_out`."""
        for place_id, row in self.scan(f"{rows.VALUES}, geom_crc32, coarse, coarse_crc32"):
            try:
                *values, geom_checksum, coarse, checksum = rows.present(row)
                point, heading_deg = rows.where_of(values, geom_checksum)
                part = rows.part_of(coarse, self.spec.coarse, checksum, "coarse part")
            except Unreadable as error:
                self.left_out.setdefault(place_id, str(error))
                continue
            yield place_id, point, heading_deg, part

    def mean_coarse(self) -> Singles:
        """Return the mean of all coarse parts that can be read, float32 with the shape of one part."""
        mean, count = np.zeros(self.spec.coarse.shape), 0
        for _, row in self.scan("coarse, coarse_crc32"):
            with suppress(Unreadable):
                coarse, checksum = rows.present(row)
                part = rows.part_of(coarse, self.spec.coarse, checksum, "coarse part")
                count += 1
                mean += (part - mean) / count
        return mean.astype(np.float32)

    def fine_part(self, place_id: int) -> tuple[Array, LatLon | None]:
        """Read the fine part of one place from the file (read-only array of `spec.fine`), and its position.

        Raises PlaceError for one that is missing or damaged.
        """
        place_id = int(place_id)
        with self._named(place_id):
            if self.spec.fine is None:
                raise Unreadable("it has no fine part")
            geom, geom_checksum, fine, checksum = rows.present(self.row(place_id, "geom, geom_crc32, fine, fine_crc32"))
            point = rows.point_of(geom, geom_checksum)
            return rows.part_of(fine, self.spec.fine, checksum, "fine part"), point

    def footprint_m(self) -> float | None:
        """Return the median footprint of the places whose pose is known, None where none is."""
        footprints_m = [row[0] for _, row in self.scan("footprint_m") if row]
        known = [value for value in footprints_m if isinstance(value, float) and 0 < value < math.inf]
        return float(np.median(known)) if known else None

    def landmarks_of(self, place_id: int) -> bytes | None:
        """Read the landmarks of one place from the file, None where it has none. Raises PlaceError for one that is
        missing or damaged."""
        with self._named(place_id):
            return rows.landmarks_of(*rows.present(self.row(int(place_id), "landmarks, landmarks_crc32")))

    def ids_by(self, columns: str) -> dict[Values, list[int]]:
        """Return the ids of the places that can be read, by their values in these columns."""
        ids: dict[Values, list[int]] = {}
        for place_id, row in self.scan(columns):
            if row:
                ids.setdefault(row, []).append(place_id)
        return ids

    def is_of(self, place_id: int, coarse: Array) -> bool:
        """Tell whether a place was made of the picture with this coarse part; False for a place that cannot be read.

        The last bits of a descriptor may differ from one run of a program to the next: sums depend on where an array
        lies in memory. Of numbers that stand for something, a few are then others.
        """
        try:
            (blob,) = rows.present(self.row(place_id, "coarse"))
            there = rows.part_of(blob, self.spec.coarse, None, "coarse part").astype(np.float32)
        except (Unreadable, PlaceError):
            return False
        here = np.asarray(coarse, np.float32).reshape(there.shape)
        near = np.linalg.norm(there - here) <= _SAME_PICTURE * np.linalg.norm(there)
        return bool(near or np.mean(there != here) <= _OTHERS)

    def outlines(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield (place_id, lat_deg, lon_deg, quality) of every place that can be read; NaN where it has no position."""
        for place_id, row in self.scan("geom, quality, geom_crc32"):
            try:
                geom, quality, checksum = rows.present(row)
                lat_deg, lon_deg = rows.point_of(geom, checksum) or (math.nan, math.nan)
                yield place_id, lat_deg, lon_deg, rows.quality_of(quality)
            except Unreadable as error:
                self.left_out.setdefault(place_id, str(error))

    def _grow_extent(self, lat_deg: float, lon_deg: float) -> None:
        self.db.execute(geopackage.GROW_EXTENT, {"lat": lat_deg, "lon": lon_deg})

    def _stored_text(self, key: str) -> str | None:
        text = self.stored.get(key)
        return text if isinstance(text, str) else None

    def _text_beside(self, key: str) -> str | None:
        """Read what is kept beside the places; None for nothing, or for a row that cannot be read. Raises MapError."""
        with sentences(self.path):
            try:
                row = self.db.execute("SELECT value FROM edgevpr_map WHERE key = ?", (key,)).fetchone()
                text = json.loads(row[0]) if row else None
            except (ValueError, TypeError, RecursionError):
                return None
            except sqlite3.Error as error:
                if is_of_one_row(error):
                    return None
                raise
        return text if isinstance(text, str) else None

    def _record_beside(self, key: str, text: str | None) -> None:
        with sentences(self.path), self.transaction():
            self.db.execute("INSERT OR REPLACE INTO edgevpr_map (key, value) VALUES (?, ?)", (key, json.dumps(text)))

    @contextmanager
    def _named(self, place_id: int) -> Iterator[None]:
        """Turn what is wrong with a row into a PlaceError."""
        try:
            yield
        except Unreadable as error:
            raise PlaceError(self.path, place_id, str(error)) from error
