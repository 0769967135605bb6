"""Hypotheses of where an aircraft is, as arrays, and the arithmetic of their Gaussians."""

from dataclasses import dataclass

import numpy as np

_ROUNDING = 1e-12  # share of squares that their difference may lose
_THINNEST = 1e-6  # ratio of the axes of a covariance, as variances, with which can still be calculated
_FLAT = 1 / (2 * np.pi)  # a variance whose Gaussian has the density 1 in its middle: a direction that does not exist


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypotheses:
    """M places where the aircraft may be: weights `w` (M,), positions `at` (M, 2) with `covariance` (M, 2, 2),
    `velocity` (M, 2) in units of the map a second (NaN: unknown), and `heading` (M, 2), north and east of a vector (0:
    unknown). `credited` (M,) is the logarithm of the likelihood ratio that the ground about `anchor` (M, 2) was given.
    """

    w: np.ndarray
    at: np.ndarray
    covariance: np.ndarray
    velocity: np.ndarray
    heading: np.ndarray
    credited: np.ndarray
    anchor: np.ndarray

    def __getitem__(self, index: np.ndarray) -> "Hypotheses":
        return Hypotheses(**{name: getattr(self, name)[index] for name in self.__slots__})

    @property
    def nbytes(self) -> int:
        return sum(getattr(self, name).nbytes for name in self.__slots__)


@dataclass(frozen=True, slots=True)
class Way:
    """One way in which each of M hypotheses can have moved: its `share` (M,), and where it ends: mean `at` (M, 2) with
    `covariance` (M, 2, 2). No place of the map has less than the density `least`."""

    share: np.ndarray
    at: np.ndarray
    covariance: np.ndarray
    least: float = 0.0


def none() -> Hypotheses:
    """Return no hypothesis."""
    pairs = np.zeros((0, 2))
    return Hypotheses(
        w=np.zeros(0),
        at=pairs,
        covariance=np.zeros((0, 2, 2)),
        velocity=pairs,
        heading=pairs,
        credited=np.zeros(0),
        anchor=pairs,
    )


def joined(one: Hypotheses, other: Hypotheses) -> Hypotheses:
    """Return the hypotheses of both."""
    return Hypotheses(
        **{name: np.concatenate([getattr(one, name), getattr(other, name)]) for name in Hypotheses.__slots__}
    )


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the distances (M, K) between positions (M, 2) and others (K, 2)."""
    return np.sqrt((one[:, None, 0] - other[None, :, 0]) ** 2 + (one[:, None, 1] - other[None, :, 1]) ** 2)


def density(way: Way, at: np.ndarray, covariance: np.ndarray, is_ordinal: bool) -> np.ndarray:
    """Return the density (M, K) of each of K positions `at` (K, 2), known to `covariance` (K, 2, 2), by a way."""
    xx, xy, yy = (way.covariance[:, None, i, j] + covariance[None, :, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    dx, dy = (at[None, :, i] - way.at[:, None, i] for i in (0, 1))
    if is_ordinal:
        xy, yy, dy = 0.0, _FLAT, 0.0
    determinant = np.maximum(xx * yy - xy * xy, _THINNEST * xx * yy)
    squared = (yy * (dx * dx) - 2 * xy * (dx * dy) + xx * (dy * dy)) / determinant
    return np.maximum(np.exp(-np.maximum(squared, 0) / 2) / (2 * np.pi * np.sqrt(determinant)), way.least)


def firm(covariance: np.ndarray, least: float) -> np.ndarray:
    """Return covariances (K, 2, 2) that can be inverted: a variance of `least`, and a share of their own, is added to
    each axis."""
    more = least + _THINNEST * np.abs(np.trace(covariance, axis1=1, axis2=2))
    return covariance + more[:, None, None] * np.eye(2)


def fused(
    one: np.ndarray, of_one: np.ndarray, other: np.ndarray, of_other: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Join two estimates each of K positions (K, 2), with their covariances (K, 2, 2), by covariance intersection
    (Julier and Uhlmann 1997): what is wrong with the map is common to both, so that two make no error smaller."""
    traces = [np.trace(each, axis1=1, axis2=2) for each in (of_one, of_other)]
    share = (traces[1] / (traces[0] + traces[1]))[:, None, None]
    by_one, by_other = share * np.linalg.inv(of_one), (1 - share) * np.linalg.inv(of_other)
    covariance = np.linalg.inv(by_one + by_other)
    at = covariance @ (by_one @ one[..., None] + by_other @ other[..., None])
    return at[..., 0], covariance


def mean_of(share: np.ndarray, at: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means (K, 2) and covariances (K, 2, 2) of mixtures: `share` (K, M) of Gaussians `at` (M, 2)."""
    middle = at.mean(0) if len(at) else np.zeros(2)  # coordinates far from zero would lose digits in their squares
    off = at - middle
    second = covariance + off[:, :, None] * off[:, None]
    mean = share @ off
    spread = (share @ second.reshape(-1, 4)).reshape(-1, 2, 2) - mean[:, :, None] * mean[:, None]
    return middle + mean, firm(spread, _ROUNDING * float(np.abs(second).max(initial=1)))
