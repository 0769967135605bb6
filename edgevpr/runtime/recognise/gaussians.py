"""Gaussian positions in a plane: distances, fusion and mixtures, for many at once. `belief` uses them."""

import numpy as np

from edgevpr.core.arrays import Doubles

MIN_VARIANCE_RATIO = 1e-6  # least ratio of the variances along both axes of a covariance that can be inverted
_ROUNDING = 1e-12  # relative error of the difference of two squares


def compute_distances(one: Doubles, other: Doubles) -> Doubles:
    """Return the distance between each of `one` (M, 2) and each of `other` (K, 2): (M, K)."""
    return np.asarray(np.sqrt(((one[:, None] - other) ** 2).sum(2)))


def compute_mean_sd(covariance: Doubles) -> Doubles:
    """Return the standard deviation (M,) along one axis, averaged over all directions, of covariances (M, 2, 2)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2))


def regularize_covariance(covariance: Doubles, min_variance: float) -> Doubles:
    """Make covariances (K, 2, 2) invertible: add `min_variance` and a small fraction of the trace to each axis."""
    added: Doubles = min_variance + MIN_VARIANCE_RATIO * np.abs(np.trace(covariance, axis1=1, axis2=2))
    return covariance + added[:, None, None] * np.eye(2)


def fuse_positions(one: Doubles, cov: Doubles, other: Doubles, other_cov: Doubles) -> tuple[Doubles, Doubles]:
    """Fuse K pairs of positions with correlated errors by covariance intersection (Julier and Uhlmann 1997)."""
    trace, other_trace = (np.trace(covariance, axis1=1, axis2=2) for covariance in (cov, other_cov))
    weight = (other_trace / (trace + other_trace))[:, None, None]
    information, other_information = weight * np.linalg.inv(cov), (1 - weight) * np.linalg.inv(other_cov)
    covariance = np.linalg.inv(information + other_information)
    mean = covariance @ (information @ one[..., None] + other_information @ other[..., None])
    return mean[..., 0], covariance


def mix_gaussians(weights: Doubles, means: Doubles, covariance: Doubles) -> tuple[Doubles, Doubles]:
    """Return the means (K, 2) and covariances (K, 2, 2) of K mixtures of M Gaussians with `means` (M, 2) and
    `covariance` (M, 2, 2), weighted by `weights` (K, M)."""
    centre = means.mean(0) if len(means) else np.zeros(2)  # far from zero, squared coordinates would lose digits
    offsets = means - centre
    second = covariance + offsets[:, :, None] * offsets[:, None]
    mean = weights @ offsets
    spread = (weights @ second.reshape(-1, 4)).reshape(-1, 2, 2) - mean[:, :, None] * mean[:, None]
    return centre + mean, regularize_covariance(spread, _ROUNDING * float(np.abs(second).max(initial=1)))
