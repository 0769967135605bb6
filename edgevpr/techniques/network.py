"""Techniques that describe an image by one vector from a network: its descriptor, or the output of a *head*, such as a
pooling, on its feature map. A card whose network outputs a descriptor is a technique of the same name.

The techniques of the thesis have parameters: `model` is the name of the network's card, `form` is "float", "8bit" or
"1bit" (see `vectors`), and `threads` is the number of its threads. A map depends on neither `form` nor `threads`."""

from collections.abc import Callable
from typing import Any

import numpy as np

from edgevpr.core.arrays import Doubles, Image, Mask, Singles
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.card import Card, compute_digest
from edgevpr.techniques.regions import describe_regions, find_regions, open_region_backbone
from edgevpr.techniques.session import Backbone, open_backbone
from edgevpr.techniques.vectors import UNREACHABLE_MARGIN, VectorTechnique
from edgevpr.techniques.words import compute_sharpness, compute_vlad, load_words, make_local_descriptors

# Minimum margins in the forms `float`, `8bit` and `1bit`; the comments give the largest margin of a wrong match, with
# the shipped weights, on corridor and aerial_caliterra (the data sets used for tuning), and with the queries of one in
# the map of the other. Other weights need other values.
_MARGINS = {
    "calc": (0.11, 0.15, 0.10),  # 0.089, 0.12, 0.078, also with the original weights
    "alexnet": (0.15, 0.12, 0.1),  # 0.117, 0.094, 0.080
    "amosnet": (0.04, 0.04, 0.155),  # 0.033, 0.032, 0.123
    "hybridnet": (0.04, 0.04, 0.155),
    "netvlad": (0.13, 0.105, 0.085),  # 0.104, 0.081, 0.067
    "region_vlad": (0.075, 0.055, 0.03),  # 0.060, 0.042, 0.021
}
Head = Callable[[Singles], Singles]  # converts an output of a network to a vector, float32 (D,)


class NetworkVector(VectorTechnique):
    """A technique whose vector is computed by `head` from one output of a network (None: the output is the vector). The
    head raises ModelError if the feature map is too small. `spec`: further arguments of `VectorTechnique`."""

    def __init__(self, name: str, backbone: Backbone, head: Head | None, **spec: Any) -> None:
        self._backbone, self._head = backbone, head or np.asarray
        length = len(self._head(np.zeros(backbone.shape, np.float32)))
        spec = {"margins": _MARGINS.get(name, (UNREACHABLE_MARGIN,) * 3), "model_sha256": backbone.sha256, **spec}
        super().__init__(name, length, **spec)

    def make_vector(self, image: Image, mask: Mask | None) -> Singles:
        return self._head(self._backbone.run(image, mask))


def calc(model: str = "calc", form: str = "float", threads: int = 1) -> NetworkVector:
    """Make `calc`: the descriptor of an autoencoder trained to predict the HOG of an image from a distorted copy of
    it, compared by cosine (Merrill and Huang, "Lightweight Unsupervised Deep Loop Closure", RSS 2018: 1064 values from
    a grey, histogram-equalised image of 160x120)."""
    backbone = open_backbone(model, "descriptor", threads)
    return NetworkVector("calc", backbone, None, parameters={"model": model}, form=form)


def alexnet(
    *, model: str = "calc", form: str = "float", threads: int = 1, dims: int = 1064, seed: int = 0
) -> NetworkVector:
    """Make `alexnet`: all activations of one layer, reduced to `dims` values by a Gaussian random projection generated
    from `seed`, compared by cosine.

    Sünderhauf et al., "On the Performance of ConvNet Features for Place Recognition", IROS 2015, as in thesis 4.2.1:
    `conv3` of AlexNet. The form `1bit` is the locality-sensitive hash of the paper's section IV-D."""
    if not (8 <= dims <= 65_536 and 0 <= seed < 2**31):
        raise UsageError(f"alexnet cannot use dims={dims}, seed={seed}: dims must be 8 to 65536, seed 0 or more.")
    backbone = open_backbone(model, "features", threads)
    head = make_gaussian_projection(int(np.prod(backbone.shape)), dims, seed)
    return NetworkVector("alexnet", backbone, head, parameters={"model": model, "dims": dims, "seed": seed}, form=form)


def amosnet(model: str = "calc", form: str = "float", threads: int = 1, levels: int = 4) -> NetworkVector:
    """Make `amosnet`: the largest activations in the cells of a pyramid of grids, 1x1 to `levels` x `levels`, divided
    by their sum, compared by L1 distance.

    Chen et al., "Deep Learning Features at Scale for Visual Place Recognition", ICRA 2017, as in thesis 4.2.1: `conv5`
    of a network trained from scratch on the places of SPED (its card is `model`), with spatial pyramid pooling.
    Dividing by the sum recognises more places in the tuning sets."""
    return _make_pyramid("amosnet", model, form, threads, levels)


def hybridnet(model: str = "calc", form: str = "float", threads: int = 1, levels: int = 4) -> NetworkVector:
    """Make `hybridnet`: `amosnet` with other weights, fine-tuned from CaffeNet (Chen et al., ICRA 2017; thesis 4.2.1).
    Pass the card of these weights as `model`."""
    return _make_pyramid("hybridnet", model, form, threads, levels)


def netvlad(
    *, model: str = "calc", form: str = "float", threads: int = 1, words: int = 64, assignment: str = "soft"
) -> NetworkVector:
    """Make `netvlad`: VLAD of the activations at each position with `words` learned visual words, compared by cosine.
    The `assignment` of a position to the words is "soft" or "hard".

    Arandjelović et al., "NetVLAD: CNN architecture for weakly supervised place recognition", CVPR 2016, as in thesis
    4.2.1, not whitened. The words are learned for a finished network, as before the paper's training (section 3.1)."""
    if assignment not in ("soft", "hard"):
        raise UsageError(f"netvlad has no assignment `{assignment}`: use soft or hard.")
    backbone = open_backbone(model, "features", threads)
    vocabulary, sha256 = load_words(model, "vlad", words)
    sharpness = compute_sharpness(vocabulary) if assignment == "soft" else None

    def head(features: Singles) -> Singles:
        return compute_vlad(make_local_descriptors(features), vocabulary, sharpness)

    parameters = {"model": model, "words": words, "assignment": assignment}
    return NetworkVector("netvlad", backbone, head, parameters=parameters, form=form, model_sha256=sha256)


def region_vlad(
    *, model: str = "calc", form: str = "float", threads: int = 1, regions: int = 400, words: int = 256
) -> NetworkVector:
    """Make `region_vlad`: VLAD of the `regions` regions of highest energy (see `find_regions`) with `words` learned
    visual words, compared by cosine. An image without any region gives zeros.

    Khaliq et al., "A Holistic Visual Place Recognition Approach Using Lightweight CNNs for Significant ViewPoint and
    Appearance Changes", T-RO 2019, as in thesis 4.2.1: 400 regions of `conv4`, 256 words."""
    backbone = open_region_backbone("region_vlad", model, threads, regions)
    vocabulary, sha256 = load_words(model, "regions", words)

    def head(features: Singles) -> Singles:
        return compute_vlad(describe_regions(features, find_regions(features, regions)), vocabulary)

    parameters = {"model": model, "regions": regions, "words": words}
    return NetworkVector("region_vlad", backbone, head, parameters=parameters, form=form, model_sha256=sha256)


def make_from_card(card: Card, form: str = "float", threads: int = 1) -> NetworkVector:
    """Make the technique of a card: its vector is the network's descriptor. A map records no parameters, because the
    hash of the network covers them. No match is accepted until the configuration sets a minimum margin."""
    backbone = Backbone(card, "descriptor", threads)
    # None: earlier versions hashed more values here, and their maps must stay valid.
    sha256 = compute_digest([backbone.sha256, None, card.similarity, None])
    technique = NetworkVector(card.name, backbone, None, form=form, similarity=card.similarity, model_sha256=sha256)
    noise = np.random.default_rng(0).integers(0, 256, (card.input.height, card.input.width), np.uint8)
    technique.encode(noise)  # raises ModelError for values outside the half-precision range
    return technique


def _make_pyramid(name: str, model: str, form: str, threads: int, levels: int) -> NetworkVector:
    if not 1 <= levels <= 64:
        raise UsageError(f"{name}: levels is {levels}, but must be 1 to 64.")

    def head(features: Singles) -> Singles:
        pooled = pool_pyramid(features, levels)
        return np.asarray(pooled / max(float(np.abs(pooled).sum()), 1e-6))

    backbone, parameters = open_backbone(model, "features", threads), {"model": model, "levels": levels}
    return NetworkVector(name, backbone, head, parameters=parameters, form=form, similarity="l1")


def pool_pyramid(features: Singles, levels: int) -> Singles:
    """Max-pool a feature map over a spatial pyramid (He et al. 2014, section 2.2): float32 (C, H, W) to float32 (C *
    sum of n^2,), the largest activation of each channel in each cell of the grids of n x n cells, n = 1 to `levels` in
    turn. Raises ModelError if the feature map is smaller than a grid."""
    _, height, width = features.shape
    if levels > min(height, width):
        raise ModelError(
            f"A feature map of {height}x{width} is too small for a grid of {levels}x{levels}: use fewer levels, or a "
            "network with a larger feature map."
        )
    return np.concatenate(
        [
            features[:, top:bottom, left:right].max(axis=(1, 2))
            for n in range(1, levels + 1)
            for top, bottom in _split_cells(height, n)
            for left, right in _split_cells(width, n)
        ]
    )


def make_gaussian_projection(size: int, length: int, seed: int) -> Callable[[Singles], Singles]:
    """Make a Gaussian random projection of float32 arrays of `size` values, of any shape, to float32 (length,). It
    preserves angles, and lengths on average. Raises ModelError if `length` is larger than `size`.

    Each activation is multiplied by a random sign. The rows of the matrix are the cyclic shifts of *one* Gaussian
    vector (Hinrichs and Vybíral 2011), so the product is a correlation, computed by the Fourier transform. For 43,008
    activations and 1064 dimensions a full matrix would take 183 MB."""
    if length > size:
        raise ModelError(f"A feature map of {size} values cannot have {length} dimensions: use at most {size}.")
    row, signs = make_gaussian_row(size, seed)
    spectrum = np.conj(np.fft.rfft(row))  # row j of the matrix is the Gaussian vector shifted by j: a correlation

    def project(features: Singles) -> Singles:
        shifted = np.fft.irfft(spectrum * np.fft.rfft(features.ravel() * signs, size), size)
        return np.asarray(shifted[:length] / np.sqrt(length), np.float32)

    return project


def make_gaussian_row(size: int, seed: int) -> tuple[Doubles, Singles]:
    """Make the Gaussian vector float64 (size,) and the signs float32 (size,), +1 or -1, of a seed. They must stay the
    same as long as a map is used. NumPy guarantees this only for the raw values of PCG64 (NEP 19), so these are used:
    first two for each pair of Gaussian values (Box and Muller 1958), then one for each sign."""
    pairs = -(-size // 2)
    raw = np.random.PCG64(seed).random_raw(2 * pairs + size)
    uniform = ((raw[: 2 * pairs] >> np.uint64(11)) + 0.5) * 2.0**-53  # never 0
    radius = np.sqrt(-2 * np.log(uniform[:pairs]))
    angle = 2 * np.pi * uniform[pairs:]
    row = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[:size]
    return row, np.where(raw[2 * pairs :] >> np.uint64(63), np.float32(1), np.float32(-1))


def _split_cells(length: int, count: int) -> list[tuple[int, int]]:
    return [(i * length // count, -(-(i + 1) * length // count)) for i in range(count)]
