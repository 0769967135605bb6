"""A network as a technique: a card that makes a vector by itself is a technique of the card's name, without any
code."""

import hashlib
import json
from collections.abc import Callable
from functools import partial

import numpy as np

from edgevpr.techniques.heads import pooling, projection, rmac, vlad, words
from edgevpr.techniques.networks.card import Card, head_parameters
from edgevpr.techniques.networks.session import Backbone, backbone_of
from edgevpr.techniques.vectors import NEVER, VectorTechnique

Head = Callable[[np.ndarray], np.ndarray]


class CardNetwork(VectorTechnique):
    """The network of a card. Its vector is the output of the network or, if the card names a head, the result of the
    head on the feature map. The model hash of a map covers all of this, so there are no parameters.

    The margins of its wrong matches are unknown: no match is accepted until the configuration sets a minimum margin.
    """

    min_margin = NEVER

    def __init__(self, card: Card, form: str = "float", threads: int = 1) -> None:
        self._backbone = backbone_of(card, "descriptor" if card.head is None else "features", threads)
        self._head, words_sha256 = _head(card, self._backbone)
        said = json.dumps([self._backbone.sha256, card.head, card.similarity, words_sha256], sort_keys=True)
        sha256 = hashlib.sha256(said.encode()).hexdigest()
        noise = np.random.default_rng(0).integers(0, 256, (card.input.height, card.input.width), np.uint8)
        length = len(self.vector(noise, None))  # raises ModelError for a feature map too small for the head
        super().__init__(card.name, {}, length, form=form, similarity=card.similarity, model_sha256=sha256)
        self.encode(noise)  # raises ModelError for numbers that half precision cannot hold

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (D,)."""
        return self._head(self._backbone.run(image, mask))


def _head(card: Card, backbone: Backbone) -> tuple[Head, str | None]:
    """Make the function of the card's head, from a feature map float32 (C, H, W) to (D,), and the hash of its learned
    words (None: it has none)."""
    if card.head is None:
        return lambda vector: vector, None
    asked = head_parameters(card)
    if card.head["name"] == "vlad":
        learned = words.load_words(card.name, "vlad", asked.words)
        return partial(_vlad, learned=learned), learned.sha256
    size, (_, height, width) = int(np.prod(backbone.shape)), backbone.shape
    heads: dict[str, Callable[[], Head]] = {
        "flatten": lambda: pooling.flatten,
        "max": lambda: pooling.maximum,
        "gem": lambda: partial(pooling.gem, p=asked.p),
        "grid": lambda: partial(pooling.grid, rows=asked.rows, columns=asked.columns, how=asked.how),
        "pyramid": lambda: partial(pooling.pyramid, levels=tuple(asked.levels)),
        "projection": lambda: partial(_projected, by=projection.gaussian_projection(size, asked.length, asked.seed)),
        "rmac": lambda: partial(_rmac, squares=rmac.square_regions(height, width)),
    }
    return heads[card.head["name"]](), None


def _projected(features: np.ndarray, by: projection.Projection) -> np.ndarray:
    return by(features.ravel())


def _rmac(features: np.ndarray, squares: list[tuple[int, int, int]]) -> np.ndarray:
    return rmac.aggregate(rmac.regional_vectors(features, squares))


def _vlad(features: np.ndarray, learned: words.Words) -> np.ndarray:
    local = vlad.local_descriptors(features)
    sums = vlad.residuals(local, learned.words, vlad.hard_weights(local, learned.words))
    return words.whitened(vlad.intra_normalised(sums), learned)
