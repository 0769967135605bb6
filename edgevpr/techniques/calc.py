"""`calc`: the vector of a convolutional autoencoder that learned to see the gradients of a picture in another light.

Merrill and Huang, "Lightweight Unsupervised Deep Loop Closure", RSS 2018: 1064 numbers of a grey, histogram-equalised
picture of 160x120, compared by cosine. How the picture is prepared is on the card of the network.
"""

from typing import ClassVar

import numpy as np

from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class Calc(VectorTechnique):
    """CALC with the weights of the card `model`, of which the output `descriptor` is taken."""

    # No wrong match of corridor or aerial_caliterra (the sets tuned on) was ahead by 0.089, 0.12, 0.078, with the
    # weights that edgevpr ships or with the original ones.
    accept: ClassVar = {"float": (0.0, 0.11), "8bit": (0.0, 0.15), "1bit": (0.0, 0.10)}

    def __init__(self, model: str = "calc", form: str = "float", threads: int = 1) -> None:
        self._backbone = open_backbone(model, "descriptor", threads)
        (length,) = self._backbone.shape
        super().__init__("calc", {"model": model}, length, form=form, model_sha256=self._backbone.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """uint8 (H, W[, 3]) -> float32 (D,)."""
        return self._backbone.run(image, mask)
