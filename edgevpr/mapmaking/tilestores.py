"""Where map tiles come from: a folder (zoom/x/y.png), raster PMTiles, the SQLite files that are the tile caches of
QGroundControl and Mission Planner (GMap.NET), and addresses (https://.../{z}/{x}/{y}.png) that the user may read.

An address holds the user's key: messages, maps and names of files have only its host."""

import hashlib
import math
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import cv2
import numpy as np

from edgevpr import __version__
from edgevpr.core.errors import SourceError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.mapmaking.tiles import TILE_PX, Ground, Level, TileStore, bounding_box, full_level, list_zoom_levels

_ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
_SQLITE = b"SQLite format 3\x00"
_WAIT_S = 5.0  # for a program that is writing to its cache
_E7 = 1e7  # PMTiles has degrees as whole numbers
_PLACEHOLDERS = ("{z}", "{x}", "{y}")
_CONNECTIONS = 2
_TIMEOUT_S = 30
_MAX_TILE_BYTES = 10_000_000
_NO_TILE = (404, 410)  # HTTP status
_ZOOMS_TRIED = 3  # from the one that is wanted: servers have different highest ones


def is_address(source: object) -> bool:
    """Return True for the address of tiles, and False for the name of a file or folder."""
    return bool(re.match(r"(?i)https?://", str(source)))


def parse_host(address: str) -> str:
    """Return the host of an address, which may be shown. Raises UsageError for an address that has none."""
    try:
        host = urlsplit(address).hostname
    except ValueError:
        host = None
    if not host:
        raise UsageError("The address of the orthophoto has no host: write https://HOST/.../{z}/{x}/{y}.png.")
    return host


def open_tile_file(path: Path, kind: str) -> TileStore | None:
    """Open the tiles in a folder or a file, of one `kind` of map ("": the only one); None for a file of another form.
    Raises SourceError if it cannot be read, and UsageError if it has several kinds, or not this one."""
    if path.is_dir():
        return FolderTiles(path)
    with open(path, "rb") as file:
        head = file.read(len(_SQLITE))
    if path.suffix.lower() == ".pmtiles" or head.startswith(b"PMTiles"):
        return PmTiles(path)
    if head == _SQLITE:
        with _readable(path, "the program that made it"), closing(_connect(path)) as db:
            tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        for table, cache in _CACHES.items():
            if {"Tiles", table} <= tables:
                return CacheTiles(path, cache, kind)
    return None


class FolderTiles(TileStore):
    """The tiles of a folder (zoom/x/y.png)."""

    def __init__(self, folder: Path) -> None:
        self.name, self.short_name = str(folder), folder.name
        self._tiles = {
            (int(path.parts[-3]), int(path.parts[-2]), int(path.stem)): path
            for path in folder.glob("*/*/*")
            if path.suffix.lower() in _ENDINGS and all(map(str.isdecimal, (*path.parts[-3:-1], path.stem)))
        }

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        return list_zoom_levels(np.array(list(self._tiles), int).reshape(-1, 3), bounding_box(ground))

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        path = self._tiles.get((zoom, x, y))
        return path.read_bytes() if path else None


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


class CacheTiles(TileStore):
    """The tiles of one kind of map in a cache."""

    def __init__(self, path: Path, cache: _Cache, kind: str) -> None:
        self.name, self.short_name, self._path, self._cache = str(path), path.name, path, cache
        with _readable(path, cache.program):
            self._db = _connect(path)
            kinds = [(str(number), str(name), int(count)) for number, name, count in self._db.execute(cache.kinds)]
        fitting = [number for number, name, _ in kinds if not kind or kind in (number, name)]
        if kinds and len(fitting) != 1:
            self.close()
            listed = ", ".join(f"{name or number} ({count} tiles)" for number, name, count in kinds)
            number, name, _ = kinds[0]
            raise UsageError(f"{path} has tiles of several maps, {listed}: name one, as in {path}#{name or number}.")
        self._kind = fitting[0] if fitting else ""

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        with _readable(self._path, self._cache.program):
            rows = np.array(self._db.execute(self._cache.tiles, (self._kind,)).fetchall(), int).reshape(-1, 3)
        return list_zoom_levels(rows[(rows[:, 0] >= 0) & (rows[:, 0] < 32)], bounding_box(ground))

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        with _readable(self._path, self._cache.program):
            row = self._db.execute(self._cache.tile, (self._kind, x, y, zoom)).fetchone()
        return row[0] if row and isinstance(row[0], bytes) else None

    def close(self) -> None:
        self._db.close()


def _connect(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=_WAIT_S)


@contextmanager
def _readable(path: Path, program: str) -> Iterator[None]:
    """Turn the errors of SQLite in the body of `with` into a SourceError."""
    try:
        yield
    except (sqlite3.Error, OverflowError) as error:
        raise SourceError(
            f"{path} cannot be read as a cache of tiles ({error}): close {program}, and give a copy of the file."
        ) from error


class PmTiles(TileStore):
    """The tiles of a PMTiles file. It is mapped into memory, and closed with the last reference."""

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
        if self._header["tile_type"] == TileType.MVT or not self._header["tile_data_length"]:
            raise SourceError(f"{path} holds no pictures: export it with raster tiles of the ground.")

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        # To list the tiles would take long: all of the ground, or of the file's own extent, count as there.
        south, west, north, east = (
            self._header[f"{side}_e7"] / _E7 for side in ("min_lat", "min_lon", "max_lat", "max_lon")
        )
        box = bounding_box(ground or Ground((south, west, north, east), 1.0))
        return {zoom: full_level(zoom, box) for zoom in range(self._header["min_zoom"], self._header["max_zoom"] + 1)}

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        try:
            tile: bytes | None = self._reader.get(zoom, x, y)
            return tile
        except (ValueError, EOFError, OSError, IndexError):  # a damaged directory
            return None


class AddressTiles(TileStore):
    """The tiles of an address. They are kept in a folder, named by host and hash of the address, and none is asked for
    twice; an empty file stands for one that the server does not have."""

    def __init__(self, address: str) -> None:
        self.name = self.short_name = parse_host(address)
        if sorted(re.findall(r"\{[^{}]*\}", address)) != sorted(_PLACEHOLDERS):
            raise UsageError(
                f"The address at {self.name} must have {{z}}, {{x}} and {{y}} where zoom, column and row of a tile "
                "stand, and no other braces: https://HOST/.../{z}/{x}/{y}.png."
            )
        caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        digest = hashlib.sha256(address.encode()).hexdigest()[:16]
        self._address, self._folder = address, Path(caches) / "edgevpr" / "tiles" / f"{self.name}-{digest}"

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        """Return the wanted zoom, or the next coarser that the server has in the middle of the ground."""
        assert ground is not None  # an address needs an area
        box = bounding_box(ground)
        for zoom in range(ground.zoom, max(ground.zoom - _ZOOMS_TRIED, -1), -1):
            at = full_level(zoom, box).some[0]
            if data := self.get(zoom, *at):
                tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
                if tile is None:
                    self._path(zoom, *at).unlink()
                    raise SourceError(f"{self.name} answers with what is no picture: check the address and its key.")
                zoom = max(zoom - round(math.log2(len(tile) / TILE_PX)), 0)  # a larger tile has finer pixels
                return {zoom: full_level(zoom, box)}
        raise SourceError(
            f"{self.name} has no tile of zoom {max(ground.zoom - _ZOOMS_TRIED + 1, 0)} to {ground.zoom} in the middle "
            "of the area (HTTP 404): check address and area; a larger --footprint-m takes coarser tiles."
        )

    def _path(self, zoom: int, x: int, y: int) -> Path:
        return self._folder / str(zoom) / str(x % 2**zoom) / str(y)

    def missing(self, zoom: int, tiles: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return those of `tiles`, x and y each, that are yet to be fetched."""
        return [(x, y) for x, y in tiles if not self._path(zoom, x, y).exists()]

    def fetch(self, zoom: int, tiles: Iterable[tuple[int, int]]) -> Iterator[None]:
        """Fetch tiles, and yield once for each. Raises SourceError."""
        with ThreadPoolExecutor(_CONNECTIONS) as pool:
            for _ in pool.map(lambda at: self.get(zoom, *at), tiles):
                yield

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        """See `TileStore`. Raises SourceError if the server refuses or cannot be reached."""
        path = self._path(zoom, x, y)
        if not path.exists():
            data = self._download(zoom, x % 2**zoom, y)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda unfinished: unfinished.write_bytes(data))
        return path.read_bytes() or None

    def _download(self, zoom: int, x: int, y: int) -> bytes:
        address, status = self._address, None
        for placeholder, number in zip(_PLACEHOLDERS, (zoom, x, y), strict=True):
            address = address.replace(placeholder, str(number))
        try:
            request = Request(address, headers={"User-Agent": f"edgevpr/{__version__}"})
            with urlopen(request, timeout=_TIMEOUT_S) as answer:
                return bytes(answer.read(_MAX_TILE_BYTES))
        except HTTPError as error:
            error.close()
            status = error.code
        except (OSError, HTTPException, ValueError):  # their texts may hold the address, and so must not be chained
            pass
        if status in _NO_TILE:
            return b""
        if status is None:
            what = "cannot be reached: check the address and the network"
        elif status in (401, 403):
            what = f"refuses (HTTP {status}): check the key in the address, and your right to fetch its tiles"
        elif status == 429:
            what = f"asks for a pause (HTTP {status}): wait as long as its terms say"
        else:
            what = f"cannot give a tile (HTTP {status}): check the address, or wait"
        raise SourceError(f"{self.name} {what}, and run this again. Tiles fetched so far are kept.")
