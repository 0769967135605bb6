"""`calc`: the vector of a convolutional autoencoder that learned to give the HOG of a picture from a changed copy of
it.

Merrill and Huang, "Lightweight Unsupervised Deep Loop Closure", RSS 2018: 1064 numbers from a grey, histogram-equalised
picture of 160x120, compared by cosine. The card of the network says how the picture is prepared.
"""

from typing import ClassVar

import numpy as np

from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class Calc(VectorTechnique):
    """CALC with the weights of the card `model`; its vector is the output `descriptor`."""

    # With the shipped weights, and with the original ones, every wrong match on corridor and aerial_caliterra (the data
    # sets used for tuning) had a margin below 0.089 (float), 0.12 (8bit), 0.078 (1bit).
    accept: ClassVar = {"float": (0.0, 0.11), "8bit": (0.0, 0.15), "1bit": (0.0, 0.10)}

    def __init__(self, model: str = "calc", form: str = "float", threads: int = 1) -> None:
        self._backbone = open_backbone(model, "descriptor", threads)
        (length,) = self._backbone.shape
        super().__init__("calc", {"model": model}, length, form=form, model_sha256=self._backbone.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (D,)."""
        return self._backbone.run(image, mask)
