"""The interface of a technique: its specification, its descriptor of an image, and its comparison of query and place.
The rest of edgevpr uses techniques only through these types; `edgevpr/techniques` implements them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np


@dataclass(frozen=True, slots=True)
class PartSpec:
    """Array shape and little-endian NumPy dtype ("<f4", "<i1", ...) of one part of a descriptor."""

    shape: tuple[int, ...]
    dtype: str

    @property
    def nbytes(self) -> int:
        return int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        return f"{'x'.join(map(str, self.shape))} {np.dtype(self.dtype)}"


def find_nearest_height(height_ratios: Sequence[float], height_ratio: float) -> float:
    """Return the member of `height_ratios` nearest to `height_ratio` on a logarithmic scale."""
    return min(height_ratios, key=lambda ratio: abs(math.log(ratio / height_ratio)))


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueSpec:
    """The specification of a technique: the format of its descriptors, and its optional abilities.

    A map file stores the fields from `name` to `packed`; only a technique with equal fields can use the map.
    `coarse`, `fine`: the two parts of a place's descriptor. `fine` None: there is no fine part.
    `model_sha256`: hash of the network file. None: no network is used.
    `packed`: the row of a place in the index in RAM, made by `Technique.pack`. None: the row is the coarse part.

    A map does not store the other fields. They describe optional abilities:
    `form`: number format of vectors in RAM, see `techniques.vectors`. None: no choice.
    `sequence`: default number of queries that are matched together.
    `scan_counts`: the score of the scan is part of the final score (see `places.retrieve`).
    `heading_within_deg`: if headings are known, only rotations of the query within this many degrees of the expected
    one are tried. None: headings are not used.
    `cells`: number of cells of `FineMatch.shift_cells` along an image's side. None: matches have no such shift.
    `looks_down`: images show the ground below the camera, so shifts can be converted to metres.
    `height_ratios`: camera heights, relative to that of the map, at which a query can be recognised.
    `max_matches`: maximum number of candidates compared by `match`. If there are more, those with the best
    `Technique.score_quickly` estimates are chosen. None: all candidates are compared by `match`."""

    name: str
    parameters: dict[str, int | float | str]
    coarse: PartSpec
    fine: PartSpec | None = None
    model_sha256: str | None = None
    packed: PartSpec | None = None
    form: str | None = field(default=None, compare=False)
    sequence: int = field(default=1, compare=False)
    scan_counts: bool = field(default=False, compare=False)
    heading_within_deg: float | None = field(default=None, compare=False)
    cells: int | None = field(default=None, compare=False)
    looks_down: bool = field(default=False, compare=False)
    height_ratios: tuple[float, ...] = field(default=(), compare=False)
    max_matches: int | None = field(default=None, compare=False)

    @property
    def row(self) -> PartSpec:
        """Shape and dtype of the row of one place in the index in RAM."""
        return self.packed or self.coarse


@dataclass(frozen=True, slots=True, kw_only=True)
class Descriptor:
    """The descriptor of one image.

    `coarse`: becomes one row of the index in RAM (see `Technique.pack`). `fine`: stays in the map file and is read only
    for candidates (None: the technique has none). `quality`: usable fraction of the image, 0..1.
    For queries of techniques that need it: `regions`, the descriptors of its regions; `good`, bool, True for regions to
    compare; `picture`, which is encoded again at other rotations."""

    coarse: np.ndarray
    fine: np.ndarray | None = None
    regions: np.ndarray | None = None
    good: np.ndarray | None = None
    quality: float = 1.0
    picture: "Picture | None" = None


@dataclass(frozen=True, slots=True)
class Picture:
    """The prepared image from which a descriptor was made. `grey`: float32 (side, side), None if the image is never
    rotated. `allowed`: bool (side, side), True for pixels that may be used (None: all). `seen`: bool, for each block of
    cells, True if all of its pixels are allowed."""

    grey: np.ndarray | None
    allowed: np.ndarray | None
    seen: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """Support from all regions of query and place for one displacement, `FineMatch.shift_cells`.

    `back`: fraction (0..1) of the place's regions whose most similar region in the query is at this displacement.
    `likeness`: mean cosine similarity of each region of the query to the most similar region anywhere in the place.
    `log_rank`: for each region of the query, the place's regions are ranked by similarity to it; this is the mean
    natural logarithm of the rank (from 1) of the region at this displacement.
    `surroundings`: `back` in the outer ring of the place, where the query shows it, divided by that in the middle."""

    back: float
    likeness: float
    log_rank: float
    surroundings: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FineMatch:
    """Result of comparing the query with one place: `score`, 0..1. The other fields are None for some techniques.

    `shift_cells`: offset (dx right, dy down) from the centre of the place's image to the centre of the query's, in
    cells of the place. `covariance_cells2`: covariance (var x, cov xy, var y) of this offset.
    `rotation_deg`: rotation of the camera since the place was mapped, clockwise, 0..360.
    `height_ratio`: height of the camera above ground, divided by its height when the place was mapped.
    `coverage`: fraction (0..1) of the place's regions that agree with this shift, each counted once.
    `support`: further measures of the agreement with this shift.
    `structure`: how well the structures of both images (their regions minus the mean of their surroundings) agree at
    this shift; looking down, how much better than at other shifts, in standard deviations (see `techniques.overlay`).
    `votes`: `score` before the structures were included."""

    score: float = field(kw_only=False)
    shift_cells: tuple[float, float] | None = None
    covariance_cells2: tuple[float, float, float] | None = None
    rotation_deg: float | None = None
    height_ratio: float | None = None
    coverage: float | None = None
    support: Support | None = None
    structure: float | None = None
    votes: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Perspective:
    """Perspective of a query relative to a place. `over_place`: homography (3, 3) from points in the query's image to
    points in the place's: (right, down, 1) from the centre, in longest sides; its last element is 1. `regions`: number
    of regions that agree with it. `slope_sd`: standard deviation of `slope` along each axis."""

    over_place: np.ndarray
    slope_sd: float
    regions: int

    @property
    def slope(self) -> float:
        """Relative change of scale across the query's image, per longest side: tan(tilt) divided by focal length."""
        return float(np.hypot(*self.over_place[2, :2]))

    @property
    def scales(self) -> tuple[float, float]:
        """Largest and smallest scale over all directions at the centre of the query's image. If it is tilted, their
        ratio is the cosine of the tilt, whatever the lens."""
        derivative = self.over_place[:2, :2] - np.outer(self.over_place[:2, 2], self.over_place[2, :2])
        largest, smallest = np.linalg.svd(derivative, compute_uv=False)
        return float(largest), float(smallest)


class Technique(Protocol):
    """A place recognition technique. It encodes images (`encode`), compares a query with all places by their coarse
    parts (`score_places`), then with some by their fine parts (`match`). Some methods are needed only for an ability:
    `match` with `spec.fine`, `pack` with `spec.packed`, `score_quickly` with `spec.max_matches`, and `match_rotated`,
    `match_at_rest` and `measure_perspective` with `spec.looks_down`."""

    spec: TechniqueSpec
    candidates: int  # default number of places compared after the scan
    min_score: float  # default minimum score of an accepted match
    min_margin: float  # default minimum margin of an accepted match over the best place elsewhere
    min_quality: float  # minimum `Descriptor.quality` of a query that can be recognised

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode an image, uint8 (H, W[, 3]). `mask`: bool (H, W), False for pixels to ignore (None: use all)."""

    def pack(self, coarse: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Pack coarse parts (N, *coarse.shape) into rows of the index (N, *row.shape). `mean`: that of all coarse
        parts of the map, of `coarse.shape`."""

    def score_places(
        self,
        query: Descriptor,
        rows: np.ndarray,
        mean: np.ndarray | None,
        rotation_deg: np.ndarray | None = None,
        height_ratio: float | None = None,
        in_reach: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Score all places of the index, `rows` (N, *row.shape). Return the scores, float32 (N,), and a score for each
        place and hypothesis (such as a rotation) that `match` can test, float32 (N, H), -inf for those ruled out; None
        instead of the latter if there is only one hypothesis.

        `mean`: mean of the map's coarse parts, for techniques that pack them (else None).
        `rotation_deg`: expected `FineMatch.rotation_deg` at each place, float (N,), NaN: unknown. Other rotations are
        ruled out. None: no expectation. Given only to a technique with `spec.heading_within_deg`.
        `height_ratio`: expected `FineMatch.height_ratio` (None: 1). `in_reach`: bool (N,), places to examine more
        closely (None: all). Both are given only to a technique with `spec.height_ratios`."""

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None) -> FineMatch:
        """Compare the query with the fine part of one place under `hypotheses` (None: all): numbers from 0 to H - 1,
        the columns of the second result of `score_places`."""

    def score_quickly(
        self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None
    ) -> tuple[float, list[int] | None]:
        """Estimate the score that `match` would return, from a part of the query's regions. Return the
        estimate and the best hypothesis, as a list for `match` (None: there are no hypotheses)."""

    def match_rotated(self, query: Descriptor, fine: np.ndarray, match: FineMatch) -> FineMatch:
        """Compare the query with the place of a `match` again, at the same height but only at other rotations."""

    def measure_perspective(self, query: Descriptor, fine: np.ndarray, match: FineMatch) -> Perspective | None:
        """Measure the perspective of the query over the place of a `match`; None if too few regions agree."""

    def match_at_rest(self, query: Descriptor, fine: np.ndarray) -> FineMatch:
        """Compare the query with a place at the place's own height and rotation, as for a camera that has not moved."""
