"""Learned visual words: the file that `edgevpr train words` writes, and the bag of words over regions."""

import hashlib
from dataclasses import dataclass

import numpy as np

from edgevpr.core.errors import ModelError
from edgevpr.core.files import arrays_of, find_model, read_file
from edgevpr.techniques.heads.vlad import nearest, unit
from edgevpr.techniques.networks.card import load_card

_MAX_FILE_BYTES = 500_000_000  # 65,536 words of 2,048 numbers
_ROWS_AT_ONCE = 64  # of an 8-bit matrix converted to float32 together


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """Learned words: `words` float32 (K, D), and the `sha256` of model and words together, for the map. If the
    descriptor made of them is to be whitened, there are `mean` float32 (K D,) and `whitening` int8 (P, K D), to be
    multiplied by `scale` float32 (P,)."""

    words: np.ndarray
    sha256: str
    mean: np.ndarray | None = None
    whitening: np.ndarray | None = None
    scale: np.ndarray | None = None

    @property
    def length(self) -> int:
        """Number of values of a VLAD descriptor, after the whitening if there is one."""
        return self.words.size if self.whitening is None else len(self.whitening)


def load_words(model: str, kind: str, count: int) -> Words:
    """Load the `count` words of `kind` ("vlad", "regions", "bow") learned on the feature map of the card `model`.

    Raises ModelError for a file that is missing, damaged or learned on another network, and names the command that
    makes it. The fingerprint of the card tells networks apart: weights, preparation of the picture, and outputs.
    """
    name = f"{model}_{kind}{count}.npz"
    command = f"make them with `edgevpr train words --images DIR --model {model} --kind {kind} --count {count}`"
    path = find_model(name)
    if path is None:
        raise ModelError(f"There are no words {name} for the model `{model}`: {command}.")
    wanted = load_card(model).fingerprint
    try:
        content = read_file(path, _MAX_FILE_BYTES)
        arrays = arrays_of(content, _MAX_FILE_BYTES)
        learned_on = str(arrays["model_sha256"])
        words = arrays["words"].astype(np.float32)
    except (OSError, ValueError, KeyError, MemoryError) as error:
        raise ModelError(f"{path} cannot be read as words ({error}): {command}.") from error
    if learned_on != wanted:
        raise ModelError(
            f"{path} was learned on another network ({learned_on[:12]}...) than `{model}` is now ({wanted[:12]}...): "
            f"{command}."
        )
    if words.ndim != 2 or len(words) != count or not np.isfinite(words).all():
        raise ModelError(f"{path} must hold {count} words, and holds an array {words.shape}: {command}.")
    sha256 = hashlib.sha256((wanted + hashlib.sha256(content).hexdigest()).encode()).hexdigest()
    if "whitening" not in arrays:
        return Words(words=words, sha256=sha256)
    mean, whitening, scale = (arrays.get(key) for key in ("mean", "whitening", "whitening_scale"))
    if mean is None or scale is None or whitening.shape != (scale.size, words.size) or mean.shape != (words.size,):
        raise ModelError(f"{path} holds a whitening that does not fit its words: {command}.")
    return Words(
        words=words,
        sha256=sha256,
        mean=mean.astype(np.float32),
        whitening=whitening,
        scale=scale.astype(np.float32).ravel(),
    )


def bag_of_words(local: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Mark the words (K, D) that are nearest to any of the descriptors (N, D), and L2-normalise: float32 (K,).

    A word counts once, however often it occurs. Many channels mark the same part of a picture, so that counts say
    little; on corridor and aerial_caliterra, the data sets used for tuning, they find fewer places. The inverse
    document frequency is left out too, since it would weigh words by a map that is still being made.
    """
    present = np.zeros(len(words), np.float32)
    present[nearest(local, words)] = 1
    return unit(present)


def whitened(vector: np.ndarray, words: Words) -> np.ndarray:
    """Whiten a VLAD vector by W (v - mean), L2-normalised (Jégou and Chum, ECCV 2012): (K D,) to float32 (length,).
    Without a learned whitening the vector is returned as it is."""
    if words.whitening is None:
        return vector
    centred = vector - words.mean
    product = np.empty(words.length, np.float32)
    for start in range(0, words.length, _ROWS_AT_ONCE):
        rows = words.whitening[start : start + _ROWS_AT_ONCE]
        product[start : start + _ROWS_AT_ONCE] = rows.astype(np.float32) @ centred
    return unit(product * words.scale)
