"""Following a flight from query to query: what one query says of itself is handed to a belief (see `belief`).

The best place of a query has its confidence. What is left of the probability that it shows ground of the map at all is
spread over the other places it was compared with.
"""

import copy
import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Covariance, Doubles, Ints
from edgevpr.core.geodesy import moved as moved_by
from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Frame, Position, Vehicle
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking
from edgevpr.runtime.recognise.belief import Belief, Moved, PlaneEstimate, moved
from edgevpr.runtime.recognise.confidence import Evidence
from edgevpr.runtime.recognise.evidence import votes_of
from edgevpr.runtime.recognise.hypotheses import MapScale, Proposals
from edgevpr.runtime.recognise.judge import Sureness
from edgevpr.runtime.recognise.locate import Located, matrix_of

# Chosen on corridor, aerial_caliterra and aerial_garfield28.
_SHARPNESS = 10.0  # of two places, how much more likely is the one with more votes: the power of the ratio
_OTHERS = 0.7  # of what the best place leaves: so often the right one is among the others
_PROPOSED = 20  # places of one query
_NEAR_PLACES, _NEAR_FOOTPRINT, _HALF = 3.0, 0.25, 0.5
_PLACES_A_QUERY = 3.0  # at most, where nothing is known of the time or of the ground
_FASTEST_M_S = 30.0  # unless the configuration says another speed
_LEAST_SPACING_M = 5.0


@dataclass(frozen=True, slots=True)
class FollowedPosition:
    """Position of the aircraft by the flight so far, with `covariance_m2` (variance east, covariance, variance north),
    and the heading of the top of its pictures (None: unknown)."""

    position: Position
    covariance_m2: Covariance
    heading_deg: float | None

    @property
    def sd_m(self) -> float:
        """Standard deviation of one axis."""
        return math.sqrt((self.covariance_m2[0] + self.covariance_m2[2]) / 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """Outcome of a query with the flight so far: the `slot` of the place that is likeliest now, and the probability
    `confidence` that the aircraft is there (0 and None without any). `lost` is the probability that it is nowhere the
    flight knows of, and `mass` that of the `estimate` (None: there is none, or the map has no positions)."""

    slot: int | None
    confidence: float
    lost: float
    mass: float
    estimate: FollowedPosition | None

    def leads_from(self, slot: int) -> bool:
        """Tell whether another place than this one is more likely than not."""
        return self.slot is not None and self.slot != slot and self.confidence > _HALF


class _Survey:
    """The ground of a map as it is when it has so many `places`: its `scale`, the `origin` of positions on it (None:
    they are numbers of places, in order), and the standard deviation of a place without a pose."""

    def __init__(self, place_map: PlaceMap, index: PlaceIndex) -> None:
        known = ~np.isnan(index.lat_deg)
        self.places, self.origin = len(index), None
        self.scale, self.spread = MapScale(spacing=1.0, near=_NEAR_PLACES, is_ordinal=True), 1.0
        if known.mean() > _HALF:
            first = int(np.flatnonzero(known)[0])
            self.origin = Position(float(index.lat_deg[first]), float(index.lon_deg[first]))
            spacing_m, footprint_m = index.spacing_m() or 0.0, place_map.footprint_m()
            self.spread = max(_LEAST_SPACING_M, spacing_m)
            near_m = _NEAR_FOOTPRINT * footprint_m if footprint_m else self.spread
            self.scale = MapScale(
                spacing=max(_LEAST_SPACING_M, footprint_m / 2 if footprint_m else spacing_m),
                near=max(_LEAST_SPACING_M, near_m),
            )

    def is_outdated(self, index: PlaceIndex) -> bool:
        """Tell whether to measure again: the places have got positions, or have become twice as many. The first few
        places say little of how far apart the others are."""
        is_measured = self.origin is not None and len(index) < 2 * self.places
        return not is_measured and bool((~np.isnan(index.lat_deg)).mean() > _HALF)

    def positions(self, slots: Ints, index: PlaceIndex) -> Doubles:
        """Return where places are, as the belief has it: float (K, 2), NaN where unknown."""
        if self.origin is None:
            return np.stack([index.place_ids[slots].astype(float), np.zeros(len(slots))], 1)
        lat_deg, lon_deg = index.lat_deg[slots], index.lon_deg[slots]
        return np.stack(offset_m(self.origin.lat_deg, self.origin.lon_deg, lat_deg, lon_deg), 1).astype(float)


class Follower:
    """Follows one flight over one map: `went_on` for each frame, then `heard` for each look of it, and `settle` keeps
    what the last look has led to.

    `fastest_m_s` is the highest speed of the aircraft (None: unknown). `is_live` is False for frames of a recording,
    whose times are those of their own clock.
    """

    def __init__(self, place_map: PlaceMap, *, fastest_m_s: float | None, is_live: bool) -> None:
        self._map, self._fastest_m_s, self._is_live = place_map, fastest_m_s or _FASTEST_M_S, is_live
        self._survey: _Survey | None = None  # of the map, once it has a place
        self._belief: Belief | None = None
        self._next: Belief | None = None  # that nobody has settled yet
        self._arrived: tuple[Doubles, float] | None = None  # where the newest ground began, and how sure that was
        self._arriving: tuple[Doubles, float] | None = None
        self._t_now_s: float | None = None
        self._t_settled_s: float | None = None
        self._elapsed_s: float | None = None
        self._velocity_m_s: tuple[float, float] | None = None

    def went_on(self, frame: Frame, vehicle: Vehicle | None) -> None:
        """Take note of the time that has passed since the last look that was kept, and of the velocity of the aircraft,
        if they are known."""
        now_s = frame.t_mono_s if self._is_live else frame.t_utc_s
        before_s, self._t_now_s = self._t_settled_s, now_s
        self._elapsed_s = None if before_s is None or now_s is None else now_s - before_s
        is_fresh = self._is_live and vehicle is not None and vehicle.is_fresh_at(frame.t_mono_s)
        self._velocity_m_s = vehicle.velocity_m_s if vehicle and is_fresh else None

    def heard(
        self, ranking: Ranking, index: PlaceIndex, evidence: Evidence, sure: Sureness, where: Located | None
    ) -> Followed:
        """Return what becomes of the belief with the places of a look, of which the best has this `evidence` and says
        that the aircraft is at `where` (None: at the place)."""
        if self._survey is None or self._belief is None or self._survey.is_outdated(index):
            self._survey = _Survey(self._map, index)
            self._belief = Belief(self._survey.scale)
        survey, near = self._survey, self._survey.scale.near
        slots, proposed = _proposals(ranking, index, survey, sure, evidence, where)
        self._next = copy.copy(self._belief)
        posterior = self._next.update(proposed, self._moved(survey), len(index))
        slot, confidence = None, 0.0
        if len(slots) and posterior.p.max() > 0:
            best = int(posterior.p.argmax())
            slot, at = int(slots[best]), proposed.at[best]
            is_near = np.hypot(*(proposed.at - at).T) <= near
            confidence = float(posterior.p[is_near].sum())
            off = np.hypot(*(posterior.estimate.at - at)) if posterior.estimate else np.inf
            if confidence > _HALF and off <= near:
                confidence = max(confidence, posterior.mass)  # with what the look does not see, and knows to be here
            confidence = self._not_by_repetition(at, confidence, float(proposed.p[is_near].sum()))
        return Followed(
            slot=slot,
            confidence=confidence,
            lost=posterior.lost,
            mass=posterior.mass,
            estimate=_on_earth(posterior.estimate, survey.origin),
        )

    def saw_nothing(self, index: PlaceIndex) -> None:
        """Take note of a picture that says nothing: nobody knows whether it shows ground of the map."""
        if self._survey and self._belief:
            self._next = copy.copy(self._belief)
            self._next.update(None, self._moved(self._survey), len(index))
            self.settle()

    def settle(self) -> None:
        """Believe what the last look has led to; nothing changes where nothing was heard."""
        self._belief, self._next = self._next or self._belief, None
        self._arrived, self._t_settled_s = self._arriving, self._t_now_s

    def _moved(self, survey: _Survey) -> Moved:
        if survey.scale.is_ordinal or self._elapsed_s is None:
            return moved(None, 1.0, _PLACES_A_QUERY * survey.scale.spacing)
        return moved(self._elapsed_s, 1.0, self._fastest_m_s, self._velocity_m_s)

    def _not_by_repetition(self, at: Doubles, confidence: float, by_itself: float) -> float:
        """Return a confidence that does not rise while the pictures show the same ground: it is that of the first one
        there, or that of the newest look by itself."""
        arrived = self._arrived
        if arrived is None or self._survey is None or np.hypot(*(at - arrived[0])) >= self._survey.scale.spacing:
            self._arriving = at, confidence
            return confidence
        self._arriving = arrived
        return min(confidence, max(arrived[1], by_itself))


def _on_earth(estimate: PlaneEstimate | None, origin: Position | None) -> FollowedPosition | None:
    if estimate is None or origin is None:
        return None
    lat_deg, lon_deg = moved_by(origin.lat_deg, origin.lon_deg, *estimate.at.tolist())
    (var_east, cov), (_, var_north) = estimate.covariance.tolist()
    return FollowedPosition(Position(lat_deg, lon_deg), (var_east, cov, var_north), estimate.heading_deg)


def _proposals(
    ranking: Ranking, index: PlaceIndex, survey: _Survey, sure: Sureness, evidence: Evidence, where: Located | None
) -> tuple[Ints, Proposals]:
    """Return the slots of the places that a look proposes, int (K,), and what it says of them."""
    slots: Ints = np.array(ranking.compared_slots[:_PROPOSED])
    at = survey.positions(slots, index)
    covariance = np.tile((1.0 if survey.origin is None else survey.spread**2) * np.eye(2), (len(slots), 1, 1))
    heading_deg = np.full(len(slots), np.nan)
    same = np.zeros(len(slots), bool)
    if where and survey.origin:
        here, there = survey.origin, where.position
        at[0] = offset_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg)
        covariance[0] = matrix_of(where.covariance_m2)
        heading_deg[0] = np.nan if where.heading_deg is None else where.heading_deg
        same = np.isin(index.place_ids[slots], where.places) & (slots != slots[0])
    votes = np.array([votes_of(ranking.compared[slot]) for slot in slots.tolist()])
    near = np.hypot(*(at - at[0]).T) <= survey.scale.near
    near[0] = True  # also where nobody knows its position
    confidence = sure.confidence(evidence)
    left = max(0.0, sure.of_map(evidence) - confidence)
    p = np.zeros(len(slots))
    p[near & ~same] = confidence * _shares(votes[near & ~same])
    p[~near & ~same] = _OTHERS * left * _shares(votes[~near & ~same])
    # What speaks for a place without position speaks for no other.
    is_placed = ~np.isnan(at[:, 0]) & ~same
    return slots[is_placed], Proposals(
        p=p[is_placed], at=at[is_placed], covariance=covariance[is_placed], heading_deg=heading_deg[is_placed]
    )


def _shares(votes: Doubles) -> Doubles:
    """Return how probability is shared between places with these votes."""
    if not len(votes):
        return votes
    weight: Doubles = (np.maximum(votes, 1e-6) / max(float(votes.max()), 1e-6)) ** _SHARPNESS
    return np.asarray(weight / weight.sum())
