"""Learned visual words, and the vectors made from them: VLAD (Jégou et al., CVPR 2010) and the bag of words.
`train_words.py` in models/recipes/ writes the files of words."""

import hashlib
import io
import zipfile

import numpy as np

from edgevpr.core.arrays import Array, Ints, Singles
from edgevpr.core.errors import ModelError
from edgevpr.core.files import find_model, read_file
from edgevpr.techniques.card import load_card

_MAX_FILE_BYTES = 500_000_000  # 65,536 words of 2,048 numbers
_TINY = 1e-12


def load_words(model: str, kind: str, count: int) -> tuple[Singles, str]:
    """Load the `count` words of `kind` ("vlad", "regions", "bow"), learned on the feature map of the card `model`.
    Returns them, float32 (K, D), and the combined hash of network and words, which a map stores. Raises ModelError,
    with the command that makes the file, if it is missing, damaged, or for another network (see `Card.fingerprint`)."""
    name = f"{model}_{kind}{count}.npz"
    recipe = "python models/recipes/train_words.py"
    command = f"make it with `{recipe} --images DIR --model {model} --kind {kind} --count {count}` in a checkout"
    path = find_model(name)
    if path is None:
        raise ModelError(f"The visual vocabulary {name} was not found in any models folder: {command}.")
    try:
        content = read_file(path, _MAX_FILE_BYTES)
        with np.lib.npyio.NpzFile(io.BytesIO(content)) as file:
            arrays = dict(file)
        words = arrays["words"].astype(np.float32)
    except (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile) as error:
        raise ModelError(f"{path} cannot be read as a visual vocabulary ({error}): {command}.") from error
    trained_on, fingerprint = str(arrays.get("model_sha256")), load_card(model).fingerprint
    if trained_on != fingerprint:
        details = f"({trained_on[:12]}...) than the current `{model}` ({fingerprint[:12]}...)"
        raise ModelError(f"{name} was trained with a different network {details}: {command}.")
    if words.ndim != 2 or len(words) != count or not np.isfinite(words).all():
        raise ModelError(f"{name} must have {count} words, but has an array of shape {words.shape}: {command}.")
    sha256 = hashlib.sha256((fingerprint + hashlib.sha256(content).hexdigest()).encode()).hexdigest()
    return words, sha256


def normalise_rows(vectors: Array) -> Array:
    """Scale rows (or a single vector) to length 1; a zero vector stays zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY))


def make_local_descriptors(features: Singles) -> Singles:
    """Return the activations at each position, row by row, as descriptors of length 1 (Arandjelović et al. 2016,
    section 3.1): (C, H, W) to float32 (H * W, C)."""
    return normalise_rows(features.reshape(len(features), -1).T)


def compute_vlad(local: Singles, words: Singles, sharpness: float | None = None) -> Singles:
    """Compute VLAD of the descriptors `local` (N, D) with `words` (K, D): float32 (K * D,). The part of word k is the
    sum over descriptors x of a_k(x) (x - c_k) (Arandjelović et al. 2016, equation 1), scaled to length 1 (Arandjelović
    and Zisserman 2013), as is the result. The weight a_k is 1 for the word nearest to x and 0 for the others
    (`sharpness` None), or that of `compute_soft_weights`."""
    if sharpness is None:
        weights = np.zeros((len(local), len(words)), np.float32)
        weights[np.arange(len(local)), find_nearest(local, words)] = 1
    else:
        weights = compute_soft_weights(local, words, sharpness)
    return normalise_rows(normalise_rows(weights.T @ local - weights.sum(axis=0)[:, None] * words).ravel())


def compute_soft_weights(local: Singles, words: Singles, sharpness: float) -> Singles:
    """Compute the softmax over the words c of -sharpness |x - c|^2 for each descriptor x (Arandjelović et al. 2016,
    equation 2): `local` (N, D), `words` (K, D) to float32 (N, K)."""
    closeness = sharpness * _compute_closeness(local, words)
    closeness -= closeness.max(axis=1, keepdims=True)
    weights: Singles = np.exp(closeness, out=closeness)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def compute_sharpness(words: Singles) -> float:
    """Compute the sharpness for `compute_soft_weights` at which a descriptor equal to a word gives that word, on
    average, 100 times the weight of the nearest other word, as NetVLAD (section 5, "Training") requires."""
    squares = np.einsum("kd,kd->k", words, words)
    distances = squares[:, None] + squares - 2 * words @ words.T
    np.fill_diagonal(distances, np.inf)
    return float(np.log(100) / max(distances.min(axis=1).mean(), _TINY)) if len(words) > 1 else 1.0


def compute_bag_of_words(local: Singles, words: Singles) -> Singles:
    """Return 1 for each of `words` (K, D) that is nearest to any descriptor of `local` (N, D) and 0 for the others,
    L2-normalised: float32 (K,). Counts recognise fewer places: many channels respond to the same part of an image."""
    present = np.zeros(len(words), np.float32)
    present[find_nearest(local, words)] = 1
    return normalise_rows(present)


def find_nearest(local: Singles, words: Singles) -> Ints:
    """Return the index of the word nearest to each descriptor, the first one in a tie: (N, D), (K, D) to int (N,)."""
    return np.asarray(_compute_closeness(local, words).argmax(axis=1))


def _compute_closeness(local: Singles, words: Singles) -> Singles:
    """Compute -|x - c|^2, plus a constant for each descriptor x: (N, D) and words (K, D) to float32 (N, K)."""
    return np.asarray(2 * local @ words.T - np.einsum("kd,kd->k", words, words))
