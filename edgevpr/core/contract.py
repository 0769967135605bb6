"""The contract of a technique: its specification, its descriptor of an image, and its comparison of query and place."""

import math
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


def nearest_height(height_ratios: Sequence[float], height_ratio: float) -> float:
    """Return the one of some height ratios that is nearest to another, by their quotient."""
    return min(height_ratios, key=lambda ratio: abs(math.log(ratio / height_ratio)))


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueSpec:
    """The specification of a technique.

    A map file stores the fields from `name` to `packed`. The map is used only by a technique of the same name, the same
    value of every parameter, the same model, and the same form of both parts. `packed` is the form of a place in RAM,
    made by `Technique.pack`. None: a place in RAM is its coarse part, unchanged.

    The other fields describe abilities beyond the contract; a map does not store them. `form` is the form of the
    vectors in RAM. It is one of `forms`, each smaller than the one before (None and empty: there is one form only).
    `sequence` is the usual number of queries matched together. With `scan_counts` the score of the scan is part of the
    final score (see `places.retrieve`). A technique that tries a query in several rotations tries only those within
    `heading_within_deg` of the rotation that known headings give (None: it does not use headings). One that has
    `height_ratios` finds a query from another height than the map's, when it is asked for from the nearest of them.
    `cells` is how many cells of a `FineMatch` the longest side of a picture has (None: a shift says nothing about
    metres). Of more places than `in_full`, those that look best at a glance are compared in full (None: all are).
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
    cells: int | None = field(default=None, compare=False)
    height_ratios: tuple[float, ...] = field(default=(), compare=False)
    in_full: int | None = field(default=None, compare=False)

    @property
    def row(self) -> PartSpec:
        """The form of one place in the index in RAM."""
        return self.packed or self.coarse


@dataclass(frozen=True, slots=True, kw_only=True)
class Descriptor:
    """The descriptor of one image.

    `coarse` becomes one row of the index in RAM (see `Technique.pack`). `fine` stays in the map file and is read for
    candidates only. `regions` are the region descriptors of a query. `good` (bool, one a region) tells which of them
    are compared. `quality` (0..1) is the share of the image that holds information. `picture` is kept for a query that
    may have to be turned.
    """

    coarse: np.ndarray
    fine: np.ndarray | None = None
    regions: np.ndarray | None = None
    good: np.ndarray | None = None
    quality: float = 1.0
    picture: "Picture | None" = None


@dataclass(frozen=True, slots=True)
class Picture:
    """The prepared picture that a descriptor was made from. `grey` is float32 (side, side), None where the picture is
    never turned. `allowed` is a bool mask of the same shape (None: all pixels). `seen` is bool, True for each block
    that is wholly allowed."""

    grey: np.ndarray | None
    allowed: np.ndarray | None
    seen: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """Support of a step by all regions of query and place, beside those that voted for it. `back` is the share of
    the place's regions that find their most similar region of the query at this step, and `mutual` the share of those
    that are also found by it. `likeness` (cosine) is the mean similarity of the query's regions to the most similar one
    of the place, wherever it is. `log_rank` is the mean natural logarithm of the rank that the region at this step has
    among all of the place, by similarity: 0 where it is always the most similar."""

    back: float
    mutual: float
    likeness: float
    log_rank: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FineMatch:
    """The result of comparing one place with the query: `score` in 0..1, and values that only some techniques give
    (else None). `shift_cells` is the step from the query to the place (dx, dy in cells), with its covariance (var x,
    cov xy, var y). `rotation_deg` is the rotation of the camera since the map was made (clockwise, 0..360), and
    `height_ratio` the camera's height above the ground over that of then. `coverage`
    (0..1) is the share of the place's regions that agree with this step, each counted once, however many regions of the
    query resemble it. `support` is what the other regions say."""

    score: float = field(kw_only=False)
    shift_cells: tuple[float, float] | None = None
    covariance_cells2: tuple[float, float, float] | None = None
    rotation_deg: float | None = None
    height_ratio: float | None = None
    coverage: float | None = None
    support: Support | None = None


class Technique(Protocol):
    """The contract of `edgevpr/techniques/*.py`. A technique without a fine part needs no `match`. A technique whose
    spec has no `packed` needs no `pack`, and one whose spec has no `in_full` needs no `glance`."""

    spec: TechniqueSpec
    candidates: int  # places compared after the scan, unless the configuration sets another number
    min_score: float  # least score of an accepted match, unless the configuration sets another
    min_margin: float  # least margin of an accepted match over the best place elsewhere, likewise
    min_quality: float  # least `Descriptor.quality` of a query that says enough to be recognised

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode a uint8 image; `mask` (H, W) bool is False where the image must not be used."""
        ...

    def pack(self, coarse: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Pack coarse parts (N, *coarse.shape) into rows of the index (N, *row.shape); `mean` is that of the map."""
        ...

    def coarse_scores(
        self,
        query: Descriptor,
        rows: np.ndarray,
        mean: np.ndarray | None,
        turned_deg: np.ndarray | None = None,
        height_ratio: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Score all places at once: `rows` (N, *row.shape) -> scores (N,) float32 and the scores by hypothesis.

        Where `match` has several hypotheses to try, the second value is the score of each, float32 (N, H), -inf for
        one that is ruled out; else None. `mean` is the mean coarse part of the map for a technique that packs, else
        None. `turned_deg` float (N,) is the expected rotation of the camera since each place was mapped, in the sense
        of `FineMatch.rotation_deg` (NaN: unknown). Only a technique with `spec.heading_within_deg` is given
        `turned_deg`; it then allows only rotations near the expected one. Likewise only one with
        `spec.height_ratios` is given `height_ratio`, in the sense of `FineMatch.height_ratio` (None: that of the
        map)."""
        ...

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None) -> FineMatch:
        """Compare the query with the fine part of one place, under the given hypotheses (None: under all)."""
        ...

    def glance(
        self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None
    ) -> tuple[float, list[int] | None]:
        """Compare a part of the query with one place: about the score that `match` would give, and which of the
        hypotheses is best (None where there is none to choose)."""
        ...
