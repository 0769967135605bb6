"""`seqslam`: small patch-normalised images, compared by their absolute differences, in sequences (Milford and Wyeth
2012, "SeqSLAM: Visual route-based navigation for sunny summer days and stormy winter nights").

This module computes the difference of one image from every place and enhances the local contrast. `places.sequence`
searches for trajectories; this technique uses it by default."""

import math

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Doubles, Image, Mask, Singles
from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.errors import UsageError

_SEQUENCE_QUERIES = 10  # length of a sequence, unless the configuration sets another one
_WINDOW_PLACES = 10  # R_window of the paper: five places before and five after
_MEAN_LEVEL = 128  # level of a pixel as bright as the mean of its patch
_LEVELS_PER_SD = 28  # eight bits reach 4.5 standard deviations either way
_MIN_PATCH_SD_LEVELS = 1.0  # in grey levels; a patch with less variation does not describe the place


class SeqSlam:
    """SeqSLAM: a place is a small image of `width` x `height` one-byte pixels (2 KB by default), normalised in
    patches of `patch` x `patch` pixels."""

    candidates = 1  # it has no fine part to compare
    min_score = 0.0
    min_margin = 0.25  # of one query; wrong matches on corridor and aerial_caliterra (tuning) had less than 0.16
    min_quality = 0.4  # real images have 0.8 or more

    def __init__(self, width: int = 64, height: int = 32, patch: int = 8) -> None:
        if not (2 <= patch <= width <= 512 and patch <= height <= 512 and width % patch == height % patch == 0):
            raise UsageError(
                f"seqslam cannot use width={width}, height={height}, patch={patch}: width and height must be "
                "multiples of patch (at least 2 pixels), at most 512."
            )
        self._size, self._patch, self._grid = (width, height), patch, (height // patch, width // patch)
        parameters: dict[str, int | float | str] = {"width": width, "height": height, "patch": patch}
        self.spec = TechniqueSpec(
            name="seqslam", parameters=parameters, coarse=PartSpec((width * height,), "|u1"), sequence=_SEQUENCE_QUERIES
        )

    def encode(self, image: Image, mask: Mask | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) to coarse uint8 (height * width,): 128 + 28 times the deviation of a pixel from its
        patch's mean, in standard deviations of the patch. Pixels where `mask` is False count as their patch's mean. The
        quality is the fraction of patches that vary."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        seen = np.ones(image.shape[:2], np.uint8) if mask is None else mask.astype(np.uint8)
        pixels = self._cut_patches(cv2.resize(grey, self._size, interpolation=cv2.INTER_AREA))
        allowed = self._cut_patches(cv2.resize(seen, self._size, interpolation=cv2.INTER_NEAREST))
        z, spread = normalise_patches(pixels, allowed)
        levels = np.clip(np.rint(_LEVELS_PER_SD * z) + _MEAN_LEVEL, 0, 255).astype(np.uint8)
        coarse = levels.reshape(*self._grid, self._patch, self._patch).swapaxes(1, 2).ravel()
        return Descriptor(coarse=coarse, quality=float(np.mean(spread >= _MIN_PATCH_SD_LEVELS)))

    def _cut_patches(self, picture: Array) -> Singles:
        """Cut an image into patches: (height, width) to float32 (patches, patch * patch)."""
        rows, columns = self._grid
        blocks = picture.astype(np.float32).reshape(rows, self._patch, columns, self._patch).swapaxes(1, 2)
        return blocks.reshape(rows * columns, self._patch * self._patch)

    def score_places(self, query: Descriptor, rows: Array, mean: None = None) -> tuple[Singles, None]:
        """Score each place by how much better the query matches it than the places around it in the map. `rows` are
        uint8 (N, length). Returns scores float32 (N,) in 0..1, and None (no hypotheses). 0.5 means that the place
        matches as well as those around it. The score is linear in the enhanced difference (see `enhance_contrast`), so
        the trajectory with the best mean score is that of the least summed difference."""
        # With one query, the nearest neighbour of each row is that query: K=1 is the fastest way to all sums of
        # absolute differences.
        differences = cv2.batchDistance(rows, query.coarse[None], cv2.CV_32S, normType=cv2.NORM_L1, K=1)[0][:, 0]
        # No value of n is more than (n - 1) / sqrt(n) standard deviations from their mean.
        max_deviation = _WINDOW_PLACES / math.sqrt(_WINDOW_PLACES + 1)
        return (0.5 - enhance_contrast(differences) / (2 * max_deviation)).astype(np.float32), None


def normalise_patches(pixels: Singles, allowed: Singles) -> tuple[Singles, Singles]:
    """Subtract each patch's mean and divide by its standard deviation. `pixels` and `allowed` (1, or 0 for pixels to
    ignore) are float32 (patches, pixels). Returns the normalised pixels, float32 (patches, pixels), 0 where not allowed
    or where the patch is flat; and the standard deviations, float32 (patches,)."""
    count = np.maximum(allowed.sum(axis=1, keepdims=True), 1)
    centred = (pixels - (pixels * allowed).sum(axis=1, keepdims=True) / count) * allowed
    spread = np.sqrt((centred**2).sum(axis=1, keepdims=True) / count)
    return np.divide(centred, spread, out=np.zeros_like(centred), where=spread > 1e-3), spread[:, 0]


def enhance_contrast(differences: Array) -> Doubles:
    """Enhance the local contrast of the query's differences from the places along the map: int32 (N,) to float64 (N,).
    The mean of the differences up to five places away is subtracted from each, and the result is divided by their
    (sample) standard deviation; 0 where they are all equal. Integer sums stay exact on a long map."""
    integers = differences.astype(np.int64)
    first = np.maximum(np.arange(len(integers)) - _WINDOW_PLACES // 2, 0)
    last = np.minimum(np.arange(len(integers)) + _WINDOW_PLACES // 2 + 1, len(integers))
    count = last - first
    sums, squares = (np.concatenate(([0], np.cumsum(values))) for values in (integers, integers**2))
    total = sums[last] - sums[first]
    variance = (count * (squares[last] - squares[first]) - total**2).astype(np.float64)  # times count * (count - 1)
    scale = np.sqrt((count - 1) / count / np.maximum(variance, 1))  # a variance of 0 leaves nothing to scale
    return np.asarray((count * integers - total) * scale)
