"""The place map: one GeoPackage file.

Every place is committed before it is confirmed, so a battery pulled while mapping loses at most the place that was
being written, and never the file.
"""

import json
import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.errors import MapError
from edgevpr.geodesy import EARTH_RADIUS_M, distance_m
from edgevpr.places import geopackage
from edgevpr.places.mapspec import differences, read_mask, read_spec, write_mask, write_spec
from edgevpr.places.sqlite import connect, sentences, settle, settle_left_log, start_log
from edgevpr.types import Frame, Place, Position

_PLACE_COLUMNS = "place_id, geom, time, alt_m, heading_deg, source_image, quality"
_IN_BOX = """
SELECT place_id, geom FROM rtree_places_geom JOIN places ON place_id = id
WHERE maxy >= ? AND miny <= ? AND maxx >= ? AND minx <= ?
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapInfo:
    """Summary of a map; `extent` is (lat_min, lon_min, lat_max, lon_max) in degrees, None without positions."""

    path: str
    spec: TechniqueSpec
    places: int
    with_position: int
    extent: tuple[float, float, float, float] | None
    first_time: str | None
    last_time: str | None
    mean_quality: float | None
    file_bytes: int
    made_by: str


class PlaceMap:
    """An open map file. Use `create`, `open` or `open_for_adding`, and close it (it is a context manager)."""

    def __init__(self, path: Path, connection: sqlite3.Connection, spec: TechniqueSpec, writable: bool) -> None:
        self.path, self.spec = path, spec
        self._db = connection
        self._writable = writable

    @classmethod
    def create(cls, path: str | Path, spec: TechniqueSpec) -> "PlaceMap":
        """Make an empty map for descriptors of `spec`. Raises MapError if the file has content or cannot be written."""
        path = Path(path)
        if path.exists() and path.stat().st_size:
            raise MapError(f"{path} is there already: choose another name, or add to it with --append.")
        with sentences(path):
            db = connect(path, "rwc")
            db.execute(f"PRAGMA application_id = {geopackage.APPLICATION_ID}")
            db.execute(f"PRAGMA user_version = {geopackage.USER_VERSION}")
            start_log(db)
            db.executescript("BEGIN;" + geopackage.SCHEMA)
            write_spec(db, spec)
            db.execute("COMMIT")
        return cls(path, db, spec, writable=True)

    @classmethod
    def open(cls, path: str | Path) -> "PlaceMap":
        """Open a map for reading. Raises MapError for a file that is missing, damaged, no place map, or of a newer
        format."""
        path = _existing(path)
        settle_left_log(path)
        with sentences(path):
            db = connect(path, "ro")
            return cls(path, db, read_spec(path, db), writable=False)

    @classmethod
    def open_for_adding(cls, path: str | Path) -> "PlaceMap":
        """Open an existing map to add places to it. Raises MapError as `open` does."""
        path = _existing(path)
        with sentences(path):
            db = connect(path, "rw")
            spec = read_spec(path, db)
            start_log(db)
            return cls(path, db, spec, writable=True)

    def __enter__(self) -> "PlaceMap":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. A map that was written becomes one plain file again, readable from a read-only card."""
        if self._writable:
            settle(self._db)
        self._db.close()

    def require(self, spec: TechniqueSpec) -> None:
        """Raise MapError, naming what differs, unless the map's descriptors were made by exactly `spec`."""
        if different := differences(self.spec, spec):
            raise MapError(
                f"{self.path} was made differently ({'; '.join(different)}): use it with its own technique and "
                "parameters, or build a map with these."
            )

    def add(self, frame: Frame, descriptor: Descriptor) -> int:
        """Add one place and return its id once it is safe on the disk. Raises MapError (disk full, ...)."""
        position = frame.position
        row = (
            geopackage.point_blob(position.lat_deg, position.lon_deg) if position else None,
            geopackage.utc_text(frame.t_utc_s),
            position.alt_m if position else None,
            frame.heading_deg,
            frame.name,
            descriptor.quality,
            _blob(descriptor.coarse, self.spec.coarse),
            _blob(descriptor.fine, self.spec.fine),
        )
        with sentences(self.path), self._transaction():
            cursor = self._db.execute(
                "INSERT INTO places (geom, time, alt_m, heading_deg, source_image, quality, coarse, fine) "
                "VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                row,
            )
            if position:
                self._db.execute(geopackage.GROW_EXTENT, {"lat": position.lat_deg, "lon": position.lon_deg})
        return cursor.lastrowid

    @property
    def mask_sha256(self) -> str | None:
        """The overlay mask that the places were made with; None: none, or unknown."""
        with sentences(self.path):
            return read_mask(self._db)

    def record_mask(self, sha256: str | None) -> None:
        """Record the overlay mask that the places are made with (None: none). Raises MapError."""
        with sentences(self.path), self._transaction():
            write_mask(self._db, sha256)

    def index_positions(self) -> None:
        """Add the R-tree of the standard, unless the map has it. `nearest_m` needs it, and is fast for any map size."""
        with sentences(self.path):
            if not self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'rtree_places_geom'").fetchone():
                try:
                    self._db.executescript("BEGIN IMMEDIATE;" + geopackage.SPATIAL_INDEX + "COMMIT;")
                except sqlite3.Error:
                    if self._db.in_transaction:
                        self._db.execute("ROLLBACK")
                    raise

    def nearest_m(self, position: Position, within_m: float) -> float | None:
        """Return the metres to the nearest place of the file; None where none lies within `within_m` metres.

        Call `index_positions` before. Raises MapError where the file cannot be read.
        """
        lat_deg, lon_deg = position.lat_deg, position.lon_deg
        north_deg = math.degrees(within_m / EARTH_RADIUS_M)
        east_deg = min(180.0, north_deg / max(math.cos(math.radians(min(abs(lat_deg) + north_deg, 90.0))), 1e-9))
        nearest_m = math.inf
        with sentences(self.path):
            for turn_deg in (-360.0, 0.0, 360.0):  # places on the other side of the date line
                box = (lat_deg - north_deg, lat_deg + north_deg, lon_deg + turn_deg - east_deg)
                for place_id, geom in self._db.execute(_IN_BOX, (*box, lon_deg + turn_deg + east_deg)):
                    away_m = distance_m(lat_deg, lon_deg, *self._point(place_id, geom))
                    nearest_m = min(nearest_m, float(away_m))
        return nearest_m if nearest_m <= within_m else None

    def absorb(self, other: "PlaceMap") -> tuple[int, int]:
        """Copy every place of another map of the same technique, all or none; return (copied, already here).

        A place is already here when image name, time and coarse part are the same. Raises MapError as `require` does,
        and where a file cannot be read or written.
        """
        self.require(other.spec)
        columns = "geom, time, alt_m, heading_deg, source_image, quality, coarse, fine"
        before = len(self)
        with sentences(self.path), sentences(other.path), self._transaction():
            here = {
                (*key, hash(coarse))
                for *key, coarse in self._db.execute("SELECT source_image, time, coarse FROM places")
            }
            for row in other._db.execute(f"SELECT {columns} FROM places ORDER BY place_id"):
                if (row[4], row[1], hash(row[6])) not in here:
                    self._db.execute(f"INSERT INTO places ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
                    if row[0]:
                        lat_deg, lon_deg = geopackage.read_point(row[0])
                        self._db.execute(geopackage.GROW_EXTENT, {"lat": lat_deg, "lon": lon_deg})
        copied = len(self) - before
        return copied, len(other) - copied

    def info(self) -> MapInfo:
        """Summarise the map."""
        with sentences(self.path):
            places, with_position, first, last, quality = self._db.execute(
                "SELECT count(*), count(geom), min(time), max(time), avg(quality) FROM places"
            ).fetchone()
            extent = self._db.execute(
                "SELECT min_y, min_x, max_y, max_x FROM gpkg_contents WHERE table_name = 'places'"
            ).fetchone()
            (made_by,) = self._db.execute("SELECT value FROM edgevpr_map WHERE key = 'made_by'").fetchone()
        return MapInfo(
            path=str(self.path),
            spec=self.spec,
            places=places,
            with_position=with_position,
            extent=extent if with_position else None,
            first_time=first,
            last_time=last,
            mean_quality=quality,
            file_bytes=self.path.stat().st_size,
            made_by=json.loads(made_by),
        )

    def places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]:
        """Yield the places of `place_ids` in the order given, or (None) all places in the order they were added.

        Raises MapError for an id that is not in the map, and for a damaged position.
        """
        with sentences(self.path):
            if place_ids is None:
                for row in self._db.execute(f"SELECT {_PLACE_COLUMNS} FROM places ORDER BY place_id"):
                    yield self._place(row)
                return
            for place_id in place_ids:
                yield self._place(
                    self._db.execute(
                        f"SELECT {_PLACE_COLUMNS} FROM places WHERE place_id = ?", (int(place_id),)
                    ).fetchone()
                )

    def coarse_parts(self) -> Iterator[tuple[int, tuple[float, float] | None, np.ndarray]]:
        """Yield (place_id, (lat_deg, lon_deg) or None, coarse part) of every place, in the order they were added.

        Raises MapError for a damaged place.
        """
        with sentences(self.path):
            for place_id, geom, coarse in self._db.execute(
                "SELECT place_id, geom, coarse FROM places ORDER BY place_id"
            ):
                part = self._part(coarse, self.spec.coarse, place_id)
                if not np.isfinite(part).all():
                    raise self._damaged(place_id)
                yield place_id, self._point(place_id, geom), part

    def headings_deg(self) -> Iterator[float]:
        """Yield the heading of every place, 0 up to 360 or NaN where unknown, in the order they were added."""
        with sentences(self.path):
            for (heading_deg,) in self._db.execute("SELECT CAST(heading_deg AS REAL) FROM places ORDER BY place_id"):
                yield math.nan if heading_deg is None else heading_deg % 360

    def fingerprint(self, source_image: str, descriptor: Descriptor) -> tuple[str, int]:
        """Return the values that identify a frame: its name, and a hash of its coarse part."""
        return source_image, hash(_blob(descriptor.coarse, self.spec.coarse))

    def fingerprints(self) -> set[tuple[str, int]]:
        """Return the `fingerprint` of every place of the map."""
        with sentences(self.path):
            return {
                (name, hash(coarse)) for name, coarse in self._db.execute("SELECT source_image, coarse FROM places")
            }

    def positions_and_quality(self, places: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lat_deg, lon_deg (NaN where unknown) and quality of the first `places` places, float64 (N,) each."""
        columns = np.full((3, places), np.nan)
        for at, place in zip(range(places), self.places(), strict=False):
            if place.position:
                columns[:2, at] = place.position.lat_deg, place.position.lon_deg
            columns[2, at] = place.quality
        return columns[0], columns[1], columns[2]

    def mean_coarse(self) -> np.ndarray:
        """Return the mean of all coarse parts of the map, float32 with the shape of one part."""
        mean = np.zeros(self.spec.coarse.shape)
        for count, (_, _, part) in enumerate(self.coarse_parts(), start=1):
            mean += (part - mean) / count
        return mean.astype(np.float32)

    def fine_part(self, place_id: int) -> np.ndarray:
        """Read the fine part of one place from the file (read-only array of `spec.fine`).

        Raises MapError for a place that is missing or damaged.
        """
        with sentences(self.path):
            row = self._db.execute("SELECT fine FROM places WHERE place_id = ?", (int(place_id),)).fetchone()
        if row is None:
            raise MapError(f"{self.path}: place {place_id} is gone; another program changed the map: load it again.")
        return self._part(row[0], self.spec.fine, place_id)

    def __len__(self) -> int:
        with sentences(self.path):
            return self._db.execute("SELECT count(*) FROM places").fetchone()[0]

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._db.execute("COMMIT")
        except BaseException:
            if self._db.in_transaction:  # SQLite has already rolled back where the disk is full
                self._db.execute("ROLLBACK")
            raise

    def _place(self, row: tuple | None) -> Place:
        if row is None:
            raise MapError(f"{self.path}: a place is gone, another program changed the map: load it again.")
        place_id, geom, time, alt_m, heading_deg, source_image, quality = row
        point = self._point(place_id, geom)
        position = Position(*point, alt_m) if point else None
        return Place(
            place_id=place_id,
            source_image=source_image,
            position=position,
            t_utc_s=geopackage.utc_seconds(time),
            heading_deg=heading_deg,
            quality=quality,
        )

    def _point(self, place_id: int, geom: bytes | None) -> tuple[float, float] | None:
        try:
            return geopackage.read_point(geom) if geom else None
        except ValueError as error:
            raise MapError(
                f"{self.path}: place {place_id}: {error}: correct it in the program that wrote it."
            ) from error

    def _damaged(self, place_id: int) -> MapError:
        return MapError(
            f"{self.path}: place {place_id} is damaged: build the map again, or delete that row with sqlite3."
        )

    def _part(self, blob: bytes, spec: PartSpec, place_id: int) -> np.ndarray:
        if blob is None or len(blob) != spec.nbytes:
            raise self._damaged(place_id)
        return np.frombuffer(blob, spec.dtype).reshape(spec.shape)


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.exists():
        raise MapError(f"There is no map {path}: make one with `edgevpr map build {path} --images DIR`.")
    return path


def _blob(part: np.ndarray | None, spec: PartSpec | None) -> bytes | None:
    if spec is None:
        return None
    return np.ascontiguousarray(part, spec.dtype).reshape(spec.shape).tobytes()
