"""Regions that a network itself marks: connected activations of one channel.

Cross-Region-BoW (Chen, Maffra, Sa and Chli, IROS 2017) and Region-VLAD (Khaliq et al., T-RO 2019) find them in the same
way. In each channel, activations above zero that touch one another, corners included, make a region. Its energy is
their mean. The most energetic regions over all channels are kept.

Both describe a region by the activations of all channels under it, summed or averaged. Here these are the activations
in the box around the region, as in the public code of Region-VLAD. The result has length 1, which makes sum and mean
the same. Without that a large region outweighs all others, and both techniques are worse on corridor and
aerial_caliterra, the data sets used for tuning. The pixels of the region alone do worse there than its box.
"""

import cv2
import numpy as np

SMALLEST = 3  # rows and columns of a feature map: in a smaller one nearly every region covers the picture
_TINY = 1e-12


def find_regions(features: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the `count` most energetic regions of a feature map float32 (C, H, W), or all if there are fewer.

    Their boxes are int (N, 4) as (top, left, bottom, right), bottom and right excluded. Their energies are float32
    (N,), the largest first. Regions with the same energy are ordered by channel, then from the top, then from the left,
    whatever the order in which they are found.
    """
    channels, height, width = features.shape
    # All channels in one tall picture, an empty row between them: one search instead of one per channel.
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
    """Sum the activations of all channels under each box, and L2-normalise: (C, H, W), (N, 4) to float32 (N, C)."""
    channels, height, width = features.shape
    sums = np.zeros((height + 1, width + 1, channels), np.float64)  # of everything above and to the left
    sums[1:, 1:] = features.transpose(1, 2, 0)
    np.cumsum(sums, axis=0, out=sums)
    np.cumsum(sums, axis=1, out=sums)
    top, left, bottom, right = boxes.T
    under = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    under /= np.maximum(np.linalg.norm(under, axis=1, keepdims=True), _TINY)
    return under.astype(np.float32)


def mutual_score(query: np.ndarray, place: np.ndarray) -> float:
    """Score two sets of L2-normalised regions (N, D), (M, D), 0 to 1: the sum of the cosines (below 0: 0) of the
    mutually best pairs, over the larger number of regions. A pair is mutually best if each is the other's best match.
    All-zero rows are not regions.

    Both papers sum over mutually best pairs. Dividing by the number of regions keeps pictures with few regions from
    scoring low, and the score in 0..1. Several channels often mark the same box. Only one of such equal regions finds a
    partner, so a picture may score below 1 with itself.
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
    """Store directions in 8 bits: float32 (N, D) to int8 (N, D), each row over its own largest magnitude."""
    largest = np.maximum(np.abs(vectors).max(axis=1, keepdims=True), _TINY)
    return np.rint(127 / largest * vectors).astype(np.int8)


def from_bytes(stored: np.ndarray) -> np.ndarray:
    """Restore the rows of `to_bytes`, L2-normalised: int8 (N, D) to float32 (N, D); a zero row stays zero."""
    vectors = stored.astype(np.float32)
    vectors /= np.maximum(np.sqrt(np.einsum("nd,nd->n", vectors, vectors)), _TINY)[:, None]
    return vectors
