"""Belief where the aircraft is, updated from query to query by a Bayes filter over the places of a map (see `follow`).

The aircraft is *lost* (off the map, or on it where no query has recognised it), or near one of at most `MOST`
hypotheses. Each is a Gaussian position, in the units of the map's `MapScale`. Being lost has a probability of its own.

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
from edgevpr.runtime.recognise import hypotheses
from edgevpr.runtime.recognise.hypotheses import Hypotheses, MapScale, Proposals, Way, apart, mean_of

MOST = 64  # hypotheses kept
PRIOR_LOST = 0.5  # the prior with which the probabilities of a query are made

# Chances between two queries to leave the map, to be anywhere on it, and to enter it. The odds for a history are at
# most 1 to the sum of the first two.
_LEAVES, _JUMPS, _ENTERS = 0.01, 0.01, 0.02
_MISSED = 0.2  # how likely a query misses the place below it, relative to one over ground that is not in the map
_ALIKE = 0.1  # how likely ground outside the map, once taken for a place, resembles the next places as well
_LEAST_REST = 1e-4  # least probability that no candidate is right
_GOES_ON, _ODOMETRY = 0.75, 0.6  # probabilities of going on as before, and of moving by odometry, which comes first
_GOES_ON_SD, _ODOMETRY_SD = 0.5, 0.25  # standard deviations of these ways, in spacings of the map
_REACH_SD = 1.5  # the reach in standard deviations
_LEARNS = 0.2  # weight of the newest displacement in the mean velocity
_SCATTERS = 2.0  # standard deviations of a position: a shorter displacement may be none
_FORGOTTEN = 1e-9  # a hypothesis of less weight is dropped
_MOSTLY = 0.5  # a larger share is most of it
_LEAST = 1e-300  # instead of zero, where a number divides
_OF_LENGTH_SD = 0.15  # standard deviation of a credible displacement by odometry, as a share of its length
_LONGEST_S = 3600.0  # longest time that counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Motion of the aircraft since the previous query. `reach` is how far it can have moved, in the unit of the map
    (metres, or places), in `elapsed_s` seconds. `by` (2,) is its displacement by odometry (None: unknown), with the
    `covariance` (2, 2), in the same unit."""

    reach: float
    elapsed_s: float
    by: Doubles | None = None
    covariance: Doubles = field(default_factory=lambda: np.zeros((2, 2)))


@dataclass(frozen=True, slots=True)
class PlaneEstimate:
    """Position `at` (2,) in the plane of the map, its `covariance` (2, 2), and the heading (degrees, None: unknown)."""

    at: Doubles
    covariance: Doubles
    heading_deg: float | None


@dataclass(frozen=True, slots=True)
class Posterior:
    """Belief after a query: the probability of being `lost`, the probability `p` (K,) of each candidate of the query,
    and the `estimate` of the position (None: no hypothesis). `mass` is the probability of all hypotheses near it."""

    lost: float
    p: Doubles
    mass: float
    estimate: PlaneEstimate | None


def moved(
    elapsed_s: float | None, usual_s: float, speed_max: float, velocity: tuple[float, float] | None = None
) -> Moved:
    """Return the motion in `elapsed_s` seconds; `usual_s` is taken if they are unknown (None) or not above 0, because
    the clock stood still or was set back. `speed_max` is the highest speed, in units of the map a second, and
    `velocity` (east, north) that of odometry (None: unknown), which is not used without a time or if it is too high to
    be true."""
    if elapsed_s is None or not elapsed_s > 0:
        return Moved(reach=speed_max * usual_s, elapsed_s=usual_s)
    elapsed_s = min(elapsed_s, _LONGEST_S)
    reach = speed_max * elapsed_s
    if velocity is None or not math.hypot(*velocity) <= 2 * speed_max:  # NaN, or too fast even if it is twice the truth
        return Moved(reach=reach, elapsed_s=elapsed_s)
    by = elapsed_s * np.asarray(velocity, float)
    return Moved(reach=reach, elapsed_s=elapsed_s, by=by, covariance=(_OF_LENGTH_SD**2 * by @ by) * np.eye(2))


class Belief:
    """Belief of one flight over one map. It begins as lost; `update` is called once for each query."""

    def __init__(self, scale: MapScale) -> None:
        self._scale = scale
        self._lost, self._enters = 1.0, 1 - PRIOR_LOST
        self._now, self._strongest = hypotheses.NOWHERE, 0.0

    def update(self, proposed: Proposals | None, moved: Moved, places: int) -> Posterior:
        """Update the belief with the candidates that a query proposes (None: its picture shows too little), the motion
        since the previous query, and the number of places in the map now.

        Never raises for invalid numbers: a candidate that is not finite counts as not proposed.
        """
        odds = (1 - self._lost) / max(self._lost, _FORGOTTEN)
        now, lost, appears = self._left()
        places = max(1, places)
        ways = self._ways(now, moved, places)
        p = np.zeros(0 if proposed is None else len(proposed.p))
        numbers: Ints = np.zeros(0, int)
        if proposed is None:
            lost += appears  # whoever enters the map now is at an unknown place
            after = _unseen(now, ways, 1.0)
        else:
            self._enters = _ENTERS
            numbers, proposed = hypotheses.usable(proposed, self._scale, MOST)
            there, alike, staleness, left = self._credit(proposed, now, ways, moved.elapsed_s, appears, places)
            lost *= alike
            unseen = _unseen(now, ways, _MISSED)
            # A lost aircraft that sees the same ground again has not moved either, so staying is no evidence for it.
            kept = (left * odds * lost - float(unseen.w.sum())) / max(float(there.w.sum()), _FORGOTTEN)
            after = hypotheses.joined(replace(there, w=there.w * max(1.0, kept) ** staleness), unseen)
        share = after.w / (lost + float(after.w.sum()))
        p[numbers] = share[: len(numbers)]
        strongest = np.argsort(-share, kind="stable")[:MOST]
        self._now = replace(after, w=share)[strongest[share[strongest] > _FORGOTTEN]]
        self._lost = max(0.0, 1 - float(self._now.w.sum()))
        return self._posterior(p)

    def _left(self) -> tuple[Hypotheses, float, float]:
        """Apply the chances of leaving, entering and jumping between two queries. Returns

        * the hypotheses, with less weight; the evidence credited to them shrinks as being lost becomes more probable,
        * the probability of being lost,
        * the probability of having appeared anywhere on the map.
        """
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
        """Weigh the candidates by the hypotheses that can have moved to them. `appears` is the probability of having
        appeared anywhere, and `places` the size of the map. Returns

        * one hypothesis for each candidate,
        * the likelihood of the query if lost, relative to that on ground that never resembles the map,
        * the share (0..1) of the weight that comes from pictures of the same ground as the query before,
        * the factor, 1 at most, by which the odds of not being lost shrink if this query is weaker evidence there.
        """
        scale, at, of_step = self._scale, proposed.at, proposed.covariance
        rest = max(_LEAST_REST, 1 - float(proposed.p.sum()))
        ratio = np.log(np.maximum(proposed.p, _LEAST) * places * PRIOR_LOST / ((1 - PRIOR_LOST) * rest))
        born = appears / places * np.exp(ratio)

        # A picture of the same ground repeats the evidence of the one before. This holds for a lost aircraft as well.
        strongest, before = max(0.0, float(ratio.max(initial=0))), self._strongest
        same, self._strongest = min(before, strongest), strongest
        scatter = np.sqrt(of_step[:, 0, 0] if scale.is_ordinal else np.trace(of_step, axis1=1, axis2=2) / 2)
        fresh = np.clip((apart(now.anchor, at) - _SCATTERS * scatter) / scale.spacing, 0, 1)
        evidence = np.exp(ratio + (1 - fresh) * (same - now.credited[:, None])) * (scale.cell * now.w[:, None])
        led = [way.share[:, None] * evidence * hypotheses.density(way, at, of_step, scale.is_ordinal) for way in ways]
        weight = sum(each.sum(0) for each in led)  # of the hypotheses that lead to each candidate
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
        at_both, of_both = hypotheses.fused(at, of_step, at_before, of_before)
        learns = np.where(np.isnan(now.velocity[:, :1]), 1.0, _LEARNS)
        kept = (1 - learns) * np.nan_to_num(now.velocity) - learns * now.at / elapsed_s
        velocity = (by.T @ learns) * at / elapsed_s + by.T @ kept
        anchor = (1 - stale.sum(0))[:, None] * at + stale.T @ now.anchor
        is_led, heading = (weight > born)[:, None], np.radians(proposed.heading_deg)
        there = Hypotheses(
            w=math.exp(-staleness * same) * (weight + born),
            at=np.where(is_led, at_both, at),
            covariance=np.where(is_led[..., None], of_both, of_step),
            velocity=np.where(is_led, velocity, np.nan),
            heading=np.nan_to_num(np.stack([np.cos(heading), np.sin(heading)], 1)),
            credited=np.maximum(ratio, 0),
            anchor=np.where(is_led, anchor, at),
        )
        return there, alike, staleness, left

    def _posterior(self, p: Doubles) -> Posterior:
        """Return the belief with an estimate: the mean of the hypotheses around the one with most weight near it."""
        now = self._now
        if not len(now.w):
            return Posterior(self._lost, p, 0.0, None)
        is_near = apart(now.at, now.at) <= self._scale.near
        there = is_near[(is_near @ now.w).argmax()]
        mass = float(now.w[there].sum())
        share = now.w[there] / mass
        (at,), (covariance,) = mean_of(share[None], now.at[there], now.covariance[there])
        north, east = (share @ now.heading[there]).tolist()
        heading_deg = math.degrees(math.atan2(east, north)) % 360 if math.hypot(north, east) > 0.5 else None
        return Posterior(self._lost, p, mass, PlaneEstimate(at, covariance, heading_deg))


def _unseen(now: Hypotheses, ways: list[Way], chance: float) -> Hypotheses:
    """Return the hypotheses after their motion, if the query sees none of them, which has the probability `chance`."""
    share = np.stack([way.share for way in ways], 1)[..., None]
    at = np.stack([way.at for way in ways], 1)
    covariance = np.stack([way.covariance for way in ways], 1)
    mean = (share * at).sum(1)
    off = at - mean[:, None]
    spread = (share[..., None] * (covariance + off[..., :, None] * off[..., None, :])).sum(1)
    return replace(now, w=chance * now.w, at=mean, covariance=spread)
