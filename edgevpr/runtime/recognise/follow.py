"""Following a flight from query to query: what one query says of itself is handed to a belief (see `belief`).

The best place of a query has its confidence. What is left of the probability that it shows ground of the map at all is
spread over the other places it was compared with.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from edgevpr.core.contract import FineMatch
from edgevpr.core.geodesy import moved as moved_by
from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Frame, Position, Vehicle
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking
from edgevpr.runtime.recognise.belief import Belief, Posterior
from edgevpr.runtime.recognise.judge import Sureness
from edgevpr.runtime.recognise.locate import Located, matrix_of
from edgevpr.runtime.recognise.motion import Moved, moved
from edgevpr.runtime.recognise.seen import Ground, Seen

# Chosen on corridor, aerial_caliterra and aerial_garfield28.
_SHARPNESS = 10.0  # of two places, how much more likely is the one with more votes: the power of the ratio
_OTHERS = 0.7  # of what the best place leaves: so often the right one is among the others
_HEARD = 20  # places of one query
_NEAR_PLACES, _NEAR_FOOTPRINT, _HALF = 3.0, 0.25, 0.5
_PLACES_A_QUERY = 3.0  # at most, where nothing is known of the time or of the ground
_FASTEST_M_S = 30.0  # unless the configuration says another speed
_LEAST_SPACING_M = 5.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """Position of the aircraft by the flight so far, with `covariance_m2` (variance east, covariance, variance north),
    and the heading of the top of its pictures (None: unknown)."""

    position: Position
    covariance_m2: tuple[float, float, float]
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
    estimate: Estimate | None

    def leads_from(self, slot: int) -> bool:
        """Tell whether another place than this one is more likely than not."""
        return self.slot is not None and self.slot != slot and self.confidence > _HALF


class NoFollower:
    """Stands in for a `Follower` where each query is taken by itself."""

    def heard(
        self, ranking: Ranking, index: PlaceIndex, evidence: Mapping[str, float], sure: Sureness, where: Located | None
    ) -> None:
        """Return None: nothing is known of the flight so far."""

    def went_on(self, frame: Frame, vehicle: Vehicle | None) -> None:
        """Take no note of the time."""

    def saw_nothing(self, index: PlaceIndex) -> None:
        """Take no note of a picture that says nothing."""

    def settle(self) -> None:
        """Keep nothing."""


class Follower:
    """Follows one flight over one map: `went_on` for each frame, then `heard` for each look of it, and `settle` keeps
    what the last look has led to.

    `fastest_m_s` is the highest speed of the aircraft (None: unknown). `is_live` is False for frames of a recording,
    whose times are those of their own clock.
    """

    def __init__(self, place_map: PlaceMap, *, fastest_m_s: float | None, is_live: bool) -> None:
        self._map, self._fastest_m_s, self._is_live = place_map, fastest_m_s or _FASTEST_M_S, is_live
        self._origin: Position | None = None
        self._surveyed = 0  # places
        self._ground: Ground | None = None  # of the map, once it has a place
        self._belief: Belief | None = None
        self._next: Belief | None = None  # that nobody has settled yet
        self._arrived: tuple[np.ndarray, float] | None = None  # where the newest ground began, and how sure that was
        self._arriving = self._arrived
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
        self._velocity_m_s = vehicle.velocity_m_s if is_fresh else None

    def heard(
        self, ranking: Ranking, index: PlaceIndex, evidence: Mapping[str, float], sure: Sureness, where: Located | None
    ) -> Followed:
        """Return what becomes of the belief with the places of a look, of which the best has this `evidence` and says
        that the aircraft is at `where` (None: at the place)."""
        self._survey(index)
        slots, seen = self._seen(ranking, index, evidence, sure, where)
        self._next = copy.copy(self._belief)
        posterior = self._next.update(seen, self._moved(), len(index))
        slot, confidence = None, 0.0
        if len(slots) and posterior.p.max() > 0:
            best = int(posterior.p.argmax())
            slot = int(slots[best])
            near = np.hypot(*(seen.at - seen.at[best]).T) <= self._ground.near
            confidence = float(posterior.p[near].sum())
            off = np.hypot(*(posterior.estimate.at - seen.at[best])) if posterior.estimate else np.inf
            if confidence > _HALF and off <= self._ground.near:
                confidence = max(confidence, posterior.mass)  # with what the look does not see, and knows to be here
            confidence = self._not_by_repetition(seen.at[best], confidence, float(seen.p[near].sum()))
        return Followed(
            slot=slot,
            confidence=confidence,
            lost=posterior.lost,
            mass=posterior.mass,
            estimate=self._estimate(posterior),
        )

    def _not_by_repetition(self, at: np.ndarray, confidence: float, by_itself: float) -> float:
        """Return a confidence that does not rise while the pictures show the same ground: it is that of the first one
        there, or that of the newest look by itself."""
        arrived = self._arrived
        if arrived is None or np.hypot(*(at - arrived[0])) >= self._ground.spacing:
            self._arriving = at, confidence
            return confidence
        self._arriving = arrived
        return min(confidence, max(arrived[1], by_itself))

    def saw_nothing(self, index: PlaceIndex) -> None:
        """Take note of a picture that says nothing: nobody knows whether it shows ground of the map."""
        if self._ground is not None:
            self._next = copy.copy(self._belief)
            self._next.update(None, self._moved(), len(index))
            self.settle()

    def settle(self) -> None:
        """Believe what the last look has led to; nothing changes where nothing was heard."""
        self._belief, self._next = self._next or self._belief, None
        self._arrived, self._t_settled_s = self._arriving, self._t_now_s

    def _estimate(self, posterior: Posterior) -> Estimate | None:
        found = posterior.estimate
        if found is None or self._origin is None:
            return None
        lat_deg, lon_deg = moved_by(self._origin.lat_deg, self._origin.lon_deg, *found.at.tolist())
        covariance_m2 = float(found.covariance[0, 0]), float(found.covariance[0, 1]), float(found.covariance[1, 1])
        return Estimate(Position(lat_deg, lon_deg), covariance_m2, found.heading_deg)

    def _survey(self, index: PlaceIndex) -> None:
        """Measure the ground of the map when its first place is there, and again when its places get positions, or have
        become twice as many: the first few places say little of how far apart the others are."""
        known = ~np.isnan(index.lat_deg)
        has_positions = known.mean() > _HALF
        is_measured = self._origin is not None and len(index) < 2 * self._surveyed
        if self._ground is not None and (is_measured or not has_positions):
            return
        self._surveyed = len(index)
        spacing_m = index.spacing_m() or 0.0
        self._spread_m = max(_LEAST_SPACING_M, spacing_m)  # of a place without pose
        if has_positions:
            first = int(np.flatnonzero(known)[0])
            self._origin = Position(float(index.lat_deg[first]), float(index.lon_deg[first]))
            footprint_m = self._map.footprint_m()
            spacing_m = max(_LEAST_SPACING_M, footprint_m / 2 if footprint_m else spacing_m)
            near_m = max(_LEAST_SPACING_M, _NEAR_FOOTPRINT * footprint_m if footprint_m else self._spread_m)
            self._ground = Ground(spacing=spacing_m, near=near_m)
        else:
            self._ground = Ground(spacing=1.0, near=_NEAR_PLACES, is_ordinal=True)
        self._belief, self._next = Belief(self._ground), None

    def _moved(self) -> Moved:
        if self._ground.is_ordinal or self._elapsed_s is None:
            return moved(None, 1.0, _PLACES_A_QUERY * self._ground.spacing)
        return moved(self._elapsed_s, 1.0, self._fastest_m_s, self._velocity_m_s)

    def _seen(
        self,
        ranking: Ranking,
        index: PlaceIndex,
        evidence: Mapping[str, float],
        sure: Sureness,
        where: Located | None,
    ) -> tuple[np.ndarray, Seen]:
        """Return the slots of the places heard, and what the look says of them."""
        slots = np.array([slot for slot in ranking.slots.tolist() if slot in ranking.compared][:_HEARD])
        at = self._positions(slots, index)
        spread = 1.0 if self._ground.is_ordinal else self._spread_m**2
        covariance = np.tile(spread * np.eye(2), (len(slots), 1, 1))
        heading_deg = np.full(len(slots), np.nan)
        same = np.zeros(len(slots), bool)
        if where and self._origin:
            at[0] = offset_m(self._origin.lat_deg, self._origin.lon_deg, where.position.lat_deg, where.position.lon_deg)
            covariance[0] = matrix_of(where.covariance_m2)
            heading_deg[0] = np.nan if where.heading_deg is None else where.heading_deg
            same = np.isin(index.place_ids[slots], where.places) & (slots != slots[0])
        votes = np.array([_votes(ranking.compared[slot]) for slot in slots.tolist()])
        near = np.hypot(*(at - at[0]).T) <= self._ground.near
        near[0] = True  # also where nobody knows its position
        confidence = sure.confidence(evidence)
        left = max(0.0, sure.of_map(evidence) - confidence)
        p = np.zeros(len(slots))
        p[near & ~same] = confidence * _shares(votes[near & ~same])
        p[~near & ~same] = _OTHERS * left * _shares(votes[~near & ~same])
        # What speaks for a place without position speaks for no other.
        heard = ~np.isnan(at[:, 0]) & ~same
        slots, p, at, covariance, heading_deg = (each[heard] for each in (slots, p, at, covariance, heading_deg))
        return slots, Seen(p=p, at=at, covariance=covariance, heading_deg=heading_deg)

    def _positions(self, slots: np.ndarray, index: PlaceIndex) -> np.ndarray:
        """Return where places are, as the belief has it: float (K, 2), NaN where unknown."""
        if self._origin is None:
            return np.stack([index.place_ids[slots].astype(float), np.zeros(len(slots))], 1)
        lat_deg, lon_deg = index.lat_deg[slots], index.lon_deg[slots]
        return np.stack(offset_m(self._origin.lat_deg, self._origin.lon_deg, lat_deg, lon_deg), 1).astype(float)


def _votes(match: FineMatch) -> float:
    return match.score if match.support is None else math.sqrt(match.score * match.support.back)


def _shares(votes: np.ndarray) -> np.ndarray:
    """Return how probability is shared between places with these votes."""
    if not len(votes):
        return votes
    weight = (np.maximum(votes, 1e-6) / max(float(votes.max()), 1e-6)) ** _SHARPNESS
    return weight / weight.sum()
