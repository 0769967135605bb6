"""`alexnet`: all activations of one layer, reduced by a Gaussian random projection, compared by cosine.

Sünderhauf et al., "On the Performance of ConvNet Features for Place Recognition", IROS 2015, in the form of thesis
4.2.1: `conv3` of AlexNet, projected (see `heads.projection`). The 1064 dimensions are those of the public code of the
thesis's author. The form `1bit` is the locality-sensitive hash of the paper's section IV-D.
"""

from typing import ClassVar

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.techniques.heads.pooling import flatten
from edgevpr.techniques.heads.projection import gaussian_projection
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class AlexNet(VectorTechnique):
    """The feature map of the card `model`, reduced to `dims` numbers by a random projection that is drawn from
    `seed`."""

    # With the shipped weights every wrong match had a margin below 0.117 (float), 0.094 (8bit), 0.080 (1bit): on
    # corridor and aerial_caliterra (the data sets used for tuning), and with the queries of one of them in the map of
    # the other. Other weights need other values.
    accept: ClassVar = {"float": (0.0, 0.15), "8bit": (0.0, 0.12), "1bit": (0.0, 0.1)}

    def __init__(
        self, *, model: str = "calc", form: str = "float", threads: int = 1, dims: int = 1064, seed: int = 0
    ) -> None:
        if not (8 <= dims <= 65_536 and 0 <= seed < 2**31):
            raise UsageError(f"alexnet cannot use dims={dims}, seed={seed}: dims must be 8 to 65536, seed 0 or more.")
        self._backbone = open_backbone(model, "features", threads)
        self._project = gaussian_projection(int(np.prod(self._backbone.shape)), dims, seed)
        parameters = {"model": model, "dims": dims, "seed": seed}
        super().__init__("alexnet", parameters, dims, form=form, model_sha256=self._backbone.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (dims,)."""
        return self._project(flatten(self._backbone.run(image, mask)))
