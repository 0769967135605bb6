"""Interface of a map to a search: one file (`mapfile.PlaceMap`), or a folder of tiles (`tilemap.TileMap`)."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

from edgevpr.core.arrays import Array, Bools, Doubles, Ints, LatLon
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.types import Place


class Footprints(NamedTuple):
    """The places of a map that have a footprint: `place_ids` int64 (M,), `length_m` float64 (M,) of the ground that a
    picture's longest side shows, and `is_cut` bool (M,): it was cut from an orthophoto."""

    place_ids: Ints
    length_m: Doubles
    is_cut: Bools


class ReadMap(Protocol):
    """An open map. `left_out`: see `mapfile.PlaceMap`, which says what each of these does."""

    path: Path
    spec: TechniqueSpec
    left_out: dict[int, str]

    @property
    def mask_sha256(self) -> str | None: ...

    @property
    def lens(self) -> str | None: ...

    @property
    def calibration(self) -> str | None: ...

    def __len__(self) -> int: ...

    def require(self, spec: TechniqueSpec) -> None: ...

    def require_unchanged(self) -> None: ...

    def wait_at_most(self, wait_s: float) -> None: ...

    def places(self, place_ids: Iterable[int] | None = None) -> Iterator[Place]: ...

    def fine_part(self, place_id: int) -> tuple[Array, LatLon | None]: ...

    def landmarks_of(self, place_id: int) -> bytes | None: ...

    def footprints(self) -> Footprints: ...

    def close(self) -> None: ...
