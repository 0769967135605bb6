"""`amosnet`: the largest activations over a pyramid of grids, compared by L1 difference.

Chen et al., "Deep Learning Features at Scale for Visual Place Recognition", ICRA 2017, in the form of thesis 4.2.1:
`conv5` of a network trained on the places of SPED, spatial pyramid pooling (see `heads.pooling`). What makes it
AMOSNet is the weights, trained from scratch: give their card as `model`.

The vector is divided by its sum: L1 then compares how the activations are shared out, not how many there are, and lies
in 0..2. On corridor and aerial_caliterra, the sets tuned on, that finds more places.
"""

from typing import ClassVar

import numpy as np

from edgevpr.errors import UsageError
from edgevpr.techniques.heads.pooling import pyramid
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class AmosNet(VectorTechnique):
    """Grids of 1x1 to `levels` x `levels` cells over the feature map of the card `model`."""

    name = "amosnet"

    # With the weights that edgevpr ships no wrong match of corridor or aerial_caliterra (the sets tuned on), nor any
    # query of the one in the map of the other, was ahead by 0.033, 0.032, 0.123. Other weights want other figures.
    accept: ClassVar = {"float": (0.0, 0.04), "8bit": (0.0, 0.04), "1bit": (0.0, 0.155)}

    def __init__(self, model: str = "calc", form: str = "float", threads: int = 1, levels: int = 4) -> None:
        if not 1 <= levels <= 64:
            raise UsageError(f"{self.name}: levels is {levels}; it must be 1 to 64.")
        self._backbone = open_backbone(model, "features", threads)
        self._levels = tuple(range(1, levels + 1))
        length = len(
            pyramid(np.zeros(self._backbone.shape, np.float32), self._levels)
        )  # says it where this is too small
        parameters = {"model": model, "levels": levels}
        super().__init__(self.name, parameters, length, form=form, similarity="l1", model_sha256=self._backbone.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """uint8 (H, W[, 3]) -> float32 (cells C,), the sum of its magnitudes 1."""
        pooled = pyramid(self._backbone.run(image, mask), self._levels)
        return pooled / max(float(np.abs(pooled).sum()), 1e-6)
