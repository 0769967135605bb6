"""The place map: reads and writes the places of one GeoPackage file.

`PlaceMap.add` returns only after a place is committed, so a power failure while mapping loses at most the place that
was being written, and never the file. All values read are checked (see `rows`): a place that cannot be read is left
out, and the others are used. The base class `MapConnection` holds the open file."""

import json
import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles, Ints, LatLon, Singles
from edgevpr.core.contract import Descriptor, TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Frame, Place, Pose, Position, Salience
from edgevpr.places import geopackage, mapspec, rows
from edgevpr.places.connection import MapConnection
from edgevpr.places.mapfiles import is_row_error, translate_errors

_COARSE_COLUMNS = f"{rows.VALUES}, geom_crc32, coarse, coarse_crc32"
_ATTRIBUTION_SEPARATOR = "; "
_MAX_DIFFERENT_FRACTION = 0.05  # of the values of two coarse parts of the same picture
_MAX_RELATIVE_DIFFERENCE = 0.01  # of their norm: far above rounding errors, far below that of two pictures


class _StoredText:
    """A text in the table edgevpr_map, under the name of the attribute; None if it is missing or cannot be read."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._key = name

    def __get__(self, place_map: "PlaceMap", owner: type) -> str | None:
        with translate_errors(place_map.path):
            try:
                row = place_map.db.execute("SELECT value FROM edgevpr_map WHERE key = ?", (self._key,)).fetchone()
                value = json.loads(row[0]) if row else None
                return value if isinstance(value, str) else None
            except (ValueError, TypeError, RecursionError):
                return None
            except sqlite3.Error as error:
                if is_row_error(error):
                    return None
                raise


class PlaceMap(MapConnection):
    """An open map. `left_out` maps the id of each place that could not be read so far to the reason in a few words, in
    the order of discovery.

    `mask_sha256`: hash of the overlay mask that was used to make the places. `lens`: name of the camera calibration
    used to undistort their pictures. `attribution`: attribution texts of the orthophotos from which places were cut.
    `calibration`: the calibration of confidences (see `mapmaking.calibrate`). Each is None if absent or unknown."""

    mask_sha256 = _StoredText()
    lens = _StoredText()
    attribution = _StoredText()
    calibration = _StoredText()

    def require_technique(self, spec: TechniqueSpec) -> None:
        """Raise MapError, listing the differences, unless the map's descriptors were made by exactly `spec`."""
        if differences := mapspec.list_differences(self.spec, spec):
            raise MapError(
                f"{self.path} was made with other settings ({'; '.join(differences)}): use these settings, or "
                "build a map with the present ones."
            )

    def add(
        self, frame: Frame, descriptor: Descriptor, salience: Salience | None = None, landmarks: bytes | None = None
    ) -> int:
        """Add one place, and return its id once it is safely on disk. Drop the calibration, which does not know the
        place. Raises MapError (disk full, ...).

        `salience` and `landmarks` (encoded bytes) are None if there are none. An impossible time or altitude is stored
        as unknown. Characters of the frame's name that UTF-8 cannot encode are stored as escapes."""
        content = rows.make_content(frame, descriptor, self.spec, salience, landmarks)
        with self.transaction():
            self.db.execute("DELETE FROM edgevpr_map WHERE key = 'calibration'")
            return self.insert(content)

    def insert(self, content: rows.Content, place_id: int | None = None) -> int:
        """Insert a row with its checksums, inside a `transaction`; return its id. Raises sqlite3.Error."""
        row = {"place_id": place_id, **content, **rows.compute_checksums(content)}
        placeholders = ", ".join("?" * len(row))
        cursor = self.db.execute(f"INSERT INTO places ({', '.join(row)}) VALUES ({placeholders})", tuple(row.values()))
        if row["geom"] is not None:
            self._grow_extent(*geopackage.decode_point(row["geom"]))
        return int(cursor.lastrowid or 0)

    def move_place(self, place_id: int, position: Position, pose: Pose | None) -> None:
        """Replace the position and the pose (None: unknown) of a place, in a `transaction`. Raises sqlite3.Error."""
        geom, content = geopackage.encode_point(position.lat_deg, position.lon_deg), rows.make_pose_content(pose)
        # The trigger `places_moved` sets columns to NULL when geom changes, so they are written in a second statement.
        self.db.execute("UPDATE places SET geom = ? WHERE place_id = ?", (geom, place_id))
        pose_crc32 = rows.compute_pose_crc32(tuple(content.values()))
        row = {**content, "geom_crc32": rows.compute_crc32(geom), "pose_crc32": pose_crc32}
        columns = ", ".join(f"{name} = ?" for name in row)
        self.db.execute(f"UPDATE places SET {columns} WHERE place_id = ?", (*row.values(), place_id))
        self._grow_extent(position.lat_deg, position.lon_deg)

    def record_mask(self, sha256: str | None) -> None:
        """Store the SHA-256 of the overlay mask that is used to make the places (None: no mask). Raises MapError."""
        self._record_text("mask_sha256", sha256)

    def record_lens(self, path: str | None) -> None:
        """Store the name of the camera calibration used to undistort pictures (None: nothing). Raises MapError."""
        if path is not None:
            self._record_text("lens", Path(path).name)

    def add_attribution(self, text: str | None) -> None:
        """Add an attribution text to the stored ones (None: store nothing). Raises MapError."""
        if text:
            texts = [*(self.attribution or text).split(_ATTRIBUTION_SEPARATOR), *text.split(_ATTRIBUTION_SEPARATOR)]
            self._record_text("attribution", _ATTRIBUTION_SEPARATOR.join(dict.fromkeys(texts)))

    def record_calibration(self, text: str | None) -> None:
        """Store the map's calibration of confidences, as text (None: not calibrated). Raises MapError."""
        self._record_text("calibration", text)

    def read_places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]:
        """Yield the places `place_ids`, in that order (None: all places, in the order in which they were added). Raises
        PlaceError for a place that is missing or damaged."""
        for place_id in [place_id for place_id, _ in self.scan_rows("1")] if place_ids is None else map(int, place_ids):
            with self._convert_row_errors(place_id):
                place = rows.parse_place(place_id, self.read_row(place_id, rows.PLACE_COLUMNS))
            yield place

    def read_coarse_parts(self) -> Iterator[tuple[int, LatLon | None, float | None, Array]]:
        """Yield (place_id, (lat_deg, lon_deg) or None, heading_deg or None, coarse part as array of `spec.coarse`) of
        every readable place, in the order in which they were added. Record the other places in `left_out`."""
        for place_id, row in self.scan_rows(_COARSE_COLUMNS):
            with self._skip_unreadable(place_id):
                content = rows.read_columns(_COARSE_COLUMNS, row)
                point, heading_deg = rows.parse_position(content)
                yield place_id, point, heading_deg, rows.decode_part(content, "coarse", self.spec.coarse)

    def compute_mean_coarse(self) -> Singles:
        """Return the mean of all readable coarse parts, float32 of the shape of one part."""
        mean, count = np.zeros(self.spec.coarse.shape), 0
        for _, row in self.scan_rows(columns := "coarse, coarse_crc32"):
            with suppress(rows.RowError):
                part = rows.decode_part(rows.read_columns(columns, row), "coarse", self.spec.coarse)
                count += 1
                mean += (part - mean) / count
        return mean.astype(np.float32)

    def read_fine_part(self, place_id: int) -> tuple[Array, LatLon | None]:
        """Read one place from the file: return its fine part, a read-only array of `spec.fine`, and its (lat_deg,
        lon_deg), None if it has no position. Raises PlaceError for a place that is missing or damaged."""
        with self._convert_row_errors(place_id):
            if self.spec.fine is None:
                raise rows.RowError("it has no fine part")
            content = self.read_row(int(place_id), "geom, geom_crc32, fine, fine_crc32")
            point = rows.parse_point(content)
            return rows.decode_part(content, "fine", self.spec.fine), point

    def read_landmarks(self, place_id: int) -> bytes | None:
        """Read the encoded landmarks of one place from the file; None if it has none. Raises PlaceError."""
        with self._convert_row_errors(place_id):
            return rows.read_landmarks(self.read_row(int(place_id), "landmarks, landmarks_crc32"))

    def read_footprints(self) -> tuple[Ints, Doubles, Bools]:
        """Read the footprints of the places that have one, in insertion order: return the ids, int64 (M,), the lengths
        of ground along a picture's longest side, float64 (M,) metres, and bool (M,), True for the pictures that were
        cut from an orthophoto. Raises MapError."""
        places = [(place_id, *row) for place_id, row in self.scan_rows("footprint_m, is_surveyed") if row]
        places = [place for place in places if isinstance(place[1], float) and 0 < place[1] < math.inf]
        table = np.array(places, [("id", np.int64), ("length_m", float), ("is_surveyed", bool)])
        return table["id"], table["length_m"], table["is_surveyed"]

    def select_ids(self, columns: str) -> dict[rows.Values, list[int]]:
        """Group the readable places by their values in `columns`: return the list of ids for each tuple of values."""
        ids: dict[rows.Values, list[int]] = {}
        for place_id, row in self.scan_rows(columns):
            if row:
                ids.setdefault(row, []).append(place_id)
        return ids

    def has_descriptor(self, place_id: int, coarse: Array) -> bool:
        """Return True if a place's coarse part nearly equals `coarse`, so that both are from the same picture; False if
        the place cannot be read. Between two runs, the last bits of values may differ, or a few elements."""
        try:
            stored = rows.decode_part(self.read_row(place_id, "coarse"), "coarse", self.spec.coarse).astype(np.float32)
        except (rows.RowError, PlaceError):
            return False
        candidate = np.asarray(coarse, np.float32).reshape(stored.shape)
        is_near = np.linalg.norm(stored - candidate) <= _MAX_RELATIVE_DIFFERENCE * np.linalg.norm(stored)
        return bool(is_near or np.mean(stored != candidate) <= _MAX_DIFFERENT_FRACTION)

    def read_outlines(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield (place_id, lat_deg, lon_deg, quality 0..1) of every readable place, NaN for an unknown position. Record
        the other places in `left_out`."""
        columns = "geom, quality, geom_crc32"
        for place_id, row in self.scan_rows(columns):
            with self._skip_unreadable(place_id):
                content = rows.read_columns(columns, row)
                lat_deg, lon_deg = rows.parse_point(content) or (math.nan, math.nan)
                yield place_id, lat_deg, lon_deg, rows.parse_quality(content)

    def _grow_extent(self, lat_deg: float, lon_deg: float) -> None:
        self.db.execute(geopackage.GROW_EXTENT, {"table": "places", "lat": lat_deg, "lon": lon_deg})

    def _record_text(self, key: str, text: str | None) -> None:
        with self.transaction():
            self.db.execute("INSERT OR REPLACE INTO edgevpr_map (key, value) VALUES (?, ?)", (key, json.dumps(text)))

    @contextmanager
    def _convert_row_errors(self, place_id: int) -> Iterator[None]:
        """Turn the exception `RowError`, raised in the body of `with`, into a PlaceError with the place's id."""
        try:
            yield
        except rows.RowError as error:
            raise PlaceError(self.path, place_id, str(error)) from error

    @contextmanager
    def _skip_unreadable(self, place_id: int) -> Iterator[None]:
        """If the body of `with` raises `RowError`, record the place and the reason in `left_out`, and continue."""
        try:
            yield
        except rows.RowError as error:
            self.left_out.setdefault(place_id, str(error))
