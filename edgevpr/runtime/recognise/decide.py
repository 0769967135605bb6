"""The later stages of recognition: verify the best place of a ranking by landmarks, which had no part in finding it,
locate the aircraft by it, and decide."""

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.errors import PlaceError
from edgevpr.core.types import Candidate
from edgevpr.frames.level import LevelledImage
from edgevpr.places.index import PlaceIndex
from edgevpr.places.layers import Layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import MAX_NEIGHBOUR_SLOTS, Ranking, outside_neighbourhood
from edgevpr.places.retrieve import NO_EXPECTATION, Expectation, Query, load_candidates, match_unmoved_places
from edgevpr.places.sequence import SequenceSearch
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.agreement import (
    MIN_CONFIRMED_INLIERS,
    Agreement,
    Overlay,
    compare_near,
    compose_overlays,
    measure_agreement,
)
from edgevpr.runtime.recognise.encoder import EncodedFrame, FrameEncoder
from edgevpr.runtime.recognise.evidence import (
    Evidence,
    compute_share,
    count_neighbours,
    gather_evidence,
    log_count,
    log_inlier_ratio,
    log_share,
)
from edgevpr.runtime.recognise.hints import Hints
from edgevpr.runtime.recognise.judge import (
    AcceptRule,
    Findings,
    Verdict,
    is_at_rest,
    judge,
)
from edgevpr.runtime.recognise.landmarks import PLACE_LANDMARKS, QUERY_LANDMARKS, Landmarks, unpack_bytes
from edgevpr.runtime.recognise.locate import MAX_PLACES_CHECKED, add_tilt_covariance, locate, locate_at_place
from edgevpr.runtime.recognise.perspective import ShownTilt, convert_to_tilt
from edgevpr.runtime.recognise.place_filter import PlaceFilter, TrackEstimate
from edgevpr.runtime.recognise.tilted import measure_again

_MAX_SAME_GROUND = 12  # places that may show the same ground: so many overlap on kite_ochota, which has no positions
# Of the votes of the best place, those that a place elsewhere has at rest: behind a display or figures nearly all have
# 0.15 to 0.9 of them, on smooth ground some are at rest by chance with up to 0.065.
_MIN_REST_VOTES_SHARE = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Matcher:
    """What encoded frames are searched in, and how: an index, the rule for accepting its matches, and the search over
    sequences of queries (None: each query is ranked alone). They belong together: another form of the vectors in RAM
    gives other scores, and so needs other limits. `layers` are those of the index (None: those of the map)."""

    index: PlaceIndex = field(kw_only=False)
    rule: AcceptRule = field(kw_only=False)
    search: SequenceSearch | None = field(default=None, kw_only=False)
    layers: Layers | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkSettings:
    """Settings of the recogniser. `candidates` places are compared (None: all in full, see `places.retrieve.compare`).
    `verify` turns the check by landmarks on; with `all_evidence` they are compared where they decide nothing, too, as a
    model needs to be fitted. The accuracy of a position is never below `min_accuracy_m` (1-sigma)."""

    candidates: int | None = None
    verify: bool = True
    all_evidence: bool = False
    min_accuracy_m: float = 1.0


class Verifier:
    """Compares the landmarks of one query, which are computed when first needed, with those of places. All methods
    raise PlaceError if the landmarks of a place cannot be read; the place is then left out."""

    def __init__(self, encoder: FrameEncoder, picture: LevelledImage, index: PlaceIndex, place_map: PlaceMap) -> None:
        self._encoder, self._spec = encoder, encoder.technique.spec
        self._picture, self._index, self._map = picture, index, place_map

    @cached_property
    def landmarks(self) -> Landmarks:
        """Landmarks of the query."""
        count = QUERY_LANDMARKS if self._spec.looks_down else QUERY_LANDMARKS // 2
        return self._encoder.detect_landmarks(self._picture, count)

    def compare_best(self, ranking: Ranking) -> Agreement | None:
        """Compare the landmarks of the query with those of the best place, expected to agree on the overlay that its
        match gives. None if the place has no landmarks, or its match no shift or rotation."""
        expected, known = self._place(ranking, int(ranking.slots[0]))
        return compare_near(self.landmarks, known, expected) if expected and known is not None else None

    def count_inliers(self, ranking: Ranking) -> int:
        """Return the number of landmarks of the query and of the best place that agree on the overlay of its match: 0
        if those of the place are unknown, or if they are at rest, as a display is."""
        expected, known = self._place(ranking, int(ranking.slots[0]))
        found = None if known is None else measure_agreement(self.landmarks, known, expected)
        return 0 if found is None or found.is_at_rest else found.inliers

    def count_rival(
        self,
        ranking: Ranking,
        neighbour_m: float,
        same: Collection[int] = (),
        max_slots: int = MAX_NEIGHBOUR_SLOTS,
    ) -> int:
        """Return the number of landmarks of the query and of the best place elsewhere (see `outside_neighbourhood`)
        that agree on the overlay of its match: 0 if there is no place elsewhere, the largest possible number if its
        landmarks are unknown. Places with the numbers `same` are not elsewhere."""
        away = ranking.slots[
            outside_neighbourhood(self._index, int(ranking.slots[0]), ranking.slots, neighbour_m, same, max_slots)
        ]
        if not len(away):
            return 0
        expected, known = self._place(ranking, int(away[0]))
        return PLACE_LANDMARKS if known is None else measure_agreement(self.landmarks, known, expected).inliers

    def find_same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Of the best few places compared, return the numbers of those that show the same ground as the best one: the
        landmarks of both agree, on the overlay that follows from their matches. Empty if the best place has a position,
        since distances then tell the same."""
        slots = ranking.compared_slots[:_MAX_SAME_GROUND]
        if not slots or not np.isnan(self._index.lat_deg[slots[0]]):
            return ()
        expected, known = self._place(ranking, slots[0])
        if expected is None or known is None:
            return ()
        others = {int(self._index.place_ids[slot]): self._place(ranking, slot) for slot in slots[1:]}
        return tuple(
            place_id
            for place_id, (other, landmarks) in others.items()
            if other
            and landmarks
            and measure_agreement(known, landmarks, compose_overlays(expected, other)).inliers >= MIN_CONFIRMED_INLIERS
        )

    def _place(self, ranking: Ranking, slot: int) -> tuple[Overlay | None, Landmarks | None]:
        """Return the overlay of the query on the place in row `slot`, by its match, and the place's landmarks (None:
        unknown). Both are None if the match has no shift."""
        match, cells = ranking.compared.get(slot), self._spec.cells
        if match is None or match.shift_cells is None or cells is None:
            return None, None
        width, height = self._sides
        dx, dy = match.shift_cells
        shift_share = dx * width / cells, dy * height / cells
        expected = Overlay(shift_share, match.rotation_deg or 0.0, match.height_ratio)
        try:
            blob = self._map.read_landmarks(int(self._index.place_ids[slot]))
        except PlaceError as error:
            self._map.left_out.setdefault(error.place_id, error.problem)
            raise
        with suppress(ValueError):
            return expected, None if blob is None else unpack_bytes(blob)
        return expected, None

    @property
    def _sides(self) -> tuple[float, float]:
        """Width and height of the picture that a technique has made a square of, as shares of its longest side."""
        if self._spec.looks_down:  # its picture was put into the square, and not stretched
            return 1.0, 1.0
        height, width = self._picture.image.shape[:2]
        return width / max(height, width), height / max(height, width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Verdict on a query, and what it was made by: the `hints` that narrowed the search, the `best` place with its
    `findings` and the probability by its evidence that the match is right, and what the flight so far says of it.
    None: there was no search, the match is judged by limits, or the flight is not followed."""

    verdict: Verdict
    hints: Hints | None = None
    best: Candidate | None = None
    findings: Findings | None = None
    confidence: float | None = None
    followed: TrackEstimate | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decider:
    """Decides on rankings of the places of a `matcher`. `accuracy_m` is that of a place's position as a fix."""

    place_map: PlaceMap
    technique: Technique
    matcher: Matcher
    settings: WalkSettings
    meter: QueryMeter
    accuracy_m: float

    def make_query(self, descriptor: Descriptor, expected: Expectation) -> Query:
        """Return the query of a descriptor to the places of the matcher."""
        technique, place_map, index = self.technique, self.place_map, self.matcher.index
        return Query(technique=technique, descriptor=descriptor, place_map=place_map, index=index, expected=expected)

    def decide(
        self,
        ranking: Ranking,
        query: EncodedFrame,
        hints: Hints | None,
        verifier: Verifier,
        place_filter: PlaceFilter | None,
    ) -> Decision:
        """Judge the best place of a ranking by its landmarks, the places around it, and the flight so far. If the
        flight makes another place more likely, judge that one."""
        index, rule, search, followed = self.matcher.index, self.matcher.rule, self.matcher.search, None
        best, found = self._examine(ranking, query, verifier)
        if place_filter and rule.sure and found.evidence:
            with self.meter.step("locate"):
                followed = place_filter.update(ranking, index, found.evidence, rule.sure, found.where)
            if followed.slot is not None and followed.prefers_other(int(ranking.slots[0])):
                ranking = ranking.promote(followed.slot)
                best, found = self._examine(ranking, query, verifier)
        found = replace(found, track_confidence=followed.confidence if followed else None)
        verdict = judge(found, index, rule, search)
        if verdict.accepted and self.technique.spec.looks_down and search is None:
            heading_deg = best.place.heading_deg
            is_heading_known = hints is not None and hints.heading_deg is not None and heading_deg is not None
            tilt = self._measure_tilt(best, query)
            found = replace(
                found,
                # A recorded tilt is not refused for what a few regions show; the claim counts a contradiction.
                tilt=None if query.view.is_tilt_known else tilt,
                where=add_tilt_covariance(found.where, tilt, query.view) if found.where else None,
                at_rest_elsewhere=self._share_at_rest_elsewhere(best, ranking, query),
                lead_over_turned=None if is_heading_known else self._lead_over_turned(best, found.evidence, query),
            )
            verdict = judge(found, index, rule, search)
        confidence = rule.sure.limit_confidence(found.evidence) if rule.sure and found.evidence else None
        return Decision(
            verdict=verdict, hints=hints, best=best, findings=found, confidence=confidence, followed=followed
        )

    def _examine(self, ranking: Ranking, query: EncodedFrame, verifier: Verifier) -> tuple[Candidate, Findings]:
        """Verify the best place of a ranking by landmarks, locate the aircraft by it, and gather the evidence."""
        index, spec, step, rule = self.matcher.index, self.technique.spec, self.meter.step, self.matcher.rule
        with step("compare"):
            (best,) = load_candidates(ranking, index, self.place_map, first=1)
        where = proof = evidence = None
        is_worth_it = best.match.score >= rule.worth_a_look
        # The newest query of a sequence need not be sure by itself.
        verifies = is_worth_it and self.settings.verify and self.matcher.search is None and spec.cells is not None
        if verifies and spec.looks_down:
            with step("verify"):
                proof = verifier.compare_best(ranking)
        if is_worth_it:
            with step("locate"):
                places = load_candidates(
                    ranking, index, self.place_map, first=MAX_PLACES_CHECKED if spec.looks_down else 1
                )
                where = locate(places, spec.cells, query.view, proof)
                if where is None and best.place.position:
                    where = locate_at_place(best.place.position, self.accuracy_m)
        same: Collection[int] = where.places if where else ()
        if proof and not same:
            with step("verify"):
                same = verifier.find_same_ground(ranking)
        if rule.sure:
            evidence = gather_evidence(ranking, index, rule.neighbour_m, proof, same, spec.looks_down, rule.look_alikes)
        is_ahead = verifies and not spec.looks_down  # landmarks then only speak for a match, where they can decide
        if is_ahead and rule.sure and evidence and (self.settings.all_evidence or rule.sure.is_open(evidence)):
            with step("verify"):
                inliers = verifier.count_inliers(ranking)
                rival = verifier.count_rival(ranking, rule.neighbour_m, max_slots=count_neighbours(rule.look_alikes))
            evidence = replace(evidence, proof=log_inlier_ratio(inliers, rival), landmarks=log_count(inliers))
        if evidence and proof and evidence.is_hardly_ahead:
            with step("verify"):
                rival = verifier.count_rival(ranking, rule.neighbour_m, same)
            evidence = replace(evidence, rival=log_count(rival))
        return best, Findings(ranking, proof=proof, where=where, evidence=evidence)

    def _lead_over_turned(self, best: Candidate, evidence: Evidence | None, query: EncodedFrame) -> float | None:
        """Return the lead, as in the evidence, over the same place if the picture is turned otherwise (None: no
        evidence is needed)."""
        if evidence is None:
            return None
        with self.meter.step("compare"):
            fine, _ = self.place_map.read_fine_part(best.place.place_id)
            return evidence.agree - log_share(
                compute_share(self.technique.match_rotated(query.descriptor, fine, best.match))
            )

    def _measure_tilt(self, best: Candidate, query: EncodedFrame) -> ShownTilt:
        """Return the tilt of the query against the place, as both show it."""
        with self.meter.step("compare"):
            fine, _ = self.place_map.read_fine_part(best.place.place_id)
            if found := self.technique.measure_perspective(query.descriptor, fine, best.match):
                found = measure_again(query.picture, self.technique, fine, found)
            return convert_to_tilt(found, query.view.focal)

    def _share_at_rest_elsewhere(self, candidate: Candidate, ranking: Ranking, encoded: EncodedFrame) -> float:
        """Return the share of a few places elsewhere that agree with the query at rest, as the best one (0: it is not
        at rest, or there are none)."""
        best = candidate.match
        if not is_at_rest(best):
            return 0.0
        with self.meter.step("compare"):
            query = self.make_query(encoded.descriptor, NO_EXPECTATION)
            matches = match_unmoved_places(query, int(ranking.slots[0]), self.accuracy_m)
        least = _MIN_REST_VOTES_SHARE * compute_share(best)
        return sum(is_at_rest(match) and compute_share(match) >= least for match in matches) / max(len(matches), 1)
