"""`amosnet`: the largest activations over a pyramid of grids, compared by L1 difference.

Chen et al., "Deep Learning Features at Scale for Visual Place Recognition", ICRA 2017, in the form of thesis 4.2.1:
`conv5` of a network trained on the places of SPED, with spatial pyramid pooling (see `heads.pooling`). Only its
weights, trained from scratch, make a network AMOSNet: give their card as `model`.

The vector is divided by its sum. The L1 difference then compares the distribution of the activations, not their total,
and lies in 0..2. On corridor and aerial_caliterra, the data sets used for tuning, this finds more places.
"""

from typing import ClassVar

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.techniques.heads.pooling import pyramid
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class AmosNet(VectorTechnique):
    """Maxima over grids of 1x1 to `levels` x `levels` cells of the feature map of the card `model`."""

    name = "amosnet"

    # With the shipped weights every wrong match had a margin below 0.033 (float), 0.032 (8bit), 0.123 (1bit): on
    # corridor and aerial_caliterra (the data sets used for tuning), and with the queries of one of them in the map of
    # the other. Other weights need other values.
    accept: ClassVar = {"float": (0.0, 0.04), "8bit": (0.0, 0.04), "1bit": (0.0, 0.155)}

    def __init__(self, model: str = "calc", form: str = "float", threads: int = 1, levels: int = 4) -> None:
        if not 1 <= levels <= 64:
            raise UsageError(f"{self.name}: levels is {levels}; it must be 1 to 64.")
        self._backbone = open_backbone(model, "features", threads)
        self._levels = tuple(range(1, levels + 1))
        length = len(
            pyramid(np.zeros(self._backbone.shape, np.float32), self._levels)
        )  # raises ModelError if the feature map is too small
        parameters = {"model": model, "levels": levels}
        super().__init__(self.name, parameters, length, form=form, similarity="l1", model_sha256=self._backbone.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (cells * C,); its magnitudes sum to 1."""
        pooled = pyramid(self._backbone.run(image, mask), self._levels)
        return pooled / max(float(np.abs(pooled).sum()), 1e-6)
