"""VLAD: sums of the residuals of a picture's local descriptors to learned visual words (Jégou et al., CVPR 2010)."""

import numpy as np

_TINY = 1e-12


def local_descriptors(features: np.ndarray) -> np.ndarray:
    """Return the activations at each position as one L2-normalised descriptor: (C, H, W) to float32 (H * W, C).

    NetVLAD collects the same (Arandjelović et al. 2016, section 3.1). The positions are in rows from the top left.
    """
    return unit(features.reshape(len(features), -1).T).astype(np.float32, copy=False)


def hard_weights(local: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return 1 where a word is the nearest of a descriptor, else 0: (N, D), (K, D) to float32 (N, K)."""
    weights = np.zeros((len(local), len(words)), np.float32)
    weights[np.arange(len(local)), nearest(local, words)] = 1
    return weights


def soft_weights(local: np.ndarray, words: np.ndarray, sharpness: float) -> np.ndarray:
    """Compute the softmax over the words of -sharpness |x - c|^2 (Arandjelović et al. 2016, equation 2): (N, D), (K, D)
    to float32 (N, K)."""
    closeness = sharpness * _closeness(local, words)
    closeness -= closeness.max(axis=1, keepdims=True)
    weights = np.exp(closeness, out=closeness)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def sharpness(words: np.ndarray) -> float:
    """Compute the sharpness of `soft_weights`: at a word, its own weight is on average 100 times that of the next word.

    NetVLAD asks for that ratio over the training descriptors (section 5, "Training"). Only the words are kept here, so
    the ratio is taken over the words.
    """
    squares = np.einsum("kd,kd->k", words, words)
    apart = squares[:, None] + squares - 2 * words @ words.T
    np.fill_diagonal(apart, np.inf)
    return float(np.log(100) / max(apart.min(axis=1).mean(), _TINY)) if len(words) > 1 else 1.0


def residuals(local: np.ndarray, words: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute V(k) = sum over descriptors of a_k(x) (x - c_k) (Arandjelović et al. 2016, equation 1): float32
    (K, D)."""
    return weights.T @ local - weights.sum(axis=0)[:, None] * words


def intra_normalised(sums: np.ndarray) -> np.ndarray:
    """Scale each word's residual to length 1 (Arandjelović and Zisserman 2013), then the whole: (K, D) to float32
    (K * D,)."""
    return unit(unit(sums).ravel())


def nearest(local: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the number of the word nearest to each descriptor: (N, D), (K, D) to int (N,); of equally near words the
    first."""
    return _closeness(local, words).argmax(axis=1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale rows (or a single vector) to length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)


def _closeness(local: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Compute -|x - c|^2, up to a term that is the same for all words of a descriptor: (N, K)."""
    return 2 * local @ words.T - np.einsum("kd,kd->k", words, words)
