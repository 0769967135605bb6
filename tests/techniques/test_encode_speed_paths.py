"""The short cuts of encoding give what the long way gives: bounds for whole maps, strips for whole images."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.techniques import entropy


def _wall(seed: int) -> np.ndarray:
    """Almost flat: a few grey levels of noise."""
    return np.random.default_rng(seed).integers(120, 124, (128, 128), dtype=np.uint8)


def _noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (128, 128), dtype=np.uint8)


def _patchwork(seed: int) -> np.ndarray:
    """Squares of very different contrast: bounds are tight here and loose there."""
    rng = np.random.default_rng(seed)
    contrast = cv2.resize(rng.random((8, 8), dtype=np.float32) ** 2, (160, 160), interpolation=cv2.INTER_NEAREST)
    return np.clip(128 + 128 * contrast * rng.standard_normal((160, 160)), 0, 255).astype(np.uint8)


PICTURES = {
    "textured": textured(1, 128, 128),
    "textured, not square": textured(2, 96, 160),
    "black": np.zeros((128, 128), np.uint8),
    "almost flat": _wall(3),
    "noise": _noise(4),
    "ramp": np.add.outer(np.arange(128), np.arange(128)).astype(np.uint8),
    "patchwork": _patchwork(5),
    "blurred patchwork": cv2.GaussianBlur(_patchwork(6), (0, 0), 1.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("cell_px", [8, 16])
@pytest.mark.parametrize("name", PICTURES)
def test_good_blocks_are_those_of_the_whole_map(name, cell_px):
    """At the usual thresholds, at the extremes, and at those that split the picture's own blocks, ties included."""
    grey = PICTURES[name]
    means = entropy.block_means(entropy.shannon(grey), cell_px)
    own = np.quantile(means, [0, 0.02, 0.25, 0.5, 0.75, 0.98, 1], method="nearest")
    for threshold in (0.0, 0.4, 0.5, 1.0, *own.tolist(), *(own + 3e-4).tolist()):
        good = entropy.good_blocks(grey, "shannon", cell_px, threshold)
        np.testing.assert_array_equal(good, means >= threshold, err_msg=f"threshold {threshold}")
