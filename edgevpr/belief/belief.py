"""The belief where the aircraft is, followed from query to query: a Bayes filter over the places of a map.

The aircraft is lost (off the map, or on it where no query has seen it), or near one of at most `MOST` hypotheses, each a
Gaussian on the ground. Being lost is a state like any other: what the map does not explain, it explains.

A query is heard by its own probabilities, made with the prior that the aircraft is off the map as likely as on it, and
there anywhere. Divided by that prior they are likelihoods; a query without history is believed as it stands.

Queries that show the same ground are no new evidence. So each hypothesis remembers what was credited to it where it now
is, and hears from a query only what goes beyond that, or less than that. A hover changes nothing but the newest look.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.belief.hypotheses import Hypotheses, Way, apart, density, fused, joined, mean_of, none, sound
from edgevpr.belief.motion import Moved

MOST = 64  # hypotheses kept
PRIOR_LOST = 0.5  # the prior of the probabilities that are handed in

# Chances between two queries. Together they are also the most that a history can be believed: odds of 1 to their sum.
_LEAVES, _JUMPS, _ENTERS = 0.01, 0.01, 0.02
_MISSED = 0.2  # how likely a place is unseen by a query over it, against one over ground that is not in the map
_LEAST_REST = 1e-4  # of the probability that it is none of the candidates
_GOES_ON, _ODOMETRY = 0.75, 0.6  # shares of these ways to move; odometry comes before going on as before
_GOES_ON_SD, _ODOMETRY_SD, _LEAST_SD = 0.5, 0.25, 0.25  # in spacings of the map
_REACH_SD = 1.5  # standard deviations that the reach is
_LEARNS = 0.2  # share of the newest step in a velocity
_SCATTERS = 1.4  # standard deviations of a position: a step as short as that may be none
_FORGOTTEN = 1e-9  # a hypothesis of less weight
_LEAST = 1e-300  # instead of zero, where a number divides


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Measure of a map. `spacing` is the distance over which a picture becomes new evidence: about half a footprint, or
    1 for a map of places in order (`is_ordinal`), whose second coordinate is 0. Hypotheses within `near` are one
    position."""

    spacing: float
    near: float
    is_ordinal: bool = False

    @property
    def cell(self) -> float:
        """Ground of one place: an area, or a length where places are in order."""
        return self.spacing if self.is_ordinal else self.spacing**2


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """Positions that one query says by itself, K of them: `p` (K,) the probability of each, whose sum is below 1 by the
    probability of none; `at` (K, 2) where the aircraft then is, east and north of a fixed origin, or the number of the
    place and 0; its `covariance` (K, 2, 2); and `heading_deg` (K,), NaN where unknown."""

    p: np.ndarray
    at: np.ndarray
    covariance: np.ndarray
    heading_deg: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Position (2,) with its covariance (2, 2), and the heading (None: unknown)."""

    at: np.ndarray
    covariance: np.ndarray
    heading_deg: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Belief after a query: the probability to be `lost`; `p` (K,) of the candidates of the query; and the `mass` of
    all hypotheses near the `estimate` (None: there is no hypothesis)."""

    lost: float
    p: np.ndarray
    mass: float
    estimate: Estimate | None


class Belief:
    """The belief of one flight over one map, taken on with each query by `update`."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._lost, self._enters = 1.0, 1 - PRIOR_LOST
        self._now, self._strongest = none(), 0.0

    @property
    def nbytes(self) -> int:
        return self._now.nbytes

    def update(self, seen: Seen | None, moved: Moved, places: int) -> Posterior:
        """Take what a query has seen (None: its picture says nothing), and how the aircraft has moved since the query
        before; `places` is how many the map has now.

        Never raises for numbers that make no sense: a candidate that is not finite counts as not seen.
        """
        now, lost, appears = self._left()
        places = max(1, places)
        ways = self._ways(now, moved, places)
        p = np.zeros(0 if seen is None else len(seen.p))
        if seen is None:
            lost += appears  # nobody knows where
            after, heard = _unseen(now, ways, 1.0), np.zeros(0, int)
        else:
            self._enters = _ENTERS
            with np.errstate(invalid="ignore"):
                heard = np.flatnonzero((seen.p > 0) & np.isfinite(seen.p) & np.isfinite(seen.at).all(1))
            there = self._heard(_taken(seen, heard, self._ground), now, ways, moved.elapsed_s, appears, places)
            after = joined(there, _unseen(now, ways, _MISSED))
        share = after.w / (lost + float(after.w.sum()))
        p[heard] = share[: len(heard)]
        kept = np.argsort(-share, kind="stable")[:MOST]
        kept = kept[share[kept] > _FORGOTTEN]
        self._now = replace(after, w=share)[kept]
        self._lost = max(0.0, 1 - float(self._now.w.sum()))
        return self._posterior(p)

    def _left(self) -> tuple[Hypotheses, float, float]:
        """Return the hypotheses, and the probabilities to be lost and to have come anywhere on the map, after the time
        between two queries. What leaks away was credited no more."""
        held = float(self._now.w.sum())
        lost = (1 - self._enters) * self._lost + _LEAVES * held
        stays = 1 - _LEAVES - _JUMPS
        leaked = max(0.0, math.log(max(lost, _LEAST) / max(stays * self._lost, _LEAST)))
        self._strongest = max(0.0, self._strongest - leaked)
        credited = np.maximum(self._now.credited - leaked, 0)
        now = replace(self._now, w=stays * self._now.w, credited=credited)
        return now, lost, self._enters * self._lost + _JUMPS * held

    def _ways(self, now: Hypotheses, moved: Moved, places: int) -> list[Way]:
        """Return the ways in which each hypothesis can have moved: by odometry, on as before, or anywhere in reach."""
        ground, ways = self._ground, []
        area = places * ground.cell
        widest = area / 2 if ground.is_ordinal else math.sqrt(area / math.pi)
        is_everywhere = not moved.reach < widest
        reach = max(widest if is_everywhere else moved.reach, _LEAST_SD * ground.spacing)
        is_going = ~np.isnan(now.velocity[:, 0])
        ahead = np.where(is_going[:, None], now.velocity, 0) * moved.elapsed_s
        left, middle, sd = np.ones(len(now.w)), np.zeros(2), reach / _REACH_SD
        if moved.by is not None:
            spread = moved.covariance + (_ODOMETRY_SD * ground.spacing) ** 2 * np.eye(2)
            ways.append(Way(_ODOMETRY * left, now.at + moved.by, now.covariance + spread))
            # Odometry that is wrong by a factor of two is wrong by as much as its length.
            left, middle, sd = (1 - _ODOMETRY) * left, moved.by, min(sd, ground.spacing + math.hypot(*moved.by))
        variance = (_GOES_ON_SD * ground.spacing) ** 2 + (_GOES_ON_SD * np.hypot(*ahead.T)) ** 2 / 2
        going = now.covariance + variance[:, None, None] * np.eye(2)
        ways.append(Way(_GOES_ON * is_going * left, now.at + ahead, going))
        anywhere = now.covariance + sd**2 * np.eye(2)
        ways.append(Way((1 - _GOES_ON * is_going) * left, now.at + middle, anywhere, is_everywhere / area))
        return ways

    def _heard(
        self, seen: Seen, now: Hypotheses, ways: list[Way], elapsed_s: float, appears: float, places: int
    ) -> Hypotheses:
        """Return one hypothesis for each candidate of a query. Its weight has come from the hypotheses before, each by
        the ways that lead here, and from nowhere."""
        ground, at, of_step = self._ground, seen.at, seen.covariance
        rest = max(_LEAST_REST, 1 - float(seen.p.sum()))
        ratio = np.log(seen.p * places * PRIOR_LOST / ((1 - PRIOR_LOST) * rest))
        born = appears / places * np.exp(ratio)

        scatter = np.sqrt(of_step[:, 0, 0] if ground.is_ordinal else np.trace(of_step, axis1=1, axis2=2))
        fresh = np.clip((apart(now.anchor, at) - _SCATTERS * scatter) / ground.spacing, 0, 1)
        # A picture of the same ground says what the one before has said, to whoever was there: also to one who is lost.
        strongest = max(0.0, float(ratio.max(initial=0)))
        same, self._strongest = min(self._strongest, strongest), strongest
        evidence = np.exp(ratio + (1 - fresh) * (same - now.credited[:, None])) * (ground.cell * now.w[:, None])
        led = [way.share[:, None] * evidence * density(way, at, of_step, ground.is_ordinal) for way in ways]
        weight = sum(each.sum(0) for each in led)  # of what has come from hypotheses
        by = sum(led) / np.maximum(weight, _LEAST)
        stale = by * (1 - fresh)
        staleness = float(weight @ stale.sum(0)) / max(_LEAST, float((weight + born).sum()))

        before, of_before = mean_of(
            np.concatenate(led).T / np.maximum(weight, _LEAST)[:, None],
            np.concatenate([way.at for way in ways]),
            np.concatenate([way.covariance for way in ways]),
        )
        at_both, of_both = fused(at, of_step, before, of_before + (_LEAST_SD * ground.spacing) ** 2 * np.eye(2))
        learns = np.where(np.isnan(now.velocity[:, :1]), 1.0, _LEARNS)
        kept = (1 - learns) * np.nan_to_num(now.velocity) - learns * now.at / elapsed_s
        velocity = (by.T @ learns) * at / elapsed_s + by.T @ kept
        anchor = (1 - stale.sum(0))[:, None] * at + stale.T @ now.anchor
        is_led = weight > born
        return Hypotheses(
            w=math.exp(-staleness * same) * (weight + born),
            at=np.where(is_led[:, None], at_both, at),
            covariance=np.where(is_led[:, None, None], of_both, of_step),
            velocity=np.where(is_led[:, None], velocity, np.nan),
            heading=_vector(seen.heading_deg),
            credited=np.maximum(ratio, 0),
            anchor=np.where(is_led[:, None], anchor, at),
        )

    def _posterior(self, p: np.ndarray) -> Posterior:
        now = self._now
        if not len(now.w):
            return Posterior(lost=self._lost, p=p, mass=0.0, estimate=None)
        is_near = apart(now.at, now.at) <= self._ground.near
        there = is_near[(is_near @ now.w).argmax()]
        mass = float(now.w[there].sum())
        share = now.w[there] / mass
        (at,), (covariance,) = mean_of(share[None], now.at[there], now.covariance[there])
        north, east = (share @ now.heading[there]).tolist()
        is_known = math.hypot(north, east) > 0.5
        heading_deg = math.degrees(math.atan2(east, north)) % 360 if is_known else None
        estimate = Estimate(at=at, covariance=covariance, heading_deg=heading_deg)
        return Posterior(lost=self._lost, p=p, mass=mass, estimate=estimate)


def _unseen(now: Hypotheses, ways: list[Way], chance: float) -> Hypotheses:
    """Return the hypotheses after they have moved, where a query does not see them, which has this chance."""
    share = np.stack([way.share for way in ways], 1)[..., None]
    at = np.stack([way.at for way in ways], 1)
    covariance = np.stack([way.covariance for way in ways], 1)
    mean = (share * at).sum(1)
    off = at - mean[:, None]
    spread = (share[..., None] * (covariance + off[..., :, None] * off[..., None, :])).sum(1)
    return replace(now, w=chance * now.w, at=mean, covariance=spread)


def _taken(seen: Seen, heard: np.ndarray, ground: Ground) -> Seen:
    """Return the candidates `heard` of a query, with probabilities whose sum is at most 1."""
    p = seen.p[heard].astype(float)
    return Seen(
        p=p / max(1.0, float(p.sum())),
        at=seen.at[heard].astype(float),
        covariance=sound(seen.covariance[heard].astype(float), (_LEAST_SD * ground.spacing) ** 2),
        heading_deg=seen.heading_deg[heard],
    )


def _vector(heading_deg: np.ndarray) -> np.ndarray:
    heading = np.radians(heading_deg)
    return np.nan_to_num(np.stack([np.cos(heading), np.sin(heading)], 1), posinf=0.0, neginf=0.0)
