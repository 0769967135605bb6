"""Hypotheses about the aircraft's position, and where each may have moved since the last query, for `belief`."""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.runtime.recognise.gaussians import MIN_VARIANCE_RATIO

_CV_PROBABILITY = 0.75  # of motion at constant velocity
_CV_SD = 0.5  # of this motion, in spacings of the map, and as a fraction of the displacement
# Odometry of the autopilot and of the camera: the probability that it is correct, and its standard deviation in
# spacings and as a fraction of the displacement.
_REPORTED_ODOMETRY = (0.6, 0.25, 0.15)
_VISUAL_ODOMETRY = (0.98, 0.05, 0.05)
_REACH_SIGMAS = 1.5  # the reach, in standard deviations of the motion
_UNIT_VARIANCE = 1 / (2 * np.pi)  # of a Gaussian with density 1 at its mean: second axis of ordinal maps
MIN_DIVISOR = 1e-300  # replaces zero
DEFAULT_MAX_SPEED_M_S = 30.0  # unless the configuration sets another speed


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Motion of the aircraft since the previous query, in metres or places: `reach` is the farthest it can have moved
    in `elapsed_s` seconds, and `displacement` (2,) the motion measured by the odometry of the camera (`is_visual`) or
    of the autopilot (None: unknown)."""

    reach: float
    elapsed_s: float
    displacement: Doubles | None = None
    is_visual: bool = False

    def new_ground_fraction(self, spacing: float) -> float:
        """Return the fraction (0..1) of the ground in the picture that is new; 1 without visual odometry."""
        step = self.displacement
        return min(1.0, float(np.hypot(*step)) / spacing) if self.is_visual and step is not None else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypotheses:
    """M possible positions of the aircraft: `weight` (M,), `position` (M, 2) with its `covariance` (M, 2, 2),
    `velocity` (M, 2) in map units per second (NaN: unknown), and `heading` (M, 2), a vector north and east (0:
    unknown). `credited` (M,): logarithm of the likelihood ratio already counted around `anchor` (M, 2). `confirmed`
    (M,): the fraction (0..1) of the weight that descends from a match that was certain by itself."""

    weight: Doubles
    position: Doubles
    covariance: Doubles
    velocity: Doubles
    heading: Doubles
    credited: Doubles
    anchor: Doubles
    confirmed: Doubles

    def __getitem__(self, index: Ints) -> "Hypotheses":
        return Hypotheses(**{name: getattr(self, name)[index] for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class Prediction:
    """One possible motion of each of M hypotheses: its `probability` (M,), and the new `position` (M, 2) with its
    `covariance` (M, 2, 2). The density is at least `min_density` everywhere."""

    probability: Doubles
    position: Doubles
    covariance: Doubles
    min_density: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MapScale:
    """Characteristic distances of a map. `spacing` is the distance after which a picture is new evidence: about half a
    footprint, or 1 in an ordinal map (`is_ordinal`). Hypotheses within `near` of each other count as one position."""

    spacing: float
    near: float
    is_ordinal: bool = False

    @property
    def cell(self) -> float:
        """Extent of one place: an area, or a length in an ordinal map."""
        return self.spacing if self.is_ordinal else self.spacing**2


def predict_motions(now: Hypotheses, motion: Motion, places: int, scale: MapScale) -> list[Prediction]:
    """Return the possible motions of each hypothesis over a map of this number of places: from odometry, at constant
    velocity, or anywhere in reach."""
    moves = []
    area = places * scale.cell
    widest = area / 2 if scale.is_ordinal else math.sqrt(area / math.pi)
    is_everywhere = not motion.reach < widest
    reach = widest if is_everywhere else motion.reach
    has_velocity = ~np.isnan(now.velocity[:, 0])
    step = np.where(has_velocity[:, None], now.velocity, 0) * motion.elapsed_s
    step *= (motion.reach / np.maximum(np.hypot(*step.T), max(motion.reach, MIN_DIVISOR)))[:, None]
    remaining, mean_move = np.ones(len(now.weight)), np.zeros(2)
    sd = max(reach / _REACH_SIGMAS, _CV_SD * scale.spacing)
    if (displacement := motion.displacement) is not None:
        probability, min_sd, relative_sd = _VISUAL_ODOMETRY if motion.is_visual else _REPORTED_ODOMETRY
        spread = (relative_sd**2 * displacement @ displacement + (min_sd * scale.spacing) ** 2) * np.eye(2)
        moves.append(Prediction(probability * remaining, now.position + displacement, now.covariance + spread))
        # Odometry wrong by a factor of two has an error as large as the displacement itself.
        remaining, mean_move = (1 - probability) * remaining, displacement
        sd = min(sd, scale.spacing + math.hypot(*displacement))
    variance = (_CV_SD * scale.spacing) ** 2 + (_CV_SD * np.hypot(*step.T)) ** 2 / 2
    cv_covariance = now.covariance + variance[:, None, None] * np.eye(2)
    moves.append(Prediction(_CV_PROBABILITY * has_velocity * remaining, now.position + step, cv_covariance))
    remaining, anywhere = (1 - _CV_PROBABILITY * has_velocity) * remaining, now.covariance + sd**2 * np.eye(2)
    moves.append(Prediction(remaining, now.position + mean_move, anywhere, is_everywhere / area))
    return moves


def predict_misses(now: Hypotheses, moves: list[Prediction], likelihood: float) -> Hypotheses:
    """Return the moved hypotheses if the query proposes none of them, with the weight multiplied by this likelihood."""
    probability = np.stack([move.probability for move in moves], 1)[..., None]
    position = np.stack([move.position for move in moves], 1)
    covariance = np.stack([move.covariance for move in moves], 1)
    mean = (probability * position).sum(1)
    offsets = position - mean[:, None]
    spread = (probability[..., None] * (covariance + offsets[..., :, None] * offsets[..., None, :])).sum(1)
    return replace(now, weight=likelihood * now.weight, position=mean, covariance=spread)


def compute_density(move: Prediction, position: Doubles, covariance: Doubles, is_ordinal: bool) -> Doubles:
    """Return the density (M, K) at K positions (K, 2) with `covariance` (K, 2, 2), after M hypotheses have moved."""
    xx, xy, yy = (move.covariance[:, None, i, j] + covariance[None, :, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    dx, dy = (position[None, :, i] - move.position[:, None, i] for i in (0, 1))
    if is_ordinal:
        xy, yy, dy = np.zeros(()), np.full((), _UNIT_VARIANCE), np.zeros(())
    determinant = np.maximum(xx * yy - xy * xy, MIN_VARIANCE_RATIO * xx * yy)
    squared = (yy * (dx * dx) - 2 * xy * (dx * dy) + xx * (dy * dy)) / determinant
    gaussian: Doubles = np.exp(-np.maximum(squared, 0) / 2) / (2 * np.pi * np.sqrt(determinant))
    return np.maximum(gaussian, move.min_density)
