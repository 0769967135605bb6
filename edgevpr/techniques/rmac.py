"""`rmac`: the largest activations of squares of the feature map; a place is found by their sum, and settled by
matching square with square.

Tolias, Sicre and Jégou, "Particular object retrieval with integral max-pooling of CNN activations", ICLR 2016, in the
form of thesis 4.2.1: `conv5_2` of VGG-16, power- and L2-normalised, the squares of two pictures mutually matched and
the cosines of the mutual pairs summed, no check of geometry. The sum of the squares is the coarse part, which the paper
compares by cosine; the squares are the fine part, 8 bits a number.
"""

from dataclasses import replace

import numpy as np

from edgevpr.contract import Descriptor, FineMatch, PartSpec
from edgevpr.techniques.heads.regions import from_bytes, mutual_score, to_bytes
from edgevpr.techniques.heads.rmac import aggregate, regional_vectors, square_regions
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class RMac(VectorTechnique):
    """R-MAC of the feature map of the card `model`, at three scales."""

    candidates = 40
    # With the weights that edgevpr ships no wrong match of corridor or aerial_caliterra (the sets tuned on), nor any
    # query of the one in the map of the other, was ahead by 0.147. Other weights want other figures.
    min_margin = 0.185

    def __init__(self, model: str = "calc", form: str = "float", threads: int = 1) -> None:
        self._backbone = open_backbone(model, "features", threads)
        channels, height, width = self._backbone.shape
        self._squares = square_regions(height, width)
        super().__init__("rmac", {"model": model}, channels, form=form, model_sha256=self._backbone.sha256)
        self.spec = replace(self.spec, fine=PartSpec((len(self._squares), channels), "|i1"))

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) -> coarse float16 (C,), fine int8 (squares, C), and for asking the squares as
        float32 of length 1; `good` are those where anything was active."""
        squares = regional_vectors(self._backbone.run(image, mask), self._squares)
        good = squares.any(axis=1)
        coarse = aggregate(squares).astype("<f2")
        return Descriptor(coarse=coarse, fine=to_bytes(squares), regions=squares, good=good, quality=float(good.mean()))

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: None = None) -> FineMatch:
        """MachineSpeed the mutually best pairs of squares, 0 to 1 (see `mutual_score`)."""
        return FineMatch(mutual_score(query.regions, from_bytes(fine)))
