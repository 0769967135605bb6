"""The contract of a technique: what it is, what it makes of a picture, and how it compares."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np


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
    """What a technique is. Down to `packed`, what a map must agree with before it is used: name, every parameter,
    model, and the form of both parts. `packed` is the form of a place in RAM where it is not the coarse part as it is:
    `Technique.pack` makes it.

    The rest is what a technique can do beyond the contract; a map does not keep it. Its vectors are held in RAM in
    `form`, one of `forms`, which cost less from one to the next (None and none: it has one form only). It is meant for
    `sequence` queries matched together. With `scan_counts` the score of the scan counts in that of the comparison (see
    `places.retrieve`). A technique that tries a query in several rotations takes a known heading for right within
    `heading_within_deg` (None: headings say nothing to it).
    """

    name: str
    parameters: dict[str, int | float | str]
    coarse: PartSpec
    fine: PartSpec | None = None
    model_sha256: str | None = None
    packed: PartSpec | None = None
    form: str | None = field(default=None, compare=False)
    forms: tuple[str, ...] = field(default=(), compare=False)
    sequence: int = field(default=1, compare=False)
    scan_counts: bool = field(default=False, compare=False)
    heading_within_deg: float | None = field(default=None, compare=False)

    @property
    def row(self) -> PartSpec:
        """Give the form of one place of the index in RAM."""
        return self.packed or self.coarse

    @property
    def smaller_forms(self) -> tuple[str, ...]:
        """Give the forms that cost less than the one it has."""
        return self.forms[self.forms.index(self.form) + 1 :] if self.form else ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Descriptor:
    """One encoded image. `coarse` makes one row of the index in RAM (see `Technique.pack`); `fine` lives in the map
    file and is read for candidates only; `regions` are what a query asks with, and `good` (bool, one a region) says
    which of them speak; `quality` (0..1) is the share of the image that says anything. `picture` is kept for a query
    that may have to be turned."""

    coarse: np.ndarray
    fine: np.ndarray | None = None
    regions: np.ndarray | None = None
    good: np.ndarray | None = None
    quality: float = 1.0
    picture: "Picture | None" = None


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
    no `packed` no `pack`."""

    spec: TechniqueSpec
    candidates: int  # places compared in full after the scan, unless the configuration says otherwise
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
        """MachineSpeed all places at once: `rows` (N, *row.shape) -> scores (N,) float32 and, where `match` has several
        hypotheses to try, those of each, float32 (N, H), -inf where it is out of the question; else None.

        `mean` is that of the map for a technique that packs, else None. `turned_deg` float (N,) is how far the camera
        should have turned since each place was mapped, as `FineMatch.rotation_deg` (NaN: nobody knows); it is given
        only to a technique with `spec.heading_within_deg`, which then allows only such rotations."""
        ...

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None) -> FineMatch:
        """Compare the query with the fine part of one place, under some of its hypotheses or all (None)."""
        ...
