"""Files of map tiles that GDAL does not read: raster PMTiles, and the tile caches of QGroundControl and of Mission
Planner (GMap.NET), which are SQLite files."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgevpr.core.errors import SourceError, UsageError
from edgevpr.mapmaking.tiles import Ground, Level, TileStore, box_of, full_level, levels_of

_SQLITE = b"SQLite format 3\x00"
_WAIT_S = 5.0  # for a program that is writing to its cache
_E7 = 1e7  # PMTiles has degrees as whole numbers


class _Cache(NamedTuple):
    """A program that caches tiles, and the queries of its file: kinds of map with their names and numbers of tiles,
    zoom, x and y of all tiles of a kind, and the tile of a kind, x, y and zoom."""

    program: str
    kinds: str
    tiles: str
    tile: str


# By the table that tells the caches apart. The key of a tile in QGroundControl is the number of the kind of map, which
# has had four and ten digits, and then eight digits of x, eight of y and three of the zoom. Tiles `bin` are heights.
_CACHES = {
    "TilesData": _Cache(
        "Mission Planner",
        "SELECT Type, '', count(*) FROM Tiles GROUP BY Type ORDER BY count(*) DESC",
        "SELECT Zoom, X, Y FROM Tiles WHERE Type = ?",
        "SELECT Tile FROM TilesData JOIN Tiles USING (id) WHERE Type = ? AND X = ? AND Y = ? AND Zoom = ?",
    ),
    "TileSets": _Cache(
        "QGroundControl",
        "SELECT substr(hash, 1, length(hash) - 19) AS kind, ifnull(max(typeStr), ''), count(DISTINCT hash) FROM Tiles "
        "LEFT JOIN SetTiles USING (tileID) LEFT JOIN (SELECT setID, typeStr FROM TileSets) USING (setID) "
        "WHERE format <> 'bin' GROUP BY kind ORDER BY count(*) DESC",
        "SELECT CAST(substr(hash, -3) AS INT), CAST(substr(hash, -19, 8) AS INT), CAST(substr(hash, -11, 8) AS INT) "
        "FROM Tiles WHERE substr(hash, 1, length(hash) - 19) = ? AND format <> 'bin'",
        "SELECT tile FROM Tiles WHERE hash = ? || printf('%08d%08d%03d', ?, ?, ?)",
    ),
}


def tiles_in(path: Path, kind: str) -> TileStore | None:
    """Return the tiles in a file, of one `kind` of map ("": the only one); None for a file of another form. Raises
    SourceError if it cannot be read, and UsageError if it has several kinds, or not this one."""
    with open(path, "rb") as file:
        head = file.read(len(_SQLITE))
    if path.suffix.lower() == ".pmtiles" or head.startswith(b"PMTiles"):
        return PmTiles(path)
    if head == _SQLITE:
        with _sentences(path, "the program that made it"), closing(_opened(path)) as db:
            tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        for table, cache in _CACHES.items():
            if {"Tiles", table} <= tables:
                return CacheTiles(path, cache, kind)
    return None


class CacheTiles:
    """The tiles of one kind of map in a cache, see `TileStore`."""

    def __init__(self, path: Path, cache: _Cache, kind: str) -> None:
        self.name, self.short_name, self._path, self._cache = str(path), path.name, path, cache
        with _sentences(path, cache.program):
            self._db = _opened(path)
            kinds = [(str(number), str(name), int(count)) for number, name, count in self._db.execute(cache.kinds)]
        fitting = [number for number, name, _ in kinds if not kind or kind in (number, name)]
        if kinds and len(fitting) != 1:
            self.close()
            listed = ", ".join(f"{name or number} ({count} tiles)" for number, name, count in kinds)
            number, name, _ = kinds[0]
            raise UsageError(f"{path} has tiles of several maps, {listed}: name one, as in {path}#{name or number}.")
        self._kind = fitting[0] if fitting else ""

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        """See `TileStore`."""
        with _sentences(self._path, self._cache.program):
            rows = np.array(self._db.execute(self._cache.tiles, (self._kind,)).fetchall(), int).reshape(-1, 3)
        return levels_of(rows[(rows[:, 0] >= 0) & (rows[:, 0] < 32)], box_of(ground))

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        """See `TileStore`."""
        with _sentences(self._path, self._cache.program):
            row = self._db.execute(self._cache.tile, (self._kind, x, y, zoom)).fetchone()
        return row[0] if row and isinstance(row[0], bytes) else None

    def close(self) -> None:
        """Close the file."""
        self._db.close()


def _opened(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=_WAIT_S)


@contextmanager
def _sentences(path: Path, program: str) -> Iterator[None]:
    """Turn the errors of SQLite in the body of `with` into a SourceError."""
    try:
        yield
    except (sqlite3.Error, OverflowError) as error:
        raise SourceError(
            f"{path} cannot be read as a cache of tiles ({error}): close {program}, and give a copy of the file."
        ) from error


class PmTiles:
    """The tiles of a PMTiles file, see `TileStore`."""

    def __init__(self, path: Path) -> None:
        try:
            from pmtiles.reader import MmapSource, Reader
            from pmtiles.tile import MagicNumberNotFound, SpecVersionUnsupported, TileType
        except ModuleNotFoundError as error:
            raise SourceError(
                f"{path} is read with pmtiles, which is not installed: run `pip install pmtiles`."
            ) from error
        self.name, self.short_name = str(path), path.name
        try:
            with open(path, "rb") as file:
                self._reader = Reader(MmapSource(file))
            self._header = self._reader.header()
        except (MagicNumberNotFound, SpecVersionUnsupported, ValueError, IndexError) as error:
            raise SourceError(f"{path} is no PMTiles file of version 3: copy or export it again.") from error
        if self._header["tile_type"] == TileType.MVT:
            raise SourceError(f"{path} holds vector tiles, and no pictures: give raster tiles of the ground.")
        if not self._header["root_length"] or not self._header["tile_data_length"]:
            raise SourceError(f"{path} holds no tiles: export it again.")

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        """See `TileStore`. To list the tiles would take long: all of the ground, or of the file's own extent, count as
        there."""
        sides = ("min_lat", "min_lon", "max_lat", "max_lon")
        south, west, north, east = (self._header[f"{side}_e7"] / _E7 for side in sides)
        box = box_of(ground or Ground((south, west, north, east), 1.0))
        return {zoom: full_level(zoom, box) for zoom in range(self._header["min_zoom"], self._header["max_zoom"] + 1)}

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        """See `TileStore`."""
        try:
            tile: bytes | None = self._reader.get(zoom, x, y)
            return tile
        except (ValueError, EOFError, OSError, IndexError):  # a damaged directory
            return None

    def close(self) -> None:
        """Do nothing: the file is mapped, and closed with the last reference."""
