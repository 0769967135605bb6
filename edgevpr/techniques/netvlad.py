"""`netvlad`: VLAD of the activations at each position about learned visual words, whitened, compared by cosine.

Arandjelović et al., "NetVLAD: CNN architecture for weakly supervised place recognition", CVPR 2016, in the form of
thesis 4.2.1: 64 words. The paper trains words and network together, for VGG-16. Here the words are learned afterwards
(`edgevpr train words`), which is how the paper starts (its section 3.1). The vector is whitened only if the file of the
words holds a whitening. A network that has the layer inside gives a vector by itself: make a card of it, and it is a
technique of its own.
"""

from typing import ClassVar

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.techniques.heads import vlad
from edgevpr.techniques.heads.words import load_words, whitened
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class NetVlad(VectorTechnique):
    """VLAD of the feature map of the card `model` about `words` words. The `assignment` of a position to the words is
    "soft" or "hard"."""

    # With the shipped weights every wrong match had a margin below 0.104 (float), 0.081 (8bit), 0.067 (1bit): on
    # corridor and aerial_caliterra (the data sets used for tuning), and with the queries of one of them in the map of
    # the other. Other weights need other values.
    accept: ClassVar = {"float": (0.0, 0.13), "8bit": (0.0, 0.105), "1bit": (0.0, 0.085)}

    def __init__(
        self,
        *,
        model: str = "calc",
        form: str = "float",
        threads: int = 1,
        words: int = 64,
        assignment: str = "soft",
    ) -> None:
        if assignment not in ("soft", "hard"):
            raise UsageError(f"netvlad has no assignment `{assignment}`: use soft or hard.")
        self._backbone = open_backbone(model, "features", threads)
        self._words = load_words(model, "vlad", words)
        self._sharpness = vlad.sharpness(self._words.words) if assignment == "soft" else None
        parameters = {"model": model, "words": words, "assignment": assignment}
        super().__init__("netvlad", parameters, self._words.length, form=form, model_sha256=self._words.sha256)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (words * C,), or to the length that the whitening gives."""
        local, words = vlad.local_descriptors(self._backbone.run(image, mask)), self._words.words
        if self._sharpness is None:
            weights = vlad.hard_weights(local, words)
        else:
            weights = vlad.soft_weights(local, words, self._sharpness)
        return whitened(vlad.intra_normalised(vlad.residuals(local, words, weights)), self._words)
