"""Arrays of hypotheses where an aircraft is, and the arithmetic of their Gaussians. Used by `belief`.

Positions are in the plane of the map: metres east and north of a fixed origin or, in a map without positions (an
*ordinal* one), the number of the place and 0.
"""

from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles, Ints

_ROUNDING = 1e-12  # relative error of the difference of two squares
_THINNEST = 1e-6  # least ratio of the variances along both axes of a covariance that can be inverted
_FARTHEST = 1e8  # metres or places: farther than any two points on the Earth
_LEAST_SD = 0.25  # least standard deviation of a position, in spacings of the map
_FLAT = 1 / (2 * np.pi)  # variance of a Gaussian with the density 1 in its middle, for the second axis of ordinal maps


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """M positions where the aircraft may be: weights `w` (M,), positions `at` (M, 2) with `covariance` (M, 2, 2),
    `velocity` (M, 2) in units of the map a second (NaN: unknown), and `heading` (M, 2), a vector north and east (0:
    unknown). `credited` (M,) is the log likelihood ratio already counted for the ground around `anchor` (M, 2)."""

    w: Doubles
    at: Doubles
    covariance: Doubles
    velocity: Doubles
    heading: Doubles
    credited: Doubles
    anchor: Doubles

    def __getitem__(self, index: Ints) -> "Hypotheses":
        return Hypotheses(*(getattr(self, name)[index] for name in self.__slots__))


NOWHERE = Hypotheses(*(np.zeros((0, *rest)) for rest in ((), (2,), (2, 2), (2,), (2,), (), (2,))))


@dataclass(frozen=True, slots=True)
class Way:
    """One way in which each of M hypotheses can have moved: its probability `share` (M,), and the Gaussian of the new
    position, mean `at` (M, 2) and `covariance` (M, 2, 2). The density is nowhere below `least`."""

    share: Doubles
    at: Doubles
    covariance: Doubles
    least: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MapScale:
    """Distances that count in a map. `spacing` is the distance after which a picture is new evidence: about half a
    footprint, or 1 in an ordinal map (`is_ordinal`). Hypotheses within `near` of each other count as one position."""

    spacing: float
    near: float
    is_ordinal: bool = False

    @property
    def cell(self) -> float:
        """Extent of one place: an area, or a length in an ordinal map."""
        return self.spacing if self.is_ordinal else self.spacing**2


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposals:
    """Positions that one query proposes by itself, K of them. `p` (K,) is the probability of each; the rest up to 1 is
    that of none. They assume the prior that the aircraft is off the map with probability 1/2, else at any place alike.
    `at` (K, 2) is the position with its `covariance` (K, 2, 2), and `heading_deg` (K,) the heading (NaN: unknown)."""

    p: Doubles
    at: Doubles
    covariance: Doubles
    heading_deg: Doubles


def joined(one: Hypotheses, other: Hypotheses) -> Hypotheses:
    """Return the hypotheses of `one`, then those of `other`."""
    pairs = ((getattr(one, name), getattr(other, name)) for name in Hypotheses.__slots__)
    return Hypotheses(*map(np.concatenate, pairs))


def apart(one: Doubles, other: Doubles) -> Doubles:
    """Return the distance between each of `one` (M, 2) and each of `other` (K, 2): (M, K)."""
    return np.sqrt((one[:, None, 0] - other[None, :, 0]) ** 2 + (one[:, None, 1] - other[None, :, 1]) ** 2)


def density(way: Way, at: Doubles, covariance: Doubles, is_ordinal: bool) -> Doubles:
    """Return the density (M, K), by a way of M hypotheses, of positions `at` (K, 2) with `covariance` (K, 2, 2)."""
    xx, xy, yy = (way.covariance[:, None, i, j] + covariance[None, :, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    dx, dy = (at[None, :, i] - way.at[:, None, i] for i in (0, 1))
    if is_ordinal:
        xy, yy, dy = np.zeros(()), np.full((), _FLAT), np.zeros(())
    determinant = np.maximum(xx * yy - xy * xy, _THINNEST * xx * yy)
    squared = (yy * (dx * dx) - 2 * xy * (dx * dy) + xx * (dy * dy)) / determinant
    gaussian: Doubles = np.exp(-np.maximum(squared, 0) / 2) / (2 * np.pi * np.sqrt(determinant))
    return np.maximum(gaussian, way.least)


def firm(covariance: Doubles, least: float) -> Doubles:
    """Make covariances (K, 2, 2) invertible: add the variance `least`, and a small share of their own, to each axis."""
    more: Doubles = least + _THINNEST * np.abs(np.trace(covariance, axis1=1, axis2=2))
    return covariance + more[:, None, None] * np.eye(2)


def fused(one: Doubles, of_one: Doubles, other: Doubles, of_other: Doubles) -> tuple[Doubles, Doubles]:
    """Combine two estimates of K positions, `one` and `other` (K, 2) with covariances (K, 2, 2), by covariance
    intersection (Julier and Uhlmann 1997), because errors of the map are common to both. Returns

    * the positions (K, 2),
    * their covariances (K, 2, 2).
    """
    traces = [np.trace(each, axis1=1, axis2=2) for each in (of_one, of_other)]
    share = (traces[1] / (traces[0] + traces[1]))[:, None, None]
    by_one, by_other = share * np.linalg.inv(of_one), (1 - share) * np.linalg.inv(of_other)
    covariance = np.linalg.inv(by_one + by_other)
    at = covariance @ (by_one @ one[..., None] + by_other @ other[..., None])
    return at[..., 0], covariance


def mean_of(share: Doubles, at: Doubles, covariance: Doubles) -> tuple[Doubles, Doubles]:
    """Return the means (K, 2) and covariances (K, 2, 2) of K mixtures of M Gaussians with means `at` (M, 2) and
    `covariance` (M, 2, 2), weighted by `share` (K, M)."""
    middle = at.mean(0) if len(at) else np.zeros(2)  # coordinates far from zero would lose digits in their squares
    off = at - middle
    second = covariance + off[:, :, None] * off[:, None]
    mean = share @ off
    spread = (share @ second.reshape(-1, 4)).reshape(-1, 2, 2) - mean[:, :, None] * mean[:, None]
    return middle + mean, firm(spread, _ROUNDING * float(np.abs(second).max(initial=1)))


def usable(proposed: Proposals, scale: MapScale, most: int) -> tuple[Ints, Proposals]:
    """Keep at most the `most` likeliest proposals of a query, without those that are not finite. Returns

    * their indices, int (n,),
    * these proposals, with covariances that can be inverted and probabilities that sum to 1 at most.
    """
    is_near = (np.abs(proposed.at) < _FARTHEST).all(1) & (np.abs(proposed.covariance) < _FARTHEST**2).all((1, 2))
    numbers = np.flatnonzero((proposed.p > 0) & (proposed.p < np.inf) & is_near)
    numbers = numbers[np.argsort(-proposed.p[numbers], kind="stable")[:most]]
    p = proposed.p[numbers]
    return numbers, Proposals(
        p=p / max(1.0, float(p.sum())),
        at=proposed.at[numbers],
        covariance=firm(proposed.covariance[numbers], (_LEAST_SD * scale.spacing) ** 2),
        heading_deg=proposed.heading_deg[numbers],
    )
