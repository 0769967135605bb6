"""Belief where the aircraft is, updated from query to query by a Bayes filter over the places of a map (see
`place_filter`).

Positions are in the plane of the map: metres east and north of a fixed origin or, in a map without positions (an
*ordinal* one), the number of the place and 0. The aircraft is *lost* (off the map, or on it where no query has
recognised it), or near one of at most 64 hypotheses: Gaussian positions. Being lost has a probability of its own.

The probabilities of a query alone are divided by the prior they were made with, which gives likelihoods. Without
history the result is thus that of the query. Three things keep a history from being believed too much:

* Between two queries the aircraft may have left the map or be anywhere, so the newest query must always support it.
* Pictures of the same ground are no new evidence. A hypothesis stores the evidence it was already given (`credited`)
  for the ground where it is (`anchor`), and the next query there replaces it. In a hover only the newest query counts.
* Ground outside the map that was once mistaken for a place may well resemble the places that follow it. So a place that
  fits the history supports being on the map by a limited factor only.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgevpr.core.arrays import Doubles, Ints

_MAX_HYPOTHESES = 64
# Chances between two queries to leave the map, to be anywhere on it, and to enter it. The odds for a history are at
# most 1 to the sum of the first two.
_LEAVE_CHANCE = 0.01
_JUMP_CHANCE = 0.01
_ENTER_CHANCE = 0.02
_MISS_LIKELIHOOD = 0.2  # of a query that misses the place below it, over that of one off the map
_RESEMBLANCE = 0.1  # how likely ground outside the map, once taken for a place, resembles the next places as well
_MIN_REST = 1e-4  # least probability that no candidate is right
_STEADY = 0.75  # probability of going on as before
_STEADY_SD = 0.5  # in spacings of the map
# Of odometry, as an autopilot reports it and as the camera measures it: the probability that it holds, and its
# standard deviation in spacings and as a share of the length.
_REPORTED_ODOMETRY = (0.6, 0.25, 0.15)
_VISUAL_ODOMETRY = (0.98, 0.05, 0.05)
_REACH_SD = 1.5  # the reach in standard deviations
_NEWEST_WEIGHT = 0.2  # weight of the newest displacement in the mean velocity
_SAME_POSITION_SD = 2.0  # standard deviations of a position: a shorter displacement may be none
_MIN_WEIGHT = 1e-9  # a hypothesis of less weight is dropped
_MIN_DIVISOR = 1e-300  # instead of zero, where a number divides
_ROUNDING = 1e-12  # relative error of the difference of two squares
_MIN_VARIANCE_RATIO = 1e-6  # least ratio of the variances along both axes of a covariance that can be inverted
_MAX_DISTANCE = 1e8  # metres or places: farther than any two points on the Earth
_MIN_SD = 0.25  # least standard deviation of a position, in spacings of the map
_UNIT_VARIANCE = 1 / (2 * np.pi)  # of a Gaussian with the density 1 in its middle: second axis of ordinal maps
DEFAULT_MAX_SPEED_M_S = 30.0  # unless the configuration says another speed


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Motion of the aircraft since the previous query, in metres or places: `reach` is how far it can have moved in
    `elapsed_s` seconds, and `by` (2,) its displacement by odometry (None: unknown), which `is_seen` by the camera
    itself or reported by the autopilot."""

    reach: float
    elapsed_s: float
    by: Doubles | None = None
    is_seen: bool = False

    def share_of_new_ground(self, spacing: float) -> float:
        """Return which share of the ground in the picture is new, as far as that is seen: 0 to 1."""
        return min(1.0, float(np.hypot(*self.by)) / spacing) if self.is_seen and self.by is not None else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hypotheses:
    """M positions where the aircraft may be: weights `w` (M,), positions `at` (M, 2) with `covariance` (M, 2, 2),
    `velocity` (M, 2) in units of the map a second (NaN: unknown), and `heading` (M, 2), a vector north and east (0:
    unknown). `credited` (M,): logarithm of the likelihood ratio already counted around `anchor` (M, 2)."""

    w: Doubles
    at: Doubles
    covariance: Doubles
    velocity: Doubles
    heading: Doubles
    credited: Doubles
    anchor: Doubles

    def __getitem__(self, index: Ints) -> "_Hypotheses":
        return _Hypotheses(**{name: getattr(self, name)[index] for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class _Move:
    """One motion that each of M hypotheses can have made: its probability `share` (M,), and the new position `at`
    (M, 2) with its `covariance` (M, 2, 2). The density is nowhere below `least`."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Belief after a query: the probability of being `lost`, the probability `p` (K,) of each candidate of the query,
    and an estimate of the position: `at` (2,), its `covariance` (2, 2), and the heading (None: unknown). `mass` is the
    probability of all hypotheses near it; without any, the estimate is NaN."""

    lost: float
    p: Doubles
    mass: float = 0.0
    at: Doubles = field(default_factory=lambda: np.full(2, np.nan))
    covariance: Doubles = field(default_factory=lambda: np.full((2, 2), np.nan))
    heading_deg: float | None = None


class Belief:
    """Belief of one flight over one map. It begins as lost; `update` is called once for each query."""

    def __init__(self, scale: MapScale) -> None:
        self._scale = scale
        self._strongest, self._lost, self._enters = 0.0, 1.0, 0.5  # as in the prior of the proposals
        shapes = {"w": 0, "at": (0, 2), "covariance": (0, 2, 2), "velocity": (0, 2), "heading": (0, 2)}
        shapes |= {"credited": 0, "anchor": (0, 2)}
        self._now = _Hypotheses(**{name: np.zeros(shape) for name, shape in shapes.items()})

    def update(self, proposed: Proposals | None, motion: Motion, places: int) -> Posterior:
        """Update the belief with the candidates that a query proposes (None: its picture shows too little; those that
        are not finite do not count), the motion since the previous query, and the number of places in the map now."""
        odds = (1 - self._lost) / max(self._lost, _MIN_WEIGHT)
        now, lost, appears = self._apply_transitions()
        moves = self._predict_motions(now, motion, places)
        p = np.zeros(0 if proposed is None else len(proposed.p))
        numbers: Ints = np.zeros(0, int)
        if proposed is None:
            lost += appears  # whoever enters the map now is at an unknown place
            after = _keep_unseen(now, moves, 1.0)
        else:
            self._enters = _ENTER_CHANCE
            numbers, proposed = _select_usable(proposed, self._scale)
            there, alike, staleness, left = self._weigh(proposed, now, moves, motion.elapsed_s, appears, places)
            lost *= alike
            # Of a miss, too, pictures of the same ground are no new evidence.
            unseen = _keep_unseen(now, moves, _MISS_LIKELIHOOD ** motion.share_of_new_ground(self._scale.spacing))
            # A lost aircraft that sees the same ground again has not moved either, so staying is no evidence for it.
            kept = (left * odds * lost - float(unseen.w.sum())) / max(float(there.w.sum()), _MIN_WEIGHT)
            there = replace(there, w=there.w * max(1.0, kept) ** staleness)
            both = {name: (getattr(there, name), getattr(unseen, name)) for name in _Hypotheses.__slots__}
            after = _Hypotheses(**{name: np.concatenate(pair) for name, pair in both.items()})
        share = after.w / (lost + float(after.w.sum()))
        p[numbers] = share[: len(numbers)]
        strongest = np.argsort(-share, kind="stable")[:_MAX_HYPOTHESES]
        self._now = replace(after, w=share)[strongest[share[strongest] > _MIN_WEIGHT]]
        self._lost = max(0.0, 1 - float(self._now.w.sum()))
        return self._make_posterior(p)

    def _apply_transitions(self) -> tuple[_Hypotheses, float, float]:
        """Return the hypotheses after the chances of leaving, entering and jumping between two queries, the probability
        of being lost, and that of having entered or jumped to any place."""
        held = float(self._now.w.sum())
        lost = (1 - self._enters) * self._lost + _LEAVE_CHANCE * held
        stays = 1 - _LEAVE_CHANCE - _JUMP_CHANCE
        leaked = max(0.0, math.log(max(lost, _MIN_DIVISOR) / max(stays * self._lost, _MIN_DIVISOR)))
        self._strongest = max(0.0, self._strongest - leaked)
        credited = np.maximum(self._now.credited - leaked, 0)
        now = replace(self._now, w=stays * self._now.w, credited=credited)
        return now, lost, self._enters * self._lost + _JUMP_CHANCE * held

    def _predict_motions(self, now: _Hypotheses, motion: Motion, places: int) -> list[_Move]:
        """Return the motions that each hypothesis can have made: by odometry, on as before, or anywhere in reach."""
        scale, moves = self._scale, []
        area = places * scale.cell
        widest = area / 2 if scale.is_ordinal else math.sqrt(area / math.pi)
        is_everywhere = not motion.reach < widest
        reach = widest if is_everywhere else motion.reach
        is_going = ~np.isnan(now.velocity[:, 0])
        ahead = np.where(is_going[:, None], now.velocity, 0) * motion.elapsed_s
        ahead *= (motion.reach / np.maximum(np.hypot(*ahead.T), max(motion.reach, _MIN_DIVISOR)))[:, None]
        left, middle, sd = np.ones(len(now.w)), np.zeros(2), max(reach / _REACH_SD, _STEADY_SD * scale.spacing)
        if motion.by is not None:
            share, least_sd, of_length = _VISUAL_ODOMETRY if motion.is_seen else _REPORTED_ODOMETRY
            spread = (of_length**2 * motion.by @ motion.by + (least_sd * scale.spacing) ** 2) * np.eye(2)
            moves.append(_Move(share * left, now.at + motion.by, now.covariance + spread))
            # Odometry that is wrong by a factor of two is wrong by as much as its length.
            left, middle, sd = (1 - share) * left, motion.by, min(sd, scale.spacing + math.hypot(*motion.by))
        variance = (_STEADY_SD * scale.spacing) ** 2 + (_STEADY_SD * np.hypot(*ahead.T)) ** 2 / 2
        going = now.covariance + variance[:, None, None] * np.eye(2)
        moves.append(_Move(_STEADY * is_going * left, now.at + ahead, going))
        anywhere = now.covariance + sd**2 * np.eye(2)
        moves.append(_Move((1 - _STEADY * is_going) * left, now.at + middle, anywhere, is_everywhere / area))
        return moves

    def _weigh(
        self,
        proposed: Proposals,
        now: _Hypotheses,
        moves: list[_Move],
        elapsed_s: float,
        appears: float,
        places: int,
    ) -> tuple[_Hypotheses, float, float, float]:
        """Weigh the candidates by the hypotheses that can have moved to them. Returns

        * one hypothesis for each candidate,
        * the likelihood of the query if lost, relative to that on ground that never resembles the map,
        * the share (0..1) of the weight that comes from pictures of the same ground as the query before,
        * the factor, 1 at most, by which the odds of not being lost shrink if this query is weaker evidence there.
        """
        scale, at, of_step = self._scale, proposed.at, proposed.covariance
        rest = max(_MIN_REST, 1 - float(proposed.p.sum()))
        ratio = np.log(np.maximum(proposed.p, _MIN_DIVISOR) * places / rest)
        born = appears / places * np.exp(ratio)

        # A picture of the same ground repeats the evidence of the one before. This holds for a lost aircraft as well.
        strongest, before = max(0.0, float(ratio.max(initial=0))), self._strongest
        same, self._strongest = min(before, strongest), strongest
        scatter = np.sqrt(of_step[:, 0, 0] if scale.is_ordinal else np.trace(of_step, axis1=1, axis2=2) / 2)
        fresh = np.clip((_compute_distances(now.anchor, at) - _SAME_POSITION_SD * scatter) / scale.spacing, 0, 1)
        evidence = np.exp(ratio + (1 - fresh) * (same - now.credited[:, None])) * (scale.cell * now.w[:, None])
        led = [move.share[:, None] * evidence * _compute_density(move, at, of_step, scale.is_ordinal) for move in moves]
        weight = sum(each.sum(0) for each in led)  # of the hypotheses that lead to each candidate
        by = sum(led) / np.maximum(weight, _MIN_DIVISOR)
        stale = by * (1 - fresh)
        staleness = float(weight @ stale.sum(0)) / max(_MIN_DIVISOR, float((weight + born).sum()))
        newest = float(ratio[stale.sum(0) > 0.5].max(initial=-math.inf))
        left = math.exp(min(0.0, newest - before))
        agreement = float(weight.sum()) * rest / max(_MIN_DIVISOR, float(now.w.sum() * proposed.p.sum()))
        alike = (1 - _RESEMBLANCE + _RESEMBLANCE * agreement) ** (1 - staleness) if len(now.w) else 1.0

        at_before, of_before = _mix_gaussians(
            np.concatenate(led).T / np.maximum(weight, _MIN_DIVISOR)[:, None],
            np.concatenate([move.at for move in moves]),
            np.concatenate([move.covariance for move in moves]),
        )
        at_both, of_both = _fuse(at, of_step, at_before, of_before)
        learns = np.where(np.isnan(now.velocity[:, :1]), 1.0, _NEWEST_WEIGHT)
        kept = (1 - learns) * np.nan_to_num(now.velocity) - learns * now.at / elapsed_s
        velocity = (by.T @ learns) * at / elapsed_s + by.T @ kept
        anchor = (1 - stale.sum(0))[:, None] * at + stale.T @ now.anchor
        is_led, heading = (weight > born)[:, None], np.radians(proposed.heading_deg)
        there = _Hypotheses(
            w=math.exp(-staleness * same) * (weight + born),
            at=np.where(is_led, at_both, at),
            covariance=np.where(is_led[..., None], of_both, of_step),
            velocity=np.where(is_led, velocity, np.nan),
            heading=np.nan_to_num(np.stack([np.cos(heading), np.sin(heading)], 1)),
            credited=np.maximum(ratio, 0),
            anchor=np.where(is_led, anchor, at),
        )
        return there, alike, staleness, left

    def _make_posterior(self, p: Doubles) -> Posterior:
        """Return the belief with an estimate: the mean of the hypotheses around the one with most weight near it."""
        now = self._now
        if not len(now.w):
            return Posterior(lost=self._lost, p=p)
        is_near = _compute_distances(now.at, now.at) <= self._scale.near
        there = is_near[(is_near @ now.w).argmax()]
        mass = float(now.w[there].sum())
        share = now.w[there] / mass
        (at,), (covariance,) = _mix_gaussians(share[None], now.at[there], now.covariance[there])
        north, east = (share @ now.heading[there]).tolist()
        heading_deg = math.degrees(math.atan2(east, north)) % 360 if math.hypot(north, east) > 0.5 else None
        return Posterior(lost=self._lost, p=p, mass=mass, at=at, covariance=covariance, heading_deg=heading_deg)


def _keep_unseen(now: _Hypotheses, moves: list[_Move], chance: float) -> _Hypotheses:
    """Return the hypotheses after their motion, if the query proposes none of them: `w` times this `chance`."""
    share = np.stack([move.share for move in moves], 1)[..., None]
    at = np.stack([move.at for move in moves], 1)
    covariance = np.stack([move.covariance for move in moves], 1)
    mean = (share * at).sum(1)
    off = at - mean[:, None]
    spread = (share[..., None] * (covariance + off[..., :, None] * off[..., None, :])).sum(1)
    return replace(now, w=chance * now.w, at=mean, covariance=spread)


def _compute_distances(one: Doubles, other: Doubles) -> Doubles:
    """Return the distance between each of `one` (M, 2) and each of `other` (K, 2): (M, K)."""
    return np.asarray(np.sqrt(((one[:, None] - other) ** 2).sum(2)))


def _compute_density(move: _Move, at: Doubles, covariance: Doubles, is_ordinal: bool) -> Doubles:
    """Return the density (M, K) at positions `at` (K, 2) with `covariance` (K, 2, 2), after M hypotheses have moved."""
    xx, xy, yy = (move.covariance[:, None, i, j] + covariance[None, :, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    dx, dy = (at[None, :, i] - move.at[:, None, i] for i in (0, 1))
    if is_ordinal:
        xy, yy, dy = np.zeros(()), np.full((), _UNIT_VARIANCE), np.zeros(())
    determinant = np.maximum(xx * yy - xy * xy, _MIN_VARIANCE_RATIO * xx * yy)
    squared = (yy * (dx * dx) - 2 * xy * (dx * dy) + xx * (dy * dy)) / determinant
    gaussian: Doubles = np.exp(-np.maximum(squared, 0) / 2) / (2 * np.pi * np.sqrt(determinant))
    return np.maximum(gaussian, move.least)


def _regularize(covariance: Doubles, least: float) -> Doubles:
    """Make covariances (K, 2, 2) invertible: add the variance `least`, and a small share of their own, to each axis."""
    more: Doubles = least + _MIN_VARIANCE_RATIO * np.abs(np.trace(covariance, axis1=1, axis2=2))
    return covariance + more[:, None, None] * np.eye(2)


def _fuse(one: Doubles, of_one: Doubles, other: Doubles, of_other: Doubles) -> tuple[Doubles, Doubles]:
    """Combine K positions and K others of related errors by covariance intersection (Julier and Uhlmann 1997)."""
    traces = [np.trace(each, axis1=1, axis2=2) for each in (of_one, of_other)]
    share = (traces[1] / (traces[0] + traces[1]))[:, None, None]
    by_one, by_other = share * np.linalg.inv(of_one), (1 - share) * np.linalg.inv(of_other)
    covariance = np.linalg.inv(by_one + by_other)
    at = covariance @ (by_one @ one[..., None] + by_other @ other[..., None])
    return at[..., 0], covariance


def _mix_gaussians(share: Doubles, at: Doubles, covariance: Doubles) -> tuple[Doubles, Doubles]:
    """Return the means (K, 2) and covariances (K, 2, 2) of K mixtures of M Gaussians with means `at` (M, 2) and
    `covariance` (M, 2, 2), weighted by `share` (K, M)."""
    middle = at.mean(0) if len(at) else np.zeros(2)  # coordinates far from zero would lose digits in their squares
    off = at - middle
    second = covariance + off[:, :, None] * off[:, None]
    mean = share @ off
    spread = (share @ second.reshape(-1, 4)).reshape(-1, 2, 2) - mean[:, :, None] * mean[:, None]
    return middle + mean, _regularize(spread, _ROUNDING * float(np.abs(second).max(initial=1)))


def _select_usable(proposed: Proposals, scale: MapScale) -> tuple[Ints, Proposals]:
    """Return the indices of the likeliest finite proposals, and these, made invertible and with a sum of 1 at most."""
    is_near = (np.abs(proposed.at) < _MAX_DISTANCE).all(1) & (np.abs(proposed.covariance) < _MAX_DISTANCE**2).all(
        (1, 2)
    )
    numbers = np.flatnonzero((proposed.p > 0) & (proposed.p < np.inf) & is_near)
    numbers = numbers[np.argsort(-proposed.p[numbers], kind="stable")[:_MAX_HYPOTHESES]]
    p = proposed.p[numbers]
    return numbers, Proposals(
        p=p / max(1.0, float(p.sum())),
        at=proposed.at[numbers],
        covariance=_regularize(proposed.covariance[numbers], (_MIN_SD * scale.spacing) ** 2),
        heading_deg=proposed.heading_deg[numbers],
    )
