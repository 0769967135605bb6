"""Evidence of one query by itself, as it is handed to the belief, and the measure of the map that it speaks of."""

from dataclasses import dataclass

import numpy as np

from edgevpr.runtime.recognise.hypotheses import firm

_FARTHEST = 1e8  # metres or places: farther than any two points on the Earth
_LEAST_SD = 0.25  # of a position, in spacings of the map


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Measure of a map. `spacing` is the distance after which a picture is new evidence: about half a footprint, or 1
    for a map of places in order (`is_ordinal`), whose second coordinate is 0. Hypotheses within `near` of each other
    are one position."""

    spacing: float
    near: float
    is_ordinal: bool = False

    @property
    def cell(self) -> float:
        """Ground of one place: an area, or a length where places are in order."""
        return self.spacing if self.is_ordinal else self.spacing**2


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """Positions that one query says by itself, K of them. `p` (K,) is the probability of each, by this query alone; the
    rest of 1 is the probability of none. It was made with the prior that the aircraft is off the map as likely as on
    it, and there at any place. `at` (K, 2) is where the aircraft then is, east and north of a fixed origin in metres,
    or the number of the place and 0. `covariance` (K, 2, 2) is that of `at`, and `heading_deg` (K,) is NaN where
    unknown."""

    p: np.ndarray
    at: np.ndarray
    covariance: np.ndarray
    heading_deg: np.ndarray


def usable(seen: Seen, ground: Ground, most: int) -> tuple[np.ndarray, Seen]:
    """Return the numbers of the likeliest candidates of a query, at most `most`, and these candidates. Left out is what
    makes no sense; the probabilities have a sum of 1 at most."""
    heard = np.flatnonzero((seen.p > 0) & (seen.p < np.inf) & (np.abs(seen.at) < _FARTHEST).all(1))
    heard = heard[np.argsort(-seen.p[heard], kind="stable")[:most]]
    p = seen.p[heard].astype(float)
    heading_deg = seen.heading_deg[heard].astype(float)
    return heard, Seen(
        p=p / max(1.0, float(p.sum())),
        at=seen.at[heard].astype(float),
        covariance=_sound(seen.covariance[heard].astype(float), _LEAST_SD * ground.spacing),
        heading_deg=np.where(np.isfinite(heading_deg), heading_deg, np.nan),
    )


def _sound(covariance: np.ndarray, least_sd: float) -> np.ndarray:
    """Return covariances (K, 2, 2) with the variance of `least_sd` on top; one that makes no sense is no more than
    that."""
    covariance = np.where((np.abs(covariance) < _FARTHEST**2).all((1, 2))[:, None, None], covariance, 0.0)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    is_sound = (xx >= 0) & (yy >= 0) & (xy * xy <= xx * yy)
    return firm(np.where(is_sound[:, None, None], covariance, 0.0), least_sd**2)
