"""The last stages of recognition: verify the best place of a ranking by landmarks, which were not used to find it,
locate the aircraft from it, and decide."""

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from edgevpr.core.contract import Descriptor, Perspective, Technique
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
from edgevpr.runtime.recognise.judge import AcceptRule, Findings, Verdict, is_unshifted, judge
from edgevpr.runtime.recognise.landmarks import PLACE_LANDMARKS, QUERY_LANDMARKS, Landmarks, unpack_bytes
from edgevpr.runtime.recognise.locate import (
    MAX_PLACES_CHECKED,
    add_tilt_covariance,
    locate,
    locate_at_place,
    measure_distance_m,
)
from edgevpr.runtime.recognise.perspective import TYPICAL_FOCAL, CommonTilt, convert_to_tilt
from edgevpr.runtime.recognise.place_filter import PlaceFilter, TrackEstimate
from edgevpr.runtime.recognise.relief import Relief
from edgevpr.runtime.recognise.tilted import measure_again

_MAX_SAME_GROUND = 12  # places tried: this many overlap on kite_ochota, which has no positions
# Votes of a place elsewhere, relative to the best place, to count as unshifted. With an on-screen display, nearly all
# places have 0.15 to 0.9; over smooth ground some are unshifted by chance, with up to 0.065.
_MIN_UNSHIFTED_VOTES_RATIO = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Matcher:
    """An index to search, the rule for accepting its matches, and the search over sequences of queries (None: each
    query is ranked alone). They belong together: the scores, and so the limits, depend on the form of the vectors in
    RAM. `layers` are those of the index (None: those of the map)."""

    index: PlaceIndex = field(kw_only=False)
    rule: AcceptRule = field(kw_only=False)
    search: SequenceSearch | None = field(default=None, kw_only=False)
    layers: Layers | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchSettings:
    """Settings of the recogniser. `candidates` places are compared (None: all, fully; see `compare_places`). With
    `all_evidence`, landmarks are compared even where they decide nothing, to fit a model. The accuracy of a position is
    never below `min_accuracy_m` (1 sigma)."""

    candidates: int | None = None
    all_evidence: bool = False
    min_accuracy_m: float = 1.0


class Verifier:
    """Compares the landmarks of one query, computed when first needed, with those of places. All methods raise
    PlaceError if the landmarks of a place cannot be read; the place is then left out."""

    def __init__(self, encoder: FrameEncoder, picture: LevelledImage, index: PlaceIndex, place_map: PlaceMap) -> None:
        self._encoder, self._spec = encoder, encoder.technique.spec
        self._picture, self._index, self._map = picture, index, place_map

    @cached_property
    def landmarks(self) -> Landmarks:
        """Landmarks of the query."""
        count = QUERY_LANDMARKS if self._spec.looks_down else QUERY_LANDMARKS // 2
        return self._encoder.detect_landmarks(self._picture, count)

    def compare_best(self, ranking: Ranking) -> Agreement | None:
        """Compare the landmarks of query and best place, near the overlay given by the match. Return None if the place
        has no landmarks, or its match has no shift."""
        expected, landmarks = self._load_place(ranking, int(ranking.slots[0]))
        return compare_near(self.landmarks, landmarks, expected) if expected and landmarks is not None else None

    def count_inliers(self, ranking: Ranking) -> int:
        """Return the number of landmarks of the query and the best place that agree on the overlay of its match: 0 if
        those of the place are unknown, or if they are unshifted, as in an on-screen display."""
        expected, landmarks = self._load_place(ranking, int(ranking.slots[0]))
        agreement = None if landmarks is None else measure_agreement(self.landmarks, landmarks, expected)
        return 0 if agreement is None or agreement.is_unshifted else agreement.inliers

    def count_rival(
        self,
        ranking: Ranking,
        neighbour_m: float,
        same_ground: Collection[int] = (),
        max_slots: int = MAX_NEIGHBOUR_SLOTS,
    ) -> int:
        """Return the number of landmarks of the query and of the best place elsewhere (see `outside_neighbourhood`)
        that agree on the overlay of its match: 0 if there is no such place, the largest possible number if its
        landmarks are unknown. Places with the numbers `same_ground` do not count as elsewhere."""
        slots, best = ranking.slots, int(ranking.slots[0])
        rivals = slots[outside_neighbourhood(self._index, best, slots, neighbour_m, same_ground, max_slots)]
        if not len(rivals):
            return 0
        expected, landmarks = self._load_place(ranking, int(rivals[0]))
        return PLACE_LANDMARKS if landmarks is None else measure_agreement(self.landmarks, landmarks, expected).inliers

    def find_same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Return the numbers of the compared places that show the same ground as the best one: the landmarks of both
        agree on the overlay that follows from their matches. Only the first few places are tried. Empty if the best
        place has a position: distances are used then."""
        slots = ranking.compared_slots[:_MAX_SAME_GROUND]
        if not slots or not np.isnan(self._index.lat_deg[slots[0]]):
            return ()
        best, best_landmarks = self._load_place(ranking, slots[0])
        if best is None or best_landmarks is None:
            return ()
        others = {int(self._index.place_ids[slot]): self._load_place(ranking, slot) for slot in slots[1:]}
        agreements = {
            place_id: measure_agreement(best_landmarks, landmarks, compose_overlays(best, other))
            for place_id, (other, landmarks) in others.items()
            if other and landmarks
        }
        return tuple(place_id for place_id, pair in agreements.items() if pair.inliers >= MIN_CONFIRMED_INLIERS)

    def _load_place(self, ranking: Ranking, slot: int) -> tuple[Overlay | None, Landmarks | None]:
        """Return the overlay of the query on the place in row `slot`, from its match, and the place's landmarks (None:
        unknown). Both are None if the match has no shift."""
        match, cells = ranking.compared.get(slot), self._spec.cells
        if match is None or match.shift_cells is None or cells is None:
            return None, None
        width, height = self._square_sides
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
    def _square_sides(self) -> tuple[float, float]:
        """Width and height of the technique's square in the picture, as fractions of the picture's longest side."""
        if self._spec.looks_down:  # the picture was padded to the square, not stretched
            return 1.0, 1.0
        height, width = self._picture.image.shape[:2]
        return width / max(height, width), height / max(height, width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Verdict on a query, and its basis: the `hints` that narrowed the search, the `best` place with its `findings`,
    the probability from its evidence that the match is correct (`confidence`), and the result of the place filter
    (`track`). None: there was no search, the match is judged by limits, or there is no filter."""

    verdict: Verdict
    hints: Hints | None = None
    best: Candidate | None = None
    findings: Findings | None = None
    confidence: float | None = None
    track: TrackEstimate | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decider:
    """Decides whether to accept the best place of a ranking. `accuracy_m` is that of a place's position used as
    a fix; `common_tilt` and `relief` are estimated from the matches accepted so far."""

    place_map: PlaceMap
    technique: Technique
    matcher: Matcher
    settings: MatchSettings
    meter: QueryMeter
    accuracy_m: float
    common_tilt: CommonTilt = field(default_factory=CommonTilt)
    relief: Relief = field(default_factory=Relief)

    def make_query(self, descriptor: Descriptor, expected: Expectation) -> Query:
        """Return the query with a descriptor over the places of the matcher."""
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
        """Judge the best place of a ranking from its landmarks, the places around it, and the flight so far. If the
        flight so far makes another place more likely, judge that one."""
        index, rule, search, track = self.matcher.index, self.matcher.rule, self.matcher.search, None
        confidence_rule = rule.confidence_rule
        best, findings = self._gather_findings(ranking, query, verifier)
        if place_filter and confidence_rule and findings.evidence:
            with self.meter.step("locate"):
                track = place_filter.update(
                    ranking, index, findings.evidence, confidence_rule, findings.located, query.view
                )
            if track.slot is not None and track.prefers_other(int(ranking.slots[0])):
                ranking = ranking.promote(track.slot)
                best, findings = self._gather_findings(ranking, query, verifier)
        if track:
            findings = replace(findings, track_confidence=track.confidence, predicted=track.predicted)
        verdict = judge(findings, index, rule, search)
        if verdict.accepted and self.technique.spec.looks_down and search is None:
            heading_deg = best.place.heading_deg
            is_heading_known = hints is not None and hints.heading_deg is not None and heading_deg is not None
            unshifted_fraction = self._measure_unshifted_fraction(best, ranking, query)
            lead = None if is_heading_known else self._compute_rotation_lead(best, findings.evidence, query)
            # Last, because it encodes another image, and a technique caches only the views of its latest image.
            perspective = self._measure_perspective(best, query)
            tilt = convert_to_tilt(perspective, query.view.focal)
            findings = replace(
                findings,
                # A few regions cannot refute a recorded tilt; a contradiction only adds to the reported error.
                tilt=None if query.view.is_tilt_known else tilt,
                unshifted_fraction=unshifted_fraction,
                lead_over_other_rotation=lead,
            )
            verdict = judge(findings, index, rule, search)
            if verdict.accepted and perspective and query.view.is_tilt_known:
                self.common_tilt.add(perspective, query.view, best.place.place_id)
            if findings.located:
                common_sd = self.common_tilt.sd if query.view.is_tilt_known else 0.0
                single_sd = tilt.get_sd(query.view.is_tilt_known)
                findings = replace(findings, located=add_tilt_covariance(findings.located, single_sd, common_sd))
            if verdict.accepted and query.view.footprint_m and findings.located and findings.located.footprint_m:
                self.relief.add(findings.located.footprint_m / query.view.footprint_m, best.place.place_id)
        evidence = findings.evidence
        confidence = confidence_rule.cap_confidence(evidence) if confidence_rule and evidence else None
        if track and confidence_rule and evidence:
            track = replace(track, confidence=confidence_rule.cap_confidence(evidence, track.confidence))
        return Decision(verdict=verdict, hints=hints, best=best, findings=findings, confidence=confidence, track=track)

    def _gather_findings(self, ranking: Ranking, query: EncodedFrame, verifier: Verifier) -> tuple[Candidate, Findings]:
        """Verify the best place of a ranking by landmarks, locate the aircraft from it, and gather the evidence."""
        index, spec, step, rule = self.matcher.index, self.technique.spec, self.meter.step, self.matcher.rule
        with step("compare"):
            (best,) = load_candidates(ranking, index, self.place_map, first=1)
        located = agreement = evidence = None
        all_evidence = self.settings.all_evidence
        is_plausible = best.match.score >= rule.min_verify_score
        # A sequence is judged as a whole, so its newest query is not verified.
        verifies = is_plausible and self.matcher.search is None and spec.cells is not None
        if verifies and spec.looks_down:
            with step("verify"):
                agreement = verifier.compare_best(ranking)
        if is_plausible:
            with step("locate"):
                first = MAX_PLACES_CHECKED if spec.looks_down else 1
                places = load_candidates(ranking, index, self.place_map, first=first)
                located = locate(places, spec.cells, query.view, agreement, self.relief.height_sd)
                if located is None and best.place.position:
                    accuracy_m = max(self.accuracy_m, measure_distance_m(places, spec.cells))
                    located = locate_at_place(best.place.position, accuracy_m)
                if located:  # a strip shifts all fixes, as a tilt does
                    axis_sd = query.view.axis_sd / (query.view.focal or TYPICAL_FOCAL)
                    located = add_tilt_covariance(located, 0.0, axis_sd)
        same_ground: Collection[int] = located.places if located else ()
        if agreement and not same_ground:
            with step("verify"):
                same_ground = verifier.find_same_ground(ranking)
        near_m, confidence_rule = rule.neighbour_m, rule.confidence_rule
        if confidence_rule:
            evidence = gather_evidence(
                ranking, index, near_m, agreement, same_ground, looks_down=spec.looks_down, look_alikes=rule.look_alikes
            )
        is_ahead = verifies and not spec.looks_down  # landmarks can then only support a match
        if is_ahead and confidence_rule and evidence and (all_evidence or confidence_rule.is_undecided(evidence)):
            with step("verify"):
                inliers = verifier.count_inliers(ranking)
                rival = verifier.count_rival(ranking, near_m, max_slots=count_neighbours(rule.look_alikes))
            evidence = replace(evidence, proof=log_inlier_ratio(inliers, rival), landmarks=log_count(inliers))
        if evidence and agreement and evidence.has_small_lead:
            with step("verify"):
                rival = verifier.count_rival(ranking, near_m, same_ground)
            evidence = replace(evidence, rival=log_count(rival))
        return best, Findings(ranking, agreement=agreement, located=located, evidence=evidence)

    def _compute_rotation_lead(self, best: Candidate, evidence: Evidence | None, query: EncodedFrame) -> float | None:
        """Return the lead over the same place with the picture at another rotation; None without evidence."""
        if evidence is None:
            return None
        with self.meter.step("compare"):
            fine, _ = self.place_map.read_fine_part(best.place.place_id)
            rotated = self.technique.match_rotated(query.descriptor, fine, best.match)
            return evidence.agree - log_share(compute_share(rotated))

    def _measure_perspective(self, best: Candidate, query: EncodedFrame) -> Perspective | None:
        """Measure the perspective of the query over the place; None if too few regions agree."""
        with self.meter.step("compare"):
            fine, _ = self.place_map.read_fine_part(best.place.place_id)
            perspective = self.technique.measure_perspective(query.descriptor, fine, best.match)
            return perspective and measure_again(query.picture, self.technique, fine, perspective)

    def _measure_unshifted_fraction(self, candidate: Candidate, ranking: Ranking, encoded: EncodedFrame) -> float:
        """Return the fraction of a few places elsewhere that are unshifted too; 0 if the best place is shifted."""
        best = candidate.match
        if not is_unshifted(best):
            return 0.0
        with self.meter.step("compare"):
            query = self.make_query(encoded.descriptor, NO_EXPECTATION)
            matches = match_unmoved_places(query, int(ranking.slots[0]), self.accuracy_m)
        min_votes = _MIN_UNSHIFTED_VOTES_RATIO * compute_share(best)
        unshifted = [match for match in matches if is_unshifted(match) and compute_share(match) >= min_votes]
        return len(unshifted) / max(len(matches), 1)
