"""`rmac`: the largest activations in squares of the feature map. The scan compares their sum, the full comparison
matches square with square.

Tolias, Sicre and Jégou, "Particular object retrieval with integral max-pooling of CNN activations", ICLR 2016, in the
form of thesis 4.2.1: `conv5_2` of VGG-16, power- and L2-normalised. The squares of two pictures are matched mutually,
and the cosines of the mutual pairs are summed, without a check of geometry. The coarse part is the sum of the squares,
which the paper compares by cosine. The fine part is the squares, 8 bits per number.
"""

from dataclasses import replace

import numpy as np

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec
from edgevpr.techniques.heads.regions import from_bytes, mutual_score, to_bytes
from edgevpr.techniques.heads.rmac import aggregate, regional_vectors, square_regions
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class RMac(VectorTechnique):
    """R-MAC of the feature map of the card `model`, at three scales."""

    candidates = 40
    # With the shipped weights every wrong match had a margin below 0.147: on corridor and aerial_caliterra (the data
    # sets used for tuning), and with the queries of one of them in the map of the other. Other weights need other
    # values.
    min_margin = 0.185

    def __init__(self, model: str = "calc", form: str = "float", threads: int = 1) -> None:
        self._backbone = open_backbone(model, "features", threads)
        channels, height, width = self._backbone.shape
        self._squares = square_regions(height, width)
        super().__init__("rmac", {"model": model}, channels, form=form, model_sha256=self._backbone.sha256)
        self.spec = replace(self.spec, fine=PartSpec((len(self._squares), channels), "|i1"))

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) to coarse float16 (C,) and fine int8 (squares, C). For a query there are also the
        squares as float32 of length 1; `good` marks those with any activation."""
        squares = regional_vectors(self._backbone.run(image, mask), self._squares)
        good = squares.any(axis=1)
        coarse = aggregate(squares).astype("<f2")
        return Descriptor(coarse=coarse, fine=to_bytes(squares), regions=squares, good=good, quality=float(good.mean()))

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: None = None) -> FineMatch:
        """Score the mutually best pairs of squares, 0 to 1 (see `mutual_score`)."""
        return FineMatch(mutual_score(query.regions, from_bytes(fine)))
