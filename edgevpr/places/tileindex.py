"""The index of several tiles of a map: one array of a fixed size, in which whole tiles lie one after the other, those
that are searched together side by side."""

from collections.abc import Collection

from edgevpr.core.contract import TechniqueSpec
from edgevpr.places.index import PlaceIndex, empty_index

_MOVED_AT_ONCE = 4096  # places; NumPy copies what it moves within an array


class TileIndex:
    """The arrays of at most `capacity` places. Only `add` and `drop` change which places are in use, so another thread
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
