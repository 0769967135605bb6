"""Belief where the aircraft is, followed from query to query: a Bayes filter over the places of a map.

The aircraft is lost (off the map, or on it where no query has seen it), or near one of at most `MOST` hypotheses, each
a Gaussian on the scale. Being lost is a state like any other, and explains what the map does not.

A query is heard by its own probabilities. Divided by the prior they were made with they are likelihoods, so a query
without history is believed as it stands. Three things keep a history from being believed too much:

* Between two queries the aircraft may have left the map or be anywhere, so the newest query must always speak for it.
* Pictures of the same ground are no new evidence. A hypothesis remembers what it was credited with on the ground where
  it now is, and another look replaces that. During a hover only the newest look counts.
* Ground that is not in the map, once it was taken for a place, may well look like the way on from there. So a place
  that fits the history speaks for the map only by so much.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.runtime.recognise.hypotheses import (
    Hypotheses,
    MapScale,
    Proposals,
    Way,
    apart,
    density,
    fused,
    joined,
    mean_of,
    no_hypotheses,
    usable,
)  # fmt: skip

MOST = 64  # hypotheses kept
PRIOR_LOST = 0.5  # of the probabilities that are handed in

# Chances between two queries. The first two are also the most that a history can be believed: odds of 1 to their sum.
_LEAVES, _JUMPS, _ENTERS = 0.01, 0.01, 0.02
_MISSED = 0.2  # how likely a place is unseen by a query over it, against one over ground that is not in the map
_ALIKE = 0.1  # how likely ground that is not in the map, once taken for a place, looks like the way on from there
_LEAST_REST = 1e-4  # of the probability that it is none of the candidates
_GOES_ON, _ODOMETRY = 0.75, 0.6  # shares of these ways to move; odometry comes before going on as before
_GOES_ON_SD, _ODOMETRY_SD = 0.5, 0.25  # in spacings of the map
_REACH_SD = 1.5  # standard deviations that the reach is
_LEARNS = 0.2  # share of the newest step in a velocity
_SCATTERS = 2.0  # standard deviations of a position: a step as short as that may be none
_FORGOTTEN = 1e-9  # a hypothesis of less weight
_MOSTLY = 0.5  # of a share
_LEAST = 1e-300  # instead of zero, where a number divides
_OF_LENGTH_SD = 0.15  # of the length of a displacement by odometry that can be believed
_LONGEST_S = 3600.0  # after which an aircraft may be anywhere


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Knowledge of how an aircraft has moved since the query before. `reach` is how far it can have moved, in the unit
    of the map (metres, or places), and `elapsed_s` the time it had. `by` (2,) is the displacement by odometry, with its
    `covariance` (2, 2); None: there is none."""

    reach: float
    elapsed_s: float
    by: Doubles | None = None
    covariance: Doubles = field(default_factory=lambda: np.zeros((2, 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneEstimate:
    """Position (2,) in the plane of the map with its covariance (2, 2), and the heading (None: unknown)."""

    at: Doubles
    covariance: Doubles
    heading_deg: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Belief after a query: the probability to be `lost`; `p` (K,) of the candidates of the query; and the `mass` of
    all hypotheses near the `estimate` (None: there is no hypothesis)."""

    lost: float
    p: Doubles
    mass: float
    estimate: PlaneEstimate | None


def moved(
    elapsed_s: float | None, usual_s: float, speed_max: float, velocity: tuple[float, float] | None = None
) -> Moved:
    """Return what is known of the motion in `elapsed_s` seconds (None: unknown), usually `usual_s`.

    `speed_max` is the highest speed, in units of the map a second, and `velocity` (east, north) that of odometry (None:
    unknown). A clock that has gone back, or stood still, says nothing of the time; then odometry says nothing of the
    way.
    """
    if elapsed_s is None or not elapsed_s > 0:
        return Moved(reach=speed_max * usual_s, elapsed_s=usual_s)
    elapsed_s = min(elapsed_s, _LONGEST_S)
    reach = speed_max * elapsed_s
    if velocity is None or not math.hypot(*velocity) <= 2 * speed_max:  # NaN, or too fast even if it is twice the truth
        return Moved(reach=reach, elapsed_s=elapsed_s)
    by = elapsed_s * np.asarray(velocity, float)
    return Moved(reach=reach, elapsed_s=elapsed_s, by=by, covariance=(_OF_LENGTH_SD**2 * by @ by) * np.eye(2))


class Belief:
    """The belief of one flight over one map, taken on with each query by `update`."""

    def __init__(self, scale: MapScale) -> None:
        self._scale = scale
        self._lost, self._enters = 1.0, 1 - PRIOR_LOST
        self._now, self._strongest = no_hypotheses(), 0.0

    def update(self, proposed: Proposals | None, moved: Moved, places: int) -> Posterior:
        """Take what a query has seen (None: its picture says nothing), and how the aircraft has moved since the query
        before; `places` is how many the map has now.

        Never raises for numbers that make no sense: a candidate that is not finite counts as not proposed.
        """
        odds = (1 - self._lost) / max(self._lost, _FORGOTTEN)
        now, lost, appears = self._left()
        places = max(1, places)
        ways = self._ways(now, moved, places)
        p = np.zeros(0 if proposed is None else len(proposed.p))
        numbers: Ints = np.zeros(0, int)
        if proposed is None:
            lost += appears  # nobody knows where
            after = _unseen(now, ways, 1.0)
        else:
            self._enters = _ENTERS
            numbers, proposed = usable(proposed, self._scale, MOST)
            there, alike, staleness, left = self._credit(proposed, now, ways, moved.elapsed_s, appears, places)
            lost *= alike
            unseen = _unseen(now, ways, _MISSED)
            # One who is lost and sees the same again has not moved on either, so staying here is no evidence for it.
            kept = (left * odds * lost - float(unseen.w.sum())) / max(float(there.w.sum()), _FORGOTTEN)
            after = joined(replace(there, w=there.w * max(1.0, kept) ** staleness), unseen)
        share = after.w / (lost + float(after.w.sum()))
        p[numbers] = share[: len(numbers)]
        strongest = np.argsort(-share, kind="stable")[:MOST]
        self._now = replace(after, w=share)[strongest[share[strongest] > _FORGOTTEN]]
        self._lost = max(0.0, 1 - float(self._now.w.sum()))
        return self._posterior(p)

    def _left(self) -> tuple[Hypotheses, float, float]:
        """Return the hypotheses, and the probabilities to be lost and to have come anywhere on the map, after the time
        between two queries. What leaks away is credited no more."""
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
        scale, ways = self._scale, []
        area = places * scale.cell
        widest = area / 2 if scale.is_ordinal else math.sqrt(area / math.pi)
        is_everywhere = not moved.reach < widest
        reach = widest if is_everywhere else moved.reach
        is_going = ~np.isnan(now.velocity[:, 0])
        ahead = np.where(is_going[:, None], now.velocity, 0) * moved.elapsed_s
        ahead *= (moved.reach / np.maximum(np.hypot(*ahead.T), max(moved.reach, _LEAST)))[:, None]
        left, middle, sd = np.ones(len(now.w)), np.zeros(2), max(reach / _REACH_SD, _GOES_ON_SD * scale.spacing)
        if moved.by is not None:
            spread = moved.covariance + (_ODOMETRY_SD * scale.spacing) ** 2 * np.eye(2)
            ways.append(Way(_ODOMETRY * left, now.at + moved.by, now.covariance + spread))
            # Odometry that is wrong by a factor of two is wrong by as much as its length.
            left, middle, sd = (1 - _ODOMETRY) * left, moved.by, min(sd, scale.spacing + math.hypot(*moved.by))
        variance = (_GOES_ON_SD * scale.spacing) ** 2 + (_GOES_ON_SD * np.hypot(*ahead.T)) ** 2 / 2
        going = now.covariance + variance[:, None, None] * np.eye(2)
        ways.append(Way(_GOES_ON * is_going * left, now.at + ahead, going))
        anywhere = now.covariance + sd**2 * np.eye(2)
        ways.append(Way((1 - _GOES_ON * is_going) * left, now.at + middle, anywhere, is_everywhere / area))
        return ways

    def _credit(
        self, proposed: Proposals, now: Hypotheses, ways: list[Way], elapsed_s: float, appears: float, places: int
    ) -> tuple[Hypotheses, float, float, float]:
        """Return one hypothesis for each candidate of a query, whose weight has come from the hypotheses before, each
        by the ways that lead here, and from nowhere; how much likelier one who is lost sees the query than if
        nothing out there were like the map; how far the query shows the same ground as the one before (0..1), and what
        is then left of the odds: 1 at most, less where this look says less."""
        scale, at, of_step = self._scale, proposed.at, proposed.covariance
        rest = max(_LEAST_REST, 1 - float(proposed.p.sum()))
        ratio = np.log(np.maximum(proposed.p, _LEAST) * places * PRIOR_LOST / ((1 - PRIOR_LOST) * rest))
        born = appears / places * np.exp(ratio)

        # A picture of the same ground says what the one before has said, to whoever was there: also to one who is lost.
        strongest, before = max(0.0, float(ratio.max(initial=0))), self._strongest
        same, self._strongest = min(before, strongest), strongest
        scatter = np.sqrt(of_step[:, 0, 0] if scale.is_ordinal else np.trace(of_step, axis1=1, axis2=2) / 2)
        fresh = np.clip((apart(now.anchor, at) - _SCATTERS * scatter) / scale.spacing, 0, 1)
        evidence = np.exp(ratio + (1 - fresh) * (same - now.credited[:, None])) * (scale.cell * now.w[:, None])
        led = [way.share[:, None] * evidence * density(way, at, of_step, scale.is_ordinal) for way in ways]
        weight = sum(each.sum(0) for each in led)  # of what has come from hypotheses
        by = sum(led) / np.maximum(weight, _LEAST)
        stale = by * (1 - fresh)
        staleness = float(weight @ stale.sum(0)) / max(_LEAST, float((weight + born).sum()))
        newest = float(ratio[stale.sum(0) > _MOSTLY].max(initial=-math.inf))
        left = math.exp(min(0.0, newest - before))
        agreement = float(weight.sum()) * rest / max(_LEAST, float(now.w.sum() * proposed.p.sum()))
        alike = (1 - _ALIKE + _ALIKE * agreement) ** (1 - staleness) if len(now.w) else 1.0

        at_before, of_before = mean_of(
            np.concatenate(led).T / np.maximum(weight, _LEAST)[:, None],
            np.concatenate([way.at for way in ways]),
            np.concatenate([way.covariance for way in ways]),
        )
        at_both, of_both = fused(at, of_step, at_before, of_before)
        learns = np.where(np.isnan(now.velocity[:, :1]), 1.0, _LEARNS)
        kept = (1 - learns) * np.nan_to_num(now.velocity) - learns * now.at / elapsed_s
        velocity = (by.T @ learns) * at / elapsed_s + by.T @ kept
        anchor = (1 - stale.sum(0))[:, None] * at + stale.T @ now.anchor
        is_led = (weight > born)[:, None]
        there = Hypotheses(
            w=math.exp(-staleness * same) * (weight + born),
            at=np.where(is_led, at_both, at),
            covariance=np.where(is_led[..., None], of_both, of_step),
            velocity=np.where(is_led, velocity, np.nan),
            heading=_vector(proposed.heading_deg),
            credited=np.maximum(ratio, 0),
            anchor=np.where(is_led, anchor, at),
        )
        return there, alike, staleness, left

    def _posterior(self, p: Doubles) -> Posterior:
        now = self._now
        if not len(now.w):
            return Posterior(lost=self._lost, p=p, mass=0.0, estimate=None)
        is_near = apart(now.at, now.at) <= self._scale.near
        there = is_near[(is_near @ now.w).argmax()]
        mass = float(now.w[there].sum())
        share = now.w[there] / mass
        (at,), (covariance,) = mean_of(share[None], now.at[there], now.covariance[there])
        north, east = (share @ now.heading[there]).tolist()
        is_known = math.hypot(north, east) > 0.5
        heading_deg = math.degrees(math.atan2(east, north)) % 360 if is_known else None
        estimate = PlaneEstimate(at=at, covariance=covariance, heading_deg=heading_deg)
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


def _vector(heading_deg: Doubles) -> Doubles:
    heading = np.radians(heading_deg)
    return np.asarray(np.nan_to_num(np.stack([np.cos(heading), np.sin(heading)], 1)))
