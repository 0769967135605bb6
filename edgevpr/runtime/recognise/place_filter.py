"""Tracks a flight over the places of a map: converts the result of each query to proposals for a `belief`.

The best place of a *search pass*, one search of the map for one query, has a confidence. The remaining probability that
the query shows ground of the map is distributed over the other places compared."""

import copy
import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.core.geodesy import move_position, offset_between_m, offset_m
from edgevpr.core.types import Frame, Position, Vehicle
from edgevpr.frames.level import View
from edgevpr.places.index import PlaceIndex
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import Ranking
from edgevpr.runtime.recognise.belief import Belief, Proposals
from edgevpr.runtime.recognise.evidence import Evidence, compute_share
from edgevpr.runtime.recognise.hypotheses import DEFAULT_MAX_SPEED_M_S, MapScale, Motion
from edgevpr.runtime.recognise.judge import ConfidenceRule
from edgevpr.runtime.recognise.locate import Located, covariance_matrix, to_triple
from edgevpr.runtime.recognise.odometry import OdometryStep

_TWIN_RATIO = 0.5  # with this fraction of the best place's votes, a twin is equally likely (`Evidence.has_twin`)
# Chosen on corridor, aerial_caliterra and aerial_garfield28.
_SHARPNESS = 10.0  # the odds of two places are this power of the ratio of their votes
_OTHERS_CORRECT_FRACTION = 0.7  # of cases in which the correct place is among the others if the best is wrong
_MAX_PROPOSED = 20  # largest number of places that one query proposes
# Largest distance that counts as one position, in places and in footprints; and the probability of a majority.
_NEAR_PLACES = 3.0
_NEAR_FOOTPRINT = 0.25
_MIN_MAJORITY = 0.5
_MAX_PLACES_PER_QUERY = 3.0  # highest speed if the time or the positions are unknown
_MAX_ELAPSED_S = 3600.0
_MIN_SPACING_M = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackEstimate:
    """Result of a query combined with the flight so far. `slot` is the index row of the most likely place (None: no
    place), `confidence` the probability that the aircraft is there, and `predicted` the one before the query (see
    `Posterior`). `lost` is the probability that it is at no position of the belief. `estimate` is its most likely
    position (None: unknown, or the map has no positions), and `mass` the probability that it is near this position."""

    slot: int | None
    confidence: float
    predicted: float
    lost: float
    mass: float
    estimate: Located | None

    def prefers_other(self, slot: int) -> bool:
        """Return True if a place other than `slot` is more likely than not."""
        return self.slot is not None and self.slot != slot and self.confidence > _MIN_MAJORITY


class _MapGeometry:
    """Measures of a map: the `origin` of the belief's plane (None: the map has no positions), the `scale`, `spread`,
    the standard deviation of the position of a place without a pose, `footprint_m`, the largest one of its places
    (None: unknown), and `known_positions` (N, 2), those of the places that have one."""

    def __init__(self, place_map: PlaceMap, index: PlaceIndex) -> None:
        known = ~np.isnan(index.lat_deg)
        self.origin = self.footprint_m = None
        self.known_positions = np.zeros((0, 2))
        self.scale, self.spread = MapScale(spacing=1.0, near=_NEAR_PLACES, is_ordinal=True), 1.0
        if known.mean() > _MIN_MAJORITY:
            first = int(np.flatnonzero(known)[0])
            self.origin = Position(float(index.lat_deg[first]), float(index.lon_deg[first]))
            self.known_positions = self.positions(np.flatnonzero(known), index)
            layers = read_layers(place_map)
            self.footprint_m = max(layers.footprints_m, default=None)
            spacing_m, footprint_m = index.spacing_m() or 0.0, layers.median_m
            self.spread = max(_MIN_SPACING_M, spacing_m)
            self.scale = MapScale(
                spacing=max(_MIN_SPACING_M, footprint_m / 2 if footprint_m else spacing_m),
                near=max(_MIN_SPACING_M, _NEAR_FOOTPRINT * footprint_m if footprint_m else self.spread),
            )

    def find_sight_m(self, view: View) -> float | None:
        """Return the largest distance from which the aircraft sees ground of a place in this view; None: unknown."""
        if not (self.footprint_m and view.footprint_m and view.nadir_offset):
            return None
        return self.footprint_m / 2 + view.footprint_m * (0.5 + math.hypot(*view.nadir_offset))

    def positions(self, slots: Ints, index: PlaceIndex) -> Doubles:
        """Return positions in the plane of the belief, float (K, 2); NaN if unknown."""
        if self.origin is None:
            return np.stack([index.place_ids[slots].astype(float), np.zeros(len(slots))], 1)
        lat_deg, lon_deg = index.lat_deg[slots], index.lon_deg[slots]
        return np.stack(offset_m(self.origin.lat_deg, self.origin.lon_deg, lat_deg, lon_deg), 1).astype(float)


class PlaceFilter:
    """Tracks one flight over one map. For each frame call `predict`, then `update` for each search pass, then `commit`
    to keep the belief of the last pass.

    `max_speed_m_s` is the highest speed of the aircraft (None: unknown). `is_live` is False for recorded frames, whose
    times are those of the recording."""

    def __init__(self, place_map: PlaceMap, *, max_speed_m_s: float | None, is_live: bool) -> None:
        self._map, self._max_speed_m_s, self._is_live = place_map, max_speed_m_s or DEFAULT_MAX_SPEED_M_S, is_live
        self._geometry: _MapGeometry | None = None
        self._belief: Belief | None = None
        self._next: Belief | None = None  # the belief after the last search pass, until `commit`
        self._first_view: tuple[Doubles, float] | None = None  # of the ground now in view: position, first confidence
        self._next_first_view: tuple[Doubles, float] | None = None
        self._t_now_s: float | None = None
        self._t_committed_s: float | None = None
        self._elapsed_s: float | None = None
        self._velocity_m_s: tuple[float, float] | None = None
        self._moved_m: tuple[float, float] | None = None  # by odometry

    def predict(
        self, frame: Frame, vehicle: Vehicle | None, odometry: OdometryStep | None = None, height_ratio: float = 1.0
    ) -> None:
        """Store the time of the next query and the motion since the last committed one, for `update`: the motion
        measured by `odometry` since the previous frame or, without it, derived from the autopilot's velocity.
        `height_ratio`: height above ground that the last match showed, divided by the reported one."""
        now_s = frame.t_mono_s if self._is_live else frame.t_utc_s
        before_s, self._t_now_s = self._t_committed_s, now_s
        self._elapsed_s = None if before_s is None or now_s is None else now_s - before_s
        is_fresh = self._is_live and vehicle is not None and vehicle.is_fresh(frame.t_mono_s)
        self._velocity_m_s = vehicle.velocity_m_s if vehicle and is_fresh else None
        self._moved_m = None
        if odometry and odometry.from_s == before_s:
            east_m, north_m = odometry.moved_m
            self._moved_m = height_ratio * east_m, height_ratio * north_m

    def update(
        self,
        ranking: Ranking,
        index: PlaceIndex,
        evidence: Evidence,
        rule: ConfidenceRule,
        located: Located | None,
        view: View,
    ) -> TrackEstimate:
        """Return the result of one pass combined with the flight so far; nothing is kept until `commit`. `evidence` is
        that of the best place in the `ranking`, and `rule` converts it to probabilities. `located` is the position of
        the aircraft computed from the best place (None: that of the place itself is used); `view`: of the query."""
        if self._geometry is None or self._belief is None:
            self._geometry = _MapGeometry(self._map, index)
            self._belief = Belief(self._geometry.scale)
        geometry, near = self._geometry, self._geometry.scale.near
        slots, proposed = _make_proposals(ranking, index, geometry, rule, evidence, located)
        self._next = copy.copy(self._belief)
        if (sight_m := geometry.find_sight_m(view)) is not None:
            self._next.drop_off_map(geometry.known_positions, sight_m)
        posterior = self._next.update(proposed, self._make_motion(geometry), len(index))
        slot, confidence, predicted = None, 0.0, 0.0
        if len(slots) and posterior.probability.max() > 0:
            best = int(posterior.probability.argmax())
            slot, best_position, predicted = int(slots[best]), proposed.position[best], float(posterior.predicted[best])
            is_near = np.hypot(*(proposed.position - best_position).T) <= near
            confidence = float(posterior.probability[is_near].sum())
            if confidence > _MIN_MAJORITY and np.hypot(*(posterior.position - best_position)) <= near:
                confidence = max(confidence, posterior.mass)  # includes hypotheses not proposed by this pass
            alone = float(proposed.probability[is_near].sum())
            confidence = self._limit_repetition(best_position, confidence, alone)
        estimate = None
        if geometry.origin and posterior.mass:
            position = move_position(geometry.origin, *posterior.position.tolist())
            covariance_m2, heading_deg = to_triple(posterior.covariance), posterior.heading_deg
            estimate = Located(position=position, covariance_m2=covariance_m2, heading_deg=heading_deg)
        lost, mass = posterior.lost, posterior.mass
        return TrackEstimate(
            slot=slot, confidence=confidence, predicted=predicted, lost=lost, mass=mass, estimate=estimate
        )

    def update_without_match(self, index: PlaceIndex) -> None:
        """Process a picture with too little texture to tell whether the aircraft is over the map."""
        if self._geometry and self._belief:
            self._next = copy.copy(self._belief)
            self._next.update(None, self._make_motion(self._geometry), len(index))
            self.commit()

    def commit(self) -> None:
        """Keep the belief of the last pass; without a pass since the last call, the belief is unchanged."""
        self._belief, self._next = self._next or self._belief, None
        self._first_view, self._t_committed_s = self._next_first_view, self._t_now_s

    def _make_motion(self, geometry: _MapGeometry) -> Motion:
        if geometry.scale.is_ordinal or self._elapsed_s is None:
            return make_motion(None, _MAX_PLACES_PER_QUERY * geometry.scale.spacing)
        if self._moved_m and self._elapsed_s > 0:
            velocity_m_s = self._moved_m[0] / self._elapsed_s, self._moved_m[1] / self._elapsed_s
            return make_motion(self._elapsed_s, self._max_speed_m_s, velocity_m_s, is_visual=True)
        return make_motion(self._elapsed_s, self._max_speed_m_s, self._velocity_m_s)

    def _limit_repetition(self, position: Doubles, confidence: float, alone: float) -> float:
        """Cap `confidence` while successive queries show the same ground: more pictures of it are not independent
        evidence. The cap is the higher of the confidence after the first of them and that of this query (`alone`)."""
        first = self._first_view
        if first is None or self._geometry is None or np.hypot(*(position - first[0])) >= self._geometry.scale.spacing:
            self._next_first_view = position, confidence
            return confidence
        self._next_first_view = first
        return min(confidence, max(first[1], alone))


def make_motion(
    elapsed_s: float | None, max_speed: float, velocity: tuple[float, float] | None = None, is_visual: bool = False
) -> Motion:
    """Return the motion in `elapsed_s` seconds, assumed to be one second if unknown (None) or if the clock was set
    back. `max_speed` is the highest speed in map units per second, and `velocity` (east, north) comes from odometry
    (None: unknown); it is ignored without a time or if it is implausibly high. For `is_visual` see `Motion`."""
    if elapsed_s is None or not elapsed_s > 0:
        return Motion(reach=max_speed, elapsed_s=1.0)
    elapsed_s, displacement = min(elapsed_s, _MAX_ELAPSED_S), None
    # Excludes NaN. Odometry may report twice the true speed.
    if velocity is not None and math.hypot(*velocity) <= 2 * max_speed:
        displacement = elapsed_s * np.asarray(velocity, float)
    return Motion(reach=max_speed * elapsed_s, elapsed_s=elapsed_s, displacement=displacement, is_visual=is_visual)


def _make_proposals(
    ranking: Ranking,
    index: PlaceIndex,
    geometry: _MapGeometry,
    rule: ConfidenceRule,
    evidence: Evidence,
    located: Located | None,
) -> tuple[Ints, Proposals]:
    """Return the index rows, int (K,), of the places that a query proposes, and the proposals for the belief."""
    slots: Ints = np.array(ranking.compared_slots[:_MAX_PROPOSED])
    positions = geometry.positions(slots, index)
    # Without a located match only the place is known, not the aircraft's position in its picture.
    spread = geometry.spread if located else max(geometry.spread, geometry.scale.near)
    covariance = np.tile((1.0 if geometry.origin is None else spread**2) * np.eye(2), (len(slots), 1, 1))
    heading_deg = np.full(len(slots), np.nan)
    is_same = np.zeros(len(slots), bool)
    if located and geometry.origin:
        positions[0] = offset_between_m(geometry.origin, located.position)
        if not evidence.has_twin:  # equally likely places must have equal covariances
            covariance[0] = covariance_matrix(located.covariance_m2)
        heading_deg[0] = np.nan if located.heading_deg is None else located.heading_deg
        is_same = np.isin(index.place_ids[slots], located.places) & (slots != slots[0])
    votes = np.array([compute_share(ranking.compared[slot]) for slot in slots.tolist()])
    is_near = np.hypot(*(positions - positions[0]).T) <= geometry.scale.near
    is_near[0] = True  # even if its position is unknown
    confidence = rule.confidence(evidence)
    # Ahead, a sequence of weak matches is evidence enough. Looking down, images of ground outside the map overlap for
    # long, and may resemble several places of it.
    is_certain = is_near & (evidence.looks_ahead or confidence >= rule.threshold(evidence))
    others = _OTHERS_CORRECT_FRACTION * max(0.0, rule.compute_map_confidence(evidence) - confidence)
    probability = np.zeros(len(slots))
    if evidence.has_twin:  # more votes only mean that the picture was taken closer to that place
        votes = np.minimum(votes, _TWIN_RATIO * votes.max(initial=0))
        probability[~is_same] = (confidence + others) * _compute_weights(votes[~is_same])
    else:
        probability[is_near & ~is_same] = confidence * _compute_weights(votes[is_near & ~is_same])
        probability[~is_near & ~is_same] = others * _compute_weights(votes[~is_near & ~is_same])
    # The probability of a place without a position is not given to other places.
    is_proposed = ~np.isnan(positions[:, 0]) & ~is_same
    return slots[is_proposed], Proposals(
        probability=probability[is_proposed],
        position=positions[is_proposed],
        covariance=covariance[is_proposed],
        heading_deg=heading_deg[is_proposed],
        is_certain=is_certain[is_proposed],
    )


def _compute_weights(votes: Doubles) -> Doubles:
    """Return weights (K,) that distribute a probability over K places. `votes` (K,): `compute_share` of each."""
    if not len(votes):
        return votes
    weight: Doubles = (np.maximum(votes, 1e-6) / max(float(votes.max()), 1e-6)) ** _SHARPNESS
    return np.asarray(weight / weight.sum())
