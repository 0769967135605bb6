"""`region_vlad`: VLAD of the regions that the network marks, about learned visual words, compared by cosine.

Khaliq et al., "A Holistic Visual Place Recognition Approach Using Lightweight CNNs for Significant ViewPoint and
Appearance Changes", T-RO 2019, in the form of thesis 4.2.1: 400 regions of `conv4`, 256 words. Regions have length 1
(see `heads.regions`), and so has each word's part of the vector. The authors' code takes the signed square root of
these parts instead; on corridor and aerial_caliterra, the data sets used for tuning, that finds fewer places.
"""

from typing import ClassVar

import numpy as np

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.heads import vlad
from edgevpr.techniques.heads.regions import SMALLEST, describe, find_regions
from edgevpr.techniques.heads.words import load_words
from edgevpr.techniques.networks.session import Backbone, open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class RegionVlad(VectorTechnique):
    """VLAD of the `regions` most energetic regions of the feature map of the card `model` about `words` words."""

    # With the shipped weights every wrong match had a margin below 0.060 (float), 0.042 (8bit), 0.021 (1bit): on
    # corridor and aerial_caliterra (the data sets used for tuning), and with the queries of one of them in the map of
    # the other. Other weights need other values.
    accept: ClassVar = {"float": (0.0, 0.075), "8bit": (0.0, 0.055), "1bit": (0.0, 0.03)}

    def __init__(
        self,
        *,
        model: str = "calc",
        form: str = "float",
        threads: int = 1,
        regions: int = 400,
        words: int = 256,
    ) -> None:
        self._backbone = region_backbone("region_vlad", model, threads, regions)
        self._words = load_words(model, "regions", words)
        self._regions = regions
        parameters = {"model": model, "regions": regions, "words": words}
        super().__init__("region_vlad", parameters, self._words.words.size, form=form, model_sha256=self._words.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (words * C,); zeros for a picture without any region."""
        features, words = self._backbone.run(image, mask), self._words.words
        boxes, _ = find_regions(features, self._regions)
        local = describe(features, boxes)
        return vlad.intra_normalised(vlad.residuals(local, words, vlad.hard_weights(local, words)))


def region_backbone(technique: str, model: str, threads: int, regions: int) -> Backbone:
    """Open the network of the card `model`, to find regions in its feature map. Raises ModelError for a feature map
    that is too small for regions or has no activation above zero, and UsageError for a number of regions outside 1 to
    10 000."""
    if not 1 <= regions <= 10_000:
        raise UsageError(f"{technique}: regions is {regions}; it must be 1 to 10000.")
    backbone = open_backbone(model, "features", threads)
    height, width = backbone.shape[1:]
    if min(height, width) < SMALLEST:
        raise ModelError(
            f"{technique}: the feature map of `{model}` is {height}x{width}, too small for regions: at least "
            f"{SMALLEST}x{SMALLEST} are needed, use an earlier layer."
        )
    noise = np.random.default_rng(0).integers(0, 256, (120, 160), np.uint8)
    if not len(find_regions(backbone.run(noise), 1)[0]):
        raise ModelError(
            f"{technique}: the feature map of `{model}` has nothing above zero, and regions are made of that: use an "
            "output after the rectifier."
        )
    return backbone
