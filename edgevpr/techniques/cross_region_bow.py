"""`cross_region_bow`: regions that the network marks. The scan compares their visual words, the full comparison matches
region with region.

Chen, Maffra, Sa and Chli, "Only Look Once, Mining Distinctive Landmarks from ConvNet for Visual Place Recognition",
IROS 2017, in the form of thesis 4.2.1: 200 regions and 10 000 words. The paper finds regions in `conv5_3` of VGG-16 and
describes them from `conv5_2`; a card names one feature map, which is used for both. The coarse part is the bag of
words. The fine part is the regions, 8 bits per number. The score of a place sums over the mutually best pairs of
regions.
"""

from dataclasses import replace

import numpy as np

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec
from edgevpr.techniques.heads.regions import describe, find_regions, from_bytes, mutual_score, to_bytes
from edgevpr.techniques.heads.words import bag_of_words, load_words
from edgevpr.techniques.region_vlad import region_backbone
from edgevpr.techniques.vectors import VectorTechnique


class CrossRegionBow(VectorTechnique):
    """The `regions` most energetic regions of the feature map of the card `model`, and a bag of `words` visual
    words."""

    candidates = 40
    # With the shipped weights every wrong match had a margin below 0.056 in every form: on corridor and
    # aerial_caliterra (the data sets used for tuning), and with the queries of one of them in the map of the other.
    # Other weights need other values.
    min_margin = 0.07

    def __init__(
        self,
        *,
        model: str = "calc",
        form: str = "float",
        threads: int = 1,
        regions: int = 200,
        words: int = 10_000,
    ) -> None:
        self._backbone = region_backbone("cross_region_bow", model, threads, regions)
        channels = self._backbone.shape[0]
        self._words = load_words(model, "bow", words)
        self._regions = regions
        parameters = {"model": model, "regions": regions, "words": words}
        super().__init__("cross_region_bow", parameters, words, form=form, model_sha256=self._words.sha256)
        self.spec = replace(self.spec, fine=PartSpec((regions, channels), "|i1"))

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) to coarse float16 (words,) and fine int8 (regions, C), zeros where fewer regions are
        found. For a query there are also the regions as float32 of length 1; `good` marks those that were found."""
        features = self._backbone.run(image, mask)
        boxes, _ = find_regions(features, self._regions)
        found = describe(features, boxes)
        regions = np.zeros(self.spec.fine.shape, np.float32)
        regions[: len(found)] = found
        coarse = bag_of_words(found, self._words.words).astype("<f2")
        good = np.arange(self._regions) < len(found)
        return Descriptor(
            coarse=coarse, fine=to_bytes(regions), regions=regions, good=good, quality=float(len(found) > 0)
        )

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: None = None) -> FineMatch:
        """Score the mutually best pairs of regions, 0 to 1 (see `mutual_score`)."""
        return FineMatch(mutual_score(query.regions, from_bytes(fine)))
