"""A folder of maps, one a tile of a fixed grid, read as one map of which a few tiles are in RAM.

The number of a place is that of its tile, times 2^32, plus that in its file. `runtime.flight.tiles` decides which tiles
are in RAM."""

import hashlib
import sqlite3
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Doubles, LatLon
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.geodesy import offset_m, shorter_deg
from edgevpr.core.quadkeys import maps_in, tile_extent
from edgevpr.core.types import Place, Position
from edgevpr.places import mapfiles
from edgevpr.places.index import PlaceIndex, bytes_per_place, empty_index, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import MapIdentity
from edgevpr.places.readmap import Footprints

INDEX = "index.gpkg"  # of a folder: its table `tiles` has for each its key, places, and the hash of its inputs
_OF_TILE = 1 << 32
_AT_A_CORNER = 4  # tiles
_MOVED_AT_ONCE = 4096  # places; NumPy copies what it moves within an array
_CACHE_KB = 256  # of pages of a file, which SQLite keeps: a place is read once


@dataclass(frozen=True, slots=True)
class Loaded:
    """A tile whose places are written to free slots: its number, its open map, and the places that are there."""

    tile: int
    place_map: PlaceMap
    places: int
    footprints: Footprints


class TileIndex:
    """The index of several tiles, one after the other in arrays of at most `capacity` places, those that are searched
    together side by side. Only `add` and `drop` change which places are in use, so another thread
    may meanwhile write to those `beyond` them."""

    def __init__(self, spec: TechniqueSpec, capacity: int) -> None:
        self._slots = empty_index(spec, capacity, None)
        self._held: dict[int, int] = {}  # places of each tile, in the order of the slots

    @property
    def tiles(self) -> tuple[int, ...]:
        """The numbers of the tiles that it holds."""
        return tuple(self._held)

    @property
    def capacity(self) -> int:
        """The number of places for which there is room."""
        return len(self._slots)

    @property
    def free(self) -> int:
        """The number of free slots."""
        return self.capacity - sum(self._held.values())

    def of(self, tiles: Collection[int]) -> PlaceIndex:
        """Return the index of some of the tiles that it holds, as views until the next `drop` or `of`. What lies
        between them is moved away."""
        last = [tile for tile in self._held if tile in tiles]
        if tuple(last) not in {self.tiles[at : at + len(last)] for at in range(len(self._held))}:
            for tile in last:
                self._move_to_end(tile)
        start = self._slice_of(last[0]).start if last else 0
        return self._slots.only(slice(start, start + sum(self._held[tile] for tile in last)))

    def beyond(self) -> PlaceIndex:
        """Return the free slots, to write places to."""
        return self._slots.only(slice(self.capacity - self.free, None))

    def add(self, tile: int, places: int) -> None:
        """Use the first `places` slots of those `beyond`, which have been written, as those of a tile."""
        self._held[tile] = places

    def drop(self, tile: int) -> None:
        """Free the slots of a tile: the places after it move to where it was."""
        self._move_to_end(tile)
        del self._held[tile]

    def _move_to_end(self, tile: int) -> None:
        """Move a tile's places behind those of all other tiles."""
        own, end = self._slice_of(tile), self.capacity - self.free
        for array in self._slots.arrays.values():
            kept = array[own].copy()
            for start in range(own.stop, end, _MOVED_AT_ONCE):
                moved = array[start : min(start + _MOVED_AT_ONCE, end)]
                array[start - len(kept) : start - len(kept) + len(moved)] = moved
            array[end - len(kept) : end] = kept
        self._held[tile] = self._held.pop(tile)

    def _slice_of(self, tile: int) -> slice:
        start = sum(self._held[before] for before in self.tiles[: self.tiles.index(tile)])
        return slice(start, start + self._held[tile])


class TileMap:
    """An open folder of tiles; see `readmap.ReadMap`. A tile's number is its place in `keys`. `places_of` int (T,) has
    the number of places of each, and `ram` is the index of those that are loaded. Make it with `open`, and load at
    least one tile before it is searched.

    All of it is for one thread, but `load`, which may run beside it."""

    def __init__(self, folder: Path, keys: tuple[str, ...], places_of: Array, spec: TechniqueSpec) -> None:
        self.path, self.keys, self.places_of, self.spec = folder, keys, places_of, spec
        self.left_out: dict[int, str] = {}
        self._extents_deg = np.array([tile_extent(key) for key in keys])
        self._held: dict[int, Loaded] = {}
        self._wait_s = mapfiles.WAIT_S
        self.ram = TileIndex(spec, 0)
        self._technique: Technique | None = None
        self._opened: PlaceMap | None = None  # while it is loaded

    @classmethod
    def open(cls, folder: str | Path) -> "TileMap":
        """Open a folder. Raises MapError if it has no tile, or its first one cannot be opened."""
        folder = Path(folder)
        if not (paths := maps_in(folder)):
            raise MapError(f"{folder} is no folder of maps: give one that `edgevpr fleet build` has made.")
        known = dict(_rows(folder, "key, places"))
        places_of = [known[key] if key in known else _counted(path) for key, path in paths.items()]
        with PlaceMap.open(next(iter(paths.values()))) as first:
            spec = first.spec
        return cls(folder, tuple(paths), np.array(places_of), spec)

    def make_room(self, technique: Technique, budget_bytes: int) -> None:
        """Allocate an index of `budget_bytes`, or of all places if these take less. Raises MapError if it is too small
        for one place."""
        each = bytes_per_place(technique.spec)
        if technique.spec.packed is not None:
            raise MapError(f"{self.path}: tiles of `{technique.spec.name}` cannot be flown: build a map of one file.")
        if budget_bytes < each:
            raise MapError(f"{self.path}: a place takes {each} bytes in RAM: raise --budget-mb.")
        self._technique = technique
        self.ram = TileIndex(technique.spec, min(budget_bytes // each, len(self)))

    @property
    def most_searched(self) -> int:
        """The most places that are searched at once, where tiles meet."""
        return _AT_A_CORNER * int(self.places_of.max())

    def load(self, tile: int) -> Loaded:
        """Read a tile into free slots: of more places than there are, the best. Raises MapError if it cannot be read,
        or is of another technique."""
        assert self._technique is not None
        with ExitStack() as on_error:
            place_map = PlaceMap.open(self.path / f"{self.keys[tile]}.gpkg")
            on_error.callback(place_map.close)
            self._opened = place_map
            place_map.db.execute(f"PRAGMA cache_size = -{_CACHE_KB}")
            place_map.require(self._technique.spec)
            place_map.wait_at_most(self._wait_s)
            slots = self.ram.beyond()
            room_bytes = len(slots) * bytes_per_place(self._technique.spec)
            loaded = load_index(place_map, self._technique, room_bytes, into=slots)
            if loaded.place_ids.max() >= _OF_TILE:
                raise MapError(f"{place_map.path}: a place has the number {loaded.place_ids.max()}: build it again.")
            loaded.place_ids[:] += tile * _OF_TILE
            ids, length_m, is_cut = place_map.footprints()
            self._opened = None
            on_error.pop_all()
        return Loaded(tile, place_map, len(loaded), Footprints(ids + tile * _OF_TILE, length_m, is_cut))

    def interrupt(self) -> None:
        """Have a `load` that runs beside this raise MapError soon."""
        if opened := self._opened:
            with suppress(sqlite3.ProgrammingError):  # it is closed: it could not be used
                opened.db.interrupt()

    def take(self, loaded: Loaded) -> None:
        """Search a tile that has been loaded from now on."""
        self.ram.add(loaded.tile, loaded.places)
        self._held[loaded.tile] = loaded
        for own_id, problem in loaded.place_map.left_out.items():
            self.left_out.setdefault(loaded.tile * _OF_TILE + own_id, problem)

    def drop(self, tile: int) -> None:
        """Search a tile no more, and free its room. No tile may be loading meanwhile."""
        self.ram.drop(tile)
        self._held.pop(tile).place_map.close()

    def away_m(self, position: Position) -> Doubles:
        """Return the distance of each tile from a position, in metres, float64 (T,): 0 inside."""
        south, west, north, east = self._extents_deg.T
        lat_deg = np.clip(position.lat_deg, south, north)
        half_deg, off_deg = (east - west) / 2, shorter_deg(position.lon_deg - (west + east) / 2)
        lon_deg = (west + east) / 2 + np.clip(off_deg, -half_deg, half_deg)
        east_m, north_m = offset_m(position.lat_deg, position.lon_deg, lat_deg, lon_deg)
        return np.asarray(np.hypot(east_m, north_m))

    def side_m(self, tile: int) -> float:
        """Return the length of a tile from south to north, metres."""
        south, west, north, _ = self._extents_deg[tile]
        return float(offset_m(south, west, north, west)[1])

    def identity(self) -> MapIdentity | None:
        """Return the identity by what all tiles were made of, which the index of the folder says; None without it."""
        made_of = sorted(row for row in _rows(self.path, "key, inputs_sha256") if row[0] in self.keys)
        digest = hashlib.sha256(repr(made_of).encode()).hexdigest()
        return MapIdentity(None, len(self), digest) if len(made_of) == len(self.keys) else None

    def __len__(self) -> int:
        return int(self.places_of.sum())

    @property
    def mask_sha256(self) -> str | None:
        return self._first.mask_sha256

    @property
    def lens(self) -> str | None:
        return self._first.lens

    @property
    def calibration(self) -> str | None:
        return self._first.calibration

    def require(self, spec: TechniqueSpec) -> None:
        with PlaceMap.open(self.path / f"{self.keys[0]}.gpkg") as first:
            first.require(spec)

    def require_unchanged(self) -> None:
        for each in self._held.values():
            each.place_map.require_unchanged()

    def wait_at_most(self, wait_s: float) -> None:
        self._wait_s = wait_s
        for each in self._held.values():
            each.place_map.wait_at_most(wait_s)

    def places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]:
        """Yield places as `PlaceMap.places` does; without numbers, those of the tiles in RAM."""
        ids = self.ram.of(self.ram.tiles).place_ids.tolist() if place_ids is None else place_ids
        for place_id in ids:
            with self._of(place_id) as (place_map, own_id):
                (place,) = place_map.places([own_id])
            yield replace(place, place_id=int(place_id))

    def places_in(self, keys: Collection[str]) -> Iterator[Place]:
        """Yield the places of tiles that need not be in RAM, by their keys; keys of no tile here are passed over."""
        for tile, key in enumerate(self.keys):
            if key in keys:
                with PlaceMap.open(self.path / f"{key}.gpkg") as place_map:
                    for place in place_map.places():
                        yield replace(place, place_id=tile * _OF_TILE + place.place_id)

    def fine_part(self, place_id: int) -> tuple[Array, LatLon | None]:
        with self._of(place_id) as (place_map, own_id):
            return place_map.fine_part(own_id)

    def landmarks_of(self, place_id: int) -> bytes | None:
        with self._of(place_id) as (place_map, own_id):
            return place_map.landmarks_of(own_id)

    def footprints(self) -> Footprints:
        parts = zip(*(self._held[tile].footprints for tile in self.ram.tiles), strict=True)
        return Footprints(*map(np.concatenate, parts))

    def close(self) -> None:
        for each in self._held.values():
            each.place_map.close()

    @property
    def _first(self) -> PlaceMap:
        return self._held[self.ram.tiles[0]].place_map

    @contextmanager
    def _of(self, place_id: int) -> Iterator[tuple[PlaceMap, int]]:
        """Yield the map of a place, and its number there. A PlaceError has the number that is known here."""
        tile, own_id = divmod(int(place_id), _OF_TILE)
        if tile not in self._held:
            raise PlaceError(self.path, int(place_id), "its tile is not loaded")
        try:
            yield self._held[tile].place_map, own_id
        except PlaceError as error:
            raise PlaceError(self._held[tile].place_map.path, int(place_id), error.problem) from error


def own_number(place_id: int) -> int:
    """Return the number that a place has in its own file."""
    return place_id % _OF_TILE


def tile_of_place(place_id: int) -> int:
    """Return the number of the tile that a place belongs to."""
    return place_id // _OF_TILE


def _rows(folder: Path, columns: str) -> list[tuple[Any, Any]]:
    """Return two columns of all rows of the index of a folder; empty if there is none that can be read."""
    with suppress(sqlite3.Error, OSError):
        if (folder / INDEX).is_file():
            with closing(mapfiles.connect(folder / INDEX, "ro")) as db:
                return db.execute(f"SELECT {columns} FROM tiles").fetchall()
    return []


def _counted(path: Path) -> int:
    with PlaceMap.open(path) as place_map:
        return len(place_map)
