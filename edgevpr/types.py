"""The values that cross rooms: frozen dataclasses, and the contract of a technique."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np


@dataclass(frozen=True, slots=True)
class Position:
    """A point on the WGS-84 ellipsoid; `alt_m` is metres above sea level, None where unknown."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """What the autopilot says of the aircraft: where it believes to be (degrees, metres above sea level), where its
    nose points (0..360 clockwise from north, None where it does not know), and when it said so (`t_heard_s`, on the
    clock of the frames). `has_gps`: a receiver had a 3D fix then, and there. An autopilot goes on saying where it
    believes to be long after it has lost that, and does not follow a receiver it does not trust."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float | None
    t_heard_s: float
    has_gps: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One picture and what is known of it. `image` is uint8, (H, W) grey or (H, W, 3) BGR."""

    image: np.ndarray
    name: str
    t_mono_s: float
    t_utc_s: float | None = None
    position: Position | None = None
    heading_deg: float | None = None


@dataclass(frozen=True, slots=True)
class PartSpec:
    """Shape and little-endian dtype ("<f4", "<i1", ...) of one part of a descriptor."""

    shape: tuple[int, ...]
    dtype: str

    @property
    def nbytes(self) -> int:
        return int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        return f"{'x'.join(map(str, self.shape))} {np.dtype(self.dtype)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueSpec:
    """What a map must agree with before it is used: name, every parameter, model, and the form of both parts.

    `packed` is the form of a place in RAM where it is not the coarse part as it is: `Technique.pack` makes it.
    """

    name: str
    parameters: dict[str, int | float | str]
    coarse: PartSpec
    fine: PartSpec | None = None
    model_sha256: str | None = None
    packed: PartSpec | None = None

    @property
    def row(self) -> PartSpec:
        """One place of the index in RAM."""
        return self.packed or self.coarse


@dataclass(frozen=True, slots=True, kw_only=True)
class Descriptor:
    """One encoded image. `coarse` makes one row of the index in RAM (see `Technique.pack`); `fine` lives in the map
    file and is read for candidates only; `regions` are what a query asks with, and `good` (bool, one a region) says
    which of them speak; `quality` (0..1) is the share of the image that says anything. `picture` is kept for a query
    that may have to be turned, and `asking` collects what was made of it."""

    coarse: np.ndarray
    fine: np.ndarray | None = None
    regions: np.ndarray | None = None
    good: np.ndarray | None = None
    quality: float = 1.0
    picture: "Picture | None" = None
    asking: dict = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Picture:
    """What an image was encoded from: `grey` float32 (side, side) where it may have to be turned (None: it need not),
    `allowed` bool of the same shape (None: all of it), and `seen` bool, the blocks that are wholly allowed."""

    grey: np.ndarray | None
    allowed: np.ndarray | None
    seen: np.ndarray


@dataclass(frozen=True, slots=True)
class FineMatch:
    """One place compared with the query: `score` in 0..1 and, where the technique knows them, the step from the query
    to the place (dx, dy in cells) with its covariance (var x, cov xy, var y), and how far the camera has turned since
    the map was made (clockwise, 0..360)."""

    score: float
    shift_cells: tuple[float, float] | None = None
    covariance_cells2: tuple[float, float, float] | None = None
    rotation_deg: float | None = None


class Technique(Protocol):
    """The contract of `edgevpr/techniques/*.py`. A technique without a fine part needs no `match`, one whose spec has
    no `packed` no `pack`. One that is meant for sequences says by an attribute `sequence` of how many queries, and one
    whose scan sees what its comparison does not, by an attribute `scan_counts` that both count (see `rank`)."""

    spec: TechniqueSpec
    candidates: int  # places compared in full after the scan (see `rank`), unless the configuration says otherwise
    min_score: float  # a match is accepted from this score on, unless the configuration says otherwise ...
    min_margin: float  # ... and when it beats the best place elsewhere by this

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode a uint8 image; `mask` (H, W) bool is False where the picture must not be used."""
        ...

    def pack(self, coarse: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Rows of the index (N, *row.shape) from coarse parts (N, *coarse.shape) and their mean over the map."""
        ...

    def coarse_scores(
        self, query: Descriptor, rows: np.ndarray, mean: np.ndarray | None, turned_deg: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Score all places at once: `rows` (N, *row.shape) -> scores (N,) float32 and, where `match` has several
        hypotheses to try, those of each, float32 (N, H), -inf where it is out of the question; else None.

        `mean` is that of the map for a technique that packs, else None. `turned_deg` float (N,) is how far the camera
        should have turned since each place was mapped, as `FineMatch.rotation_deg` (NaN: nobody knows); it is given
        only to a technique with a parameter `camera` that is "nadir", which then allows only such rotations."""
        ...

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None) -> FineMatch:
        """Compare the query with the fine part of one place, under some of its hypotheses or all (None)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A place of the map as a person knows it (its descriptors are fetched apart)."""

    place_id: int
    source_image: str
    position: Position | None = None
    t_utc_s: float | None = None
    heading_deg: float | None = None
    quality: float = 1.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that may be the one in the query, and how it matches; retrieval returns these best first."""

    place: Place
    match: FineMatch


@dataclass(frozen=True, slots=True)
class StageCost:
    """What one stage cost: wall seconds, and CPU-seconds of all threads of the process."""

    wall_s: float
    cpu_s: float

    def utilisation(self, cores: int) -> float:
        """U of equation 5.1: the share of the whole machine that was busy, 0..1."""
        return min(1.0, self.cpu_s / (self.wall_s * cores)) if self.wall_s > 0 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryCost:
    """Cost of one query by equations 5.1-5.7: times, utilisations of all cores, memory, charge drawn from the pack.

    `rss_mb` is now; `pss_mb`, with shared pages in proportion, may be some seconds old (None: the kernel does not say).
    """

    t_encode_s: float
    t_match_s: float
    u_encode: float
    u_match: float
    cpu_s: float
    rss_mb: float
    used_mah: float
    marginal_mah: float
    pss_mb: float | None = None


@dataclass(frozen=True, slots=True)
class PlaceMatch:
    """The event of one query: the best place (None: the map has none yet), whether it is accepted as the place, and
    what the query cost.

    `position` is the place's, and only there when the match is accepted: a rejected match moves nothing. `descriptor`
    is what the frame was encoded as, for a flight that learns it.
    """

    query: str
    t_mono_s: float
    candidate: Candidate | None
    accepted: bool
    reason: str
    position: Position | None
    accuracy_m: float | None
    cost: QueryCost
    descriptor: Descriptor | None = None
