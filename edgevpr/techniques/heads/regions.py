"""Regions that a network itself marks: connected activations of one channel.

Cross-Region-BoW (Chen, Maffra, Sa and Chli, IROS 2017) and Region-VLAD (Khaliq et al., T-RO 2019) find them alike: in
each channel, activations above zero that touch one another, corners included, make a region; its energy is their mean;
the most energetic over all channels are kept.

Both describe a region by the activations of all channels under it, summed or averaged. Here that is the box around it,
as in the public code of Region-VLAD, and the result has length 1, which makes sum and mean the same. Without that a
large region outweighs all others: on corridor and aerial_caliterra, the sets tuned on, both techniques lose by it, and
the pixels of the region alone do worse than its box.
"""

import cv2
import numpy as np

SMALLEST = 3  # rows and columns of a feature map: in a smaller one nearly every region is all of the picture
_TINY = 1e-12


def find_regions(features: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` most energetic regions of a feature map float32 (C, H, W), or all where there are fewer.

    Returns their boxes int (N, 4) as (top, left, bottom, right), the ends excluded, and their energy float32 (N,), the
    largest first. Of regions with the same energy the one of the lower channel, then the higher, then the more to the
    left is first, whatever the order in which they are found.
    """
    channels, height, width = features.shape
    # All channels in one tall picture, an empty row between them: one search instead of one a channel.
    tall = np.zeros((channels, height + 1, width), np.float32)
    np.maximum(features, 0, out=tall[:, :height])
    tall = tall.reshape(-1, width)
    found, labels, stats, _ = cv2.connectedComponentsWithStats((tall > 0).view(np.uint8), connectivity=8)
    left, top, wide, high, area = stats[1:].T
    sums = np.bincount(labels.ravel(), weights=tall.ravel(), minlength=found)[1:]
    energy = (sums / area).astype(np.float32)
    channel, row = np.divmod(top, height + 1)
    best = np.lexsort((left, row, channel, -energy))[:count]
    return np.stack([row, left, row + high, left + wide], axis=1)[best], energy[best]


def describe(features: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """The sum of the activations of all channels under each box, L2-normalised: (C, H, W), (N, 4) -> float32 (N, C)."""
    channels, height, width = features.shape
    sums = np.zeros((height + 1, width + 1, channels), np.float64)  # of all that is above and to the left
    sums[1:, 1:] = features.transpose(1, 2, 0)
    np.cumsum(sums, axis=0, out=sums)
    np.cumsum(sums, axis=1, out=sums)
    top, left, bottom, right = boxes.T
    under = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    under /= np.maximum(np.linalg.norm(under, axis=1, keepdims=True), _TINY)
    return under.astype(np.float32)


def mutual_score(query: np.ndarray, place: np.ndarray) -> float:
    """Cross-match L2-normalised regions (N, D), (M, D): the sum of the cosines (below 0: 0) of the pairs of which each
    is the other's best match, over the larger number of regions. 0 to 1; all-zero rows are no regions.

    Both papers sum over mutually best pairs; dividing by the number of regions keeps pictures with few regions from
    scoring low, and the score in 0..1. Of regions that are alike (several channels often mark the same box) one finds a
    partner: a picture may score below 1 with itself.
    """
    asking, asked = int(query.any(axis=1).sum()), int(place.any(axis=1).sum())
    if not asking or not asked:
        return 0.0
    cosines = query @ place.T
    best = cosines.argmax(axis=1)
    mutual = cosines.argmax(axis=0)[best] == np.arange(len(query))
    total = np.maximum(cosines[np.arange(len(query)), best], 0)[mutual].sum()
    return float(min(total / max(asking, asked), 1.0))


def to_bytes(vectors: np.ndarray) -> np.ndarray:
    """Directions in 8 bits: float32 (N, D) -> int8 (N, D), each row over its own largest magnitude."""
    largest = np.maximum(np.abs(vectors).max(axis=1, keepdims=True), _TINY)
    return np.rint(127 / largest * vectors).astype(np.int8)


def from_bytes(stored: np.ndarray) -> np.ndarray:
    """What `to_bytes` wrote, L2-normalised: int8 (N, D) -> float32 (N, D); a zero row stays zero."""
    vectors = stored.astype(np.float32)
    vectors /= np.maximum(np.sqrt(np.einsum("nd,nd->n", vectors, vectors)), _TINY)[:, None]
    return vectors
