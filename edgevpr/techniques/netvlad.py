"""`netvlad`: how the activations at each position lie about learned words, whitened, compared by cosine.

Arandjelović et al., "NetVLAD: CNN architecture for weakly supervised place recognition", CVPR 2016, in the form of
thesis 4.2.1: 64 words. The paper trains words and network together, for VGG-16; here the words are learned afterwards
(`edgevpr train words`), as the paper starts out (its section 3.1), and the whitening only where that file holds one. A
network that has the layer inside gives a vector by itself: make a card of it, and it is a technique of its own.
"""

from typing import ClassVar

import numpy as np

from edgevpr.errors import UsageError
from edgevpr.techniques.heads import vlad
from edgevpr.techniques.heads.words import load_words, whitened
from edgevpr.techniques.networks.session import open_backbone
from edgevpr.techniques.vectors import VectorTechnique


class NetVlad(VectorTechnique):
    """VLAD of the feature map of the card `model` about `words` words; `assignment` of a position to them is "soft" or
    "hard"."""

    # With the weights that edgevpr ships no wrong match of corridor or aerial_caliterra (the sets tuned on), nor any
    # query of the one in the map of the other, was ahead by 0.104, 0.081, 0.067. Other weights want other figures.
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
        """uint8 (H, W[, 3]) -> float32 (words C,), or as long as the whitening makes it."""
        local, words = vlad.local_descriptors(self._backbone.run(image, mask)), self._words.words
        if self._sharpness is None:
            weights = vlad.hard_weights(local, words)
        else:
            weights = vlad.soft_weights(local, words, self._sharpness)
        return whitened(vlad.intra_normalised(vlad.residuals(local, words, weights)), self._words)
