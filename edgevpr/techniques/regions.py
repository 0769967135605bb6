"""Techniques that match regions of a feature map: `rmac` uses squares, `cross_region_bow` uses active areas. Both scan
the map using one vector per image, then compare the best places region by region.

Cross-Region-BoW and Region-VLAD (see `network`) find regions in the same way: the 8-connected components of positive
activations in each channel. The regions with the highest mean activation (*energy*) over all channels are kept. Each is
described by the sum of each channel's activations in its bounding box, L2-normalised."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Image, Ints, Mask, Singles
from edgevpr.core.contract import Descriptor, FineMatch, PartSpec
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.session import Backbone, open_backbone
from edgevpr.techniques.vectors import VectorTechnique
from edgevpr.techniques.words import compute_bag_of_words, load_words, normalise_rows

_TINY = 1e-12
Describe = Callable[[Singles], tuple[Singles, Singles]]
Square = tuple[int, int, int]  # top, left, side, in cells of a feature map
_RMAC_OVERLAP = 0.4  # target for neighbouring squares (Tolias et al. 2016, section 3.2)
_RMAC_SCALES = 3


class RegionTechnique(VectorTechnique):
    """Base class of the techniques that scan with one vector and compare the best places by their regions. `describe`
    converts a feature map, float32 (C, H, W), to the vector float32 (D,) and the regions float32 (N, C), each of length
    1 (padded with rows of zeros). `quality` converts bool (N,), True for each real region, to the quality, 0 to 1."""

    candidates = 40

    def __init__(self, backbone: Backbone, describe: Describe, quality: Callable[[Array], Any], **spec: Any) -> None:
        self._backbone, self._describe, self._quality = backbone, describe, quality
        vector, regions = describe(np.zeros(backbone.shape, np.float32))
        super().__init__(length=len(vector), **spec)
        self.spec = replace(self.spec, fine=PartSpec(regions.shape, "|i1"))

    def encode(self, image: Image, mask: Mask | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) to coarse float16 (D,), fine int8 (N, C), `regions` float32 (N, C) of length 1, and
        `good` bool (N,), True for each real region. Pixels where `mask` is False are set to the mean of the others."""
        vector, regions = self._describe(self._backbone.run(image, mask))
        good: Array = np.any(regions, axis=1)
        quality = float(self._quality(good))
        return Descriptor(
            coarse=vector.astype("<f2"), fine=to_bytes(regions), regions=regions, good=good, quality=quality
        )

    def match(self, query: Descriptor, fine: Array, hypotheses: None = None) -> FineMatch:
        """Score a place by its stored regions `fine`, int8 (N, C), from 0 to 1 (see `score_mutual_pairs`). A
        descriptor that was read from a map has no float regions, and scores 0."""
        return FineMatch(0.0 if query.regions is None else score_mutual_pairs(query.regions, from_bytes(fine)))


def rmac(model: str = "calc", form: str = "float", threads: int = 1) -> RegionTechnique:
    """Make `rmac`: square regions of a feature map at three scales, each described by its largest activations. For the
    parameters see `network`.

    Tolias, Sicre and Jégou, "Particular object retrieval with integral max-pooling of CNN activations", ICLR 2016, as
    in thesis 4.2.1: `conv5_2` of VGG-16, power- and L2-normalised, matched mutually without geometric verification.
    The coarse part is the sum of the squares' vectors; the quality is the fraction of squares with any activation."""
    backbone = open_backbone(model, "features", threads)
    squares = make_square_regions(*backbone.shape[1:])

    def describe_picture(features: Singles) -> tuple[Singles, Singles]:
        vectors = pool_squares(features, squares)
        return normalise_rows(vectors.sum(axis=0)), vectors

    # With the shipped weights every wrong match had a margin below 0.147 (see `network`).
    spec = {"name": "rmac", "parameters": {"model": model}, "model_sha256": backbone.sha256}
    return RegionTechnique(backbone, describe_picture, np.mean, **spec, form=form, margins=(0.185,) * 3)


def cross_region_bow(
    *, model: str = "calc", form: str = "float", threads: int = 1, regions: int = 200, words: int = 10_000
) -> RegionTechnique:
    """Make `cross_region_bow`: the `regions` regions of highest energy in a feature map, scanned as a bag of `words`
    visual words.

    Chen, Maffra, Sa and Chli, "Only Look Once, Mining Distinctive Landmarks from ConvNet for Visual Place Recognition",
    IROS 2017, as in thesis 4.2.1, but with one feature map: the paper finds regions in `conv5_3` of VGG-16 and
    describes them from `conv5_2`."""
    backbone = open_region_backbone("cross_region_bow", model, threads, regions)
    vocabulary, sha256 = load_words(model, "bow", words)

    def describe_picture(features: Singles) -> tuple[Singles, Singles]:
        vectors = describe_regions(features, find_regions(features, regions))
        padded = np.zeros((regions, len(features)), np.float32)
        padded[: len(vectors)] = vectors
        return compute_bag_of_words(vectors, vocabulary), padded

    # With the shipped weights every wrong match had a margin below 0.056 in every form (see `network`).
    parameters = {"model": model, "regions": regions, "words": words}
    spec = {"name": "cross_region_bow", "parameters": parameters, "model_sha256": sha256}
    return RegionTechnique(backbone, describe_picture, np.any, **spec, form=form, margins=(0.07,) * 3)


def open_region_backbone(technique: str, model: str, threads: int, regions: int) -> Backbone:
    """Open the network of the card `model` for a `technique` that finds `regions` regions in its feature map. Raises
    UsageError unless `regions` is 1 to 10,000."""
    if not 1 <= regions <= 10_000:
        raise UsageError(f"{technique}: regions is {regions}, but must be 1 to 10,000.")
    return open_backbone(model, "features", threads)


def make_square_regions(height: int, width: int) -> list[Square]:
    """Return the squares of R-MAC at three scales over a feature map (Tolias et al. 2016, section 3.2): at scale l they
    are 2 min(H, W) / (l + 1) wide, evenly spaced, l along the short side and l + m - 1 along the long one, where m
    brings the overlap at the first scale closest to 40 %. Raises ModelError for a feature map less than 2 wide."""
    short, long = min(height, width), max(height, width)
    if 2 * short // (_RMAC_SCALES + 1) < 1:
        raise ModelError(
            f"A feature map of {height}x{width} is too small for the regions of R-MAC: it must be at least 2 wide."
        )
    # A square feature map has one region at the first scale; others have 2 to 7, as in the authors' code.
    m = 1
    if long > short:
        m = min(range(2, 8), key=lambda n: abs(1 - (long - short) / (n - 1) / short - _RMAC_OVERLAP))
    regions = []
    for scale in range(1, _RMAC_SCALES + 1):
        side = 2 * short // (scale + 1)
        rows, columns = (scale, scale + m - 1) if height <= width else (scale + m - 1, scale)
        regions += [
            (top, left, side)
            for top in _space_evenly(height, side, rows)
            for left in _space_evenly(width, side, columns)
        ]
    return regions


def pool_squares(features: Singles, regions: list[Square]) -> Singles:
    """Return the largest activation of each channel in each of R squares, power-normalised (signed square root, thesis
    4.2), then L2-normalised: (C, H, W) to float32 (R, C)."""
    vectors = np.stack([features[:, y : y + side, x : x + side].max(axis=(1, 2)) for y, x, side in regions])
    return normalise_rows(np.sign(vectors) * np.sqrt(np.abs(vectors)))


def _space_evenly(length: int, side: int, count: int) -> list[int]:
    return [i * (length - side) // max(count - 1, 1) for i in range(count)]


def find_regions(features: Singles, count: int) -> Ints:
    """Find the `count` regions of highest energy in a feature map float32 (C, H, W), or all if there are fewer. Returns
    boxes int (N, 4) in its cells: (top, left, bottom, right), bottom and right exclusive, highest energy first. Ties
    are sorted by channel, from the top, then from the left."""
    channels, height, width = features.shape
    # Stack the channels into one tall image with empty rows between them, to search once instead of once per channel.
    tall = np.zeros((channels, height + 1, width), np.float32)
    np.maximum(features, 0, out=tall[:, :height])
    tall = tall.reshape(-1, width)
    label_count, labels, stats, _ = cv2.connectedComponentsWithStats((tall > 0).view(np.uint8), connectivity=8)
    left, top, box_width, box_height, area = stats[1:].T
    sums = np.bincount(labels.ravel(), weights=tall.ravel(), minlength=label_count)[1:]
    energy = (sums / area).astype(np.float32)
    channel, row = np.divmod(top, height + 1)
    best = np.lexsort((left, row, channel, -energy))[:count]
    return np.stack([row, left, row + box_height, left + box_width], axis=1)[best]


def describe_regions(features: Singles, boxes: Ints) -> Singles:
    """Describe the regions of a feature map (C, H, W) in `boxes`, int (N, 4) (see `find_regions`), by the sum of the
    activations of each channel, L2-normalised: float32 (N, C)."""
    channels, height, width = features.shape
    sums = np.zeros((height + 1, width + 1, channels), np.float64)  # integral image of each channel
    sums[1:, 1:] = features.transpose(1, 2, 0)
    np.cumsum(sums, axis=0, out=sums)
    np.cumsum(sums, axis=1, out=sums)
    top, left, bottom, right = boxes.T
    box_sums = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return np.asarray(normalise_rows(box_sums).astype(np.float32))


def score_mutual_pairs(query: Singles, place: Singles) -> float:
    """Score two sets of unit-length region descriptors, `query` (N, D) and `place` (M, D), from 0 to 1: the sum of the
    cosines of mutual best matches, divided by the larger number of regions (the papers do not divide). Negative cosines
    count as 0, and all-zero rows are ignored."""
    query_count, place_count = (int(regions.any(axis=1).sum()) for regions in (query, place))
    if not query_count or not place_count:
        return 0.0
    cosines = query @ place.T
    best = cosines.argmax(axis=1)
    is_mutual = cosines.argmax(axis=0)[best] == np.arange(len(query))
    total = np.maximum(cosines[np.arange(len(query)), best], 0)[is_mutual].sum()
    return float(min(total / max(query_count, place_count), 1.0))


def to_bytes(vectors: Singles) -> Array:
    """Quantise directions to 8 bits: float32 (N, D) to int8 (N, D), each row scaled by its largest magnitude."""
    largest = np.maximum(np.abs(vectors).max(axis=1, keepdims=True), _TINY)
    return np.asarray(np.rint(127 / largest * vectors).astype(np.int8))


def from_bytes(stored: Array) -> Singles:
    """Restore the rows of `to_bytes`, L2-normalised: int8 (N, D) to float32 (N, D); a zero row stays zero."""
    return np.asarray(normalise_rows(stored.astype(np.float32)))
