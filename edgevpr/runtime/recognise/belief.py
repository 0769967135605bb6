"""Belief about the aircraft's position: a Bayes filter over the places of a map, updated by each query.

Positions are in the plane of the map: metres east and north of a fixed origin or, in a map without positions (an
*ordinal* one), the number of the place and 0. The aircraft is *lost* (off the map, or at a position on it that no query
has recognised), or near one of at most 64 hypotheses: Gaussian positions. Being lost has its own probability.

The probabilities from a single query are divided by the prior they were computed with, which gives likelihoods. So
without history, the result is that of the query alone. Three rules limit the influence of history:

* Between two queries the aircraft may have left the map or be anywhere, so the newest query must always agree.
* Pictures of the same ground are not new evidence. A hypothesis stores the evidence already counted (`credited`) for
  the ground below it (`anchor`), and the next query there replaces it. In a hover only the newest query counts.
* Ground outside the map that was mistaken for a place may also resemble the next places. So a place that fits the
  history raises the odds of being on the map only by a limited factor, and a history predicts a place only if it
  includes a match that was certain by itself (`confirmed`)."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgevpr.core.arrays import Bools, Doubles, Ints
from edgevpr.runtime.recognise import gaussians
from edgevpr.runtime.recognise.hypotheses import (
    MIN_DIVISOR,
    Hypotheses,
    MapScale,
    Motion,
    Prediction,
    compute_density,
    predict_misses,
    predict_motions,
)

_MAX_HYPOTHESES = 64
# Probabilities, between two queries, of leaving the map, jumping to any place on it, and entering it. History can raise
# the odds to at most 1 over the sum of the first two.
_LEAVE_CHANCE = 0.01
_JUMP_CHANCE = 0.01
_ENTER_CHANCE = 0.02
_MISS_LIKELIHOOD = 0.2  # of a query that misses the place below the aircraft, relative to a query off the map
_RESEMBLANCE = 0.1  # probability that ground outside the map, once mistaken for a place, also resembles the next ones
_MIN_NONE_PROBABILITY = 1e-4  # lowest probability that no candidate is correct
_NEWEST_WEIGHT = 0.2  # weight of the newest displacement in the mean velocity
_SAME_POSITION_SIGMAS = 2.0  # of a position: a shorter displacement may be zero
_MIN_WEIGHT = 1e-9  # a hypothesis with less weight is dropped
_MAX_DISTANCE = 1e8  # metres or places: farther than any two points on the Earth
_MIN_SD = 0.25  # smallest standard deviation of a position, in spacings of the map


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposals:
    """The K positions proposed by one query alone. `probability` (K,) is that of each; the remainder to 1 is that of
    none of them. Prior: the aircraft is off the map with probability 1/2, otherwise equally likely at any place.
    `covariance` (K, 2, 2) is that of the `position` (K, 2). `heading_deg` (K,): NaN if unknown. `is_certain` (K,): the
    query needs no history to accept a place at this position."""

    probability: Doubles
    position: Doubles
    covariance: Doubles
    heading_deg: Doubles
    is_certain: Bools


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Belief after a query: the probability of being `lost`, the `probability` (K,) of each candidate of the query,
    the one `predicted` (K,) by confirmed hypotheses, and an estimate of the `position` (2,), its `covariance` (2, 2),
    and the heading (None: unknown). `mass` is the total probability of the hypotheses near it (none: NaN)."""

    lost: float
    probability: Doubles
    predicted: Doubles
    mass: float = 0.0
    position: Doubles = field(default_factory=lambda: np.full(2, np.nan))
    covariance: Doubles = field(default_factory=lambda: np.full((2, 2), np.nan))
    heading_deg: float | None = None


class Belief:
    """Belief of one flight over one map, initially lost. Call `update` once for each query."""

    def __init__(self, scale: MapScale) -> None:
        self._scale = scale
        self._strongest, self._lost, self._enter_chance = 0.0, 1.0, 0.5  # as in the prior of the proposals
        shapes = {"weight": 0, "position": (0, 2), "covariance": (0, 2, 2), "velocity": (0, 2), "heading": (0, 2)}
        shapes |= {"credited": 0, "anchor": (0, 2), "confirmed": 0}
        self._now = Hypotheses(**{name: np.zeros(shape) for name, shape in shapes.items()})

    def drop_off_map(self, places: Doubles, sight: float) -> None:
        """Drop each hypothesis that is farther than `sight`, plus its standard deviation, from all `places` (N, 2):
        no ground of the map is in view there, so an aircraft at this position is lost."""
        position = self._now.position
        # As a product of matrices: ten times faster than differences with ten thousand places.
        squared = (places**2).sum(1) - 2 * position @ places.T
        distance = np.sqrt(np.maximum(squared.min(1) + (position**2).sum(1), 0))
        self._now = self._now[np.flatnonzero(distance <= sight + gaussians.compute_mean_sd(self._now.covariance))]
        self._lost = max(0.0, 1 - float(self._now.weight.sum()))

    def update(self, proposed: Proposals | None, motion: Motion, places: int) -> Posterior:
        """Update the belief with the candidates that a query proposes (None: too little texture in its picture; those
        that are not finite are ignored), the motion since the previous query, and the number of places in the map."""
        odds = (1 - self._lost) / max(self._lost, _MIN_WEIGHT)  # of not being lost
        now, lost, arrival = self._apply_transitions()
        moves = predict_motions(now, motion, places, self._scale)
        probability = np.zeros(0 if proposed is None else len(proposed.probability))
        predicted = np.zeros_like(probability)
        indices: Ints = np.zeros(0, int)
        if proposed is None:
            lost += arrival  # an aircraft that enters the map now is at an unknown place
            updated = predict_misses(now, moves, 1.0)
        else:
            self._enter_chance = _ENTER_CHANCE
            indices, proposed = _select_usable(proposed, self._scale)
            hits, likelihood, staleness, factor = self._weigh(proposed, now, moves, motion.elapsed_s, arrival, places)
            lost *= likelihood
            # Repeated misses over the same ground are not new evidence either.
            misses = predict_misses(now, moves, _MISS_LIKELIHOOD ** motion.new_ground_fraction(self._scale.spacing))
            near = self._scale.near + _SAME_POSITION_SIGMAS * gaussians.compute_mean_sd(misses.covariance)
            is_near = gaussians.compute_distances(proposed.position, misses.position) <= near
            predicted[indices] = is_near @ (now.weight * now.confirmed)
            # A lost aircraft that sees the same ground again has not moved either: this is no evidence of being lost.
            min_gain = (factor * odds * lost - float(misses.weight.sum())) / max(float(hits.weight.sum()), _MIN_WEIGHT)
            hits = replace(hits, weight=hits.weight * max(1.0, min_gain) ** staleness)
            pairs = {name: (getattr(hits, name), getattr(misses, name)) for name in Hypotheses.__slots__}
            updated = Hypotheses(**{name: np.concatenate(pair) for name, pair in pairs.items()})
        weight = updated.weight / (lost + float(updated.weight.sum()))
        probability[indices] = weight[: len(indices)]
        strongest = np.argsort(-weight, kind="stable")[:_MAX_HYPOTHESES]
        self._now = replace(updated, weight=weight)[strongest[weight[strongest] > _MIN_WEIGHT]]
        self._lost = max(0.0, 1 - float(self._now.weight.sum()))
        return self._make_posterior(probability, predicted)

    def _apply_transitions(self) -> tuple[Hypotheses, float, float]:
        """Apply the probabilities of leaving, entering and jumping between two queries. Return the hypotheses, the
        probability of being lost, and that of having entered or jumped to any place."""
        on_map = float(self._now.weight.sum())
        lost = (1 - self._enter_chance) * self._lost + _LEAVE_CHANCE * on_map
        stay_chance = 1 - _LEAVE_CHANCE - _JUMP_CHANCE
        leak = max(0.0, math.log(max(lost, MIN_DIVISOR) / max(stay_chance * self._lost, MIN_DIVISOR)))
        self._strongest = max(0.0, self._strongest - leak)
        credited = np.maximum(self._now.credited - leak, 0)
        now = replace(self._now, weight=stay_chance * self._now.weight, credited=credited)
        return now, lost, self._enter_chance * self._lost + _JUMP_CHANCE * on_map

    def _weigh(
        self,
        proposed: Proposals,
        now: Hypotheses,
        moves: list[Prediction],
        elapsed_s: float,
        arrival: float,
        places: int,
    ) -> tuple[Hypotheses, float, float, float]:
        """Weight the candidates by the hypotheses that can have moved to them. Returns

        * one hypothesis for each candidate,
        * the likelihood of the query if lost, relative to that on ground that never resembles the map,
        * the fraction (0..1) of the weight that comes from pictures of the same ground as the previous query,
        * the factor, at most 1, by which the odds of not being lost shrink if this query is weaker evidence there."""
        scale, position, cov = self._scale, proposed.position, proposed.covariance
        p_none = max(_MIN_NONE_PROBABILITY, 1 - float(proposed.probability.sum()))
        ratio = np.log(np.maximum(proposed.probability, MIN_DIVISOR) * places / p_none)
        arrival_weight = arrival / places * np.exp(ratio)

        # A picture of the same ground repeats the previous evidence. This holds for a lost aircraft as well.
        strongest, before = max(0.0, float(ratio.max(initial=0))), self._strongest
        repeated, self._strongest = min(before, strongest), strongest
        sd = np.sqrt(cov[:, 0, 0]) if scale.is_ordinal else gaussians.compute_mean_sd(cov)
        fresh = np.clip(
            (gaussians.compute_distances(now.anchor, position) - _SAME_POSITION_SIGMAS * sd) / scale.spacing, 0, 1
        )
        evidence = np.exp(ratio + (1 - fresh) * (repeated - now.credited[:, None])) * (scale.cell * now.weight[:, None])
        # For each motion, the weight (M, K) that each hypothesis gives each candidate.
        weights = [
            move.probability[:, None] * evidence * compute_density(move, position, cov, scale.is_ordinal)
            for move in moves
        ]
        weight = sum(matrix.sum(0) for matrix in weights)
        total = weight + arrival_weight
        origin = sum(weights) / np.maximum(weight, MIN_DIVISOR)  # (M, K): fraction of a candidate's weight
        stale = origin * (1 - fresh)
        staleness = float(weight @ stale.sum(0)) / max(MIN_DIVISOR, float(total.sum()))
        newest = float(ratio[stale.sum(0) > 0.5].max(initial=-math.inf))
        odds_factor = math.exp(min(0.0, newest - before))
        expected = float(now.weight.sum() * proposed.probability.sum())
        agreement = float(weight.sum()) * p_none / max(MIN_DIVISOR, expected)
        likelihood = (1 - _RESEMBLANCE + _RESEMBLANCE * agreement) ** (1 - staleness) if len(now.weight) else 1.0

        predicted_position, predicted_cov = gaussians.mix_gaussians(
            np.concatenate(weights).T / np.maximum(weight, MIN_DIVISOR)[:, None],
            np.concatenate([move.position for move in moves]),
            np.concatenate([move.covariance for move in moves]),
        )
        fused_position, fused_cov = gaussians.fuse_positions(position, cov, predicted_position, predicted_cov)
        gain = np.where(np.isnan(now.velocity[:, :1]), 1.0, _NEWEST_WEIGHT)
        kept = (1 - gain) * np.nan_to_num(now.velocity) - gain * now.position / elapsed_s
        velocity = (origin.T @ gain) * position / elapsed_s + origin.T @ kept
        anchor = (1 - stale.sum(0))[:, None] * position + stale.T @ now.anchor
        is_continued, heading = (weight > arrival_weight)[:, None], np.radians(proposed.heading_deg)
        hypotheses = Hypotheses(
            weight=math.exp(-staleness * repeated) * total,
            position=np.where(is_continued, fused_position, position),
            covariance=np.where(is_continued[..., None], fused_cov, cov),
            velocity=np.where(is_continued, velocity, np.nan),
            heading=np.nan_to_num(np.stack([np.cos(heading), np.sin(heading)], 1)),
            credited=np.maximum(ratio, 0),
            anchor=np.where(is_continued, anchor, position),
            confirmed=np.where(
                proposed.is_certain, 1.0, (origin.T @ now.confirmed) * weight / np.maximum(total, MIN_DIVISOR)
            ),
        )
        return hypotheses, likelihood, staleness, odds_factor

    def _make_posterior(self, probability: Doubles, predicted: Doubles) -> Posterior:
        """Return the belief with an estimate: the weighted mean of the hypotheses around the one whose
        neighbourhood has the most weight."""
        now, posterior = self._now, Posterior(lost=self._lost, probability=probability, predicted=predicted)
        if not len(now.weight):
            return posterior
        is_near = gaussians.compute_distances(now.position, now.position) <= self._scale.near
        chosen = is_near[(is_near @ now.weight).argmax()]
        mass = float(now.weight[chosen].sum())
        weight = now.weight[chosen] / mass
        (position,), (covariance,) = gaussians.mix_gaussians(weight[None], now.position[chosen], now.covariance[chosen])
        north, east = (weight @ now.heading[chosen]).tolist()
        heading_deg = math.degrees(math.atan2(east, north)) % 360 if math.hypot(north, east) > 0.5 else None
        return replace(posterior, mass=mass, position=position, covariance=covariance, heading_deg=heading_deg)


def _select_usable(proposed: Proposals, scale: MapScale) -> tuple[Ints, Proposals]:
    """Return the indices of the likeliest finite proposals, and those proposals, with covariances made invertible and
    probabilities scaled to sum to at most 1."""
    is_near = (np.abs(proposed.position) < _MAX_DISTANCE).all(1)
    is_near &= (np.abs(proposed.covariance) < _MAX_DISTANCE**2).all((1, 2))
    indices = np.flatnonzero((proposed.probability > 0) & (proposed.probability < np.inf) & is_near)
    indices = indices[np.argsort(-proposed.probability[indices], kind="stable")[:_MAX_HYPOTHESES]]
    probability = proposed.probability[indices]
    return indices, Proposals(
        probability=probability / max(1.0, float(probability.sum())),
        position=proposed.position[indices],
        covariance=gaussians.regularize_covariance(proposed.covariance[indices], (_MIN_SD * scale.spacing) ** 2),
        heading_deg=proposed.heading_deg[indices],
        is_certain=proposed.is_certain[indices],
    )
