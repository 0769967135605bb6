"""The steps of one frame, written once: for a flight, `match`, `eval`, the probe, and while a map is made.

There is no link, flight log, thread or clock in here: the result depends only on what is passed in. A *look* is one
search of the map for the query of a frame. A query may take several looks, at different heights.
"""

import logging
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from itertools import islice

from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import EdgevprError, MapError, PlaceError
from edgevpr.core.types import Candidate, Frame, Vehicle
from edgevpr.frames.level import Levelled
from edgevpr.places.index import PlaceIndex
from edgevpr.places.layers import Layers, layers_of
from edgevpr.places.readmap import ReadMap
from edgevpr.places.retrieve import (
    NOTHING,
    Expectation,
    Query,
    Ranking,
    compare,
    named,
    scan,
    together,
    unmoved_elsewhere,
)
from edgevpr.places.sequence import SequenceSearch
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.agreement import Verification, landmarks_in
from edgevpr.runtime.recognise.confidence import Evidence
from edgevpr.runtime.recognise.evidence import evidence_of, log_share, of_count, proven, share_of
from edgevpr.runtime.recognise.follow import Followed, Follower
from edgevpr.runtime.recognise.hints import Prior, Reach, Told, expected_of, other_heights
from edgevpr.runtime.recognise.judge import (
    LIKE_AT_REST,
    NEW_FOR_S,
    AcceptRule,
    Findings,
    Sureness,
    Verdict,
    is_at_rest,
    is_hardly_ahead,
    judge,
    says_nothing,
)
from edgevpr.runtime.recognise.landmarks import packed
from edgevpr.runtime.recognise.levelling import seen_as
from edgevpr.runtime.recognise.locate import HEARD, Located, at_place, located
from edgevpr.runtime.recognise.preparation import AS_IT_IS, Preparation
from edgevpr.runtime.recognise.recognition import Recognition

_log = logging.getLogger(__name__)
_Judged = tuple[Verdict, Candidate, Located | None]  # with the best place, and the position of the aircraft
_OF_CANDIDATES = 0.4  # share of the candidates that is compared at each height but the first


@dataclass(frozen=True, slots=True, kw_only=True)
class Matcher:
    """All that a frame is recognised with: a technique, the index made with it, the rule for accepting its matches, and
    the search over sequences of queries (None: each query is ranked alone). They belong together: another form of the
    vectors in RAM gives other scores, and so needs other limits. `layers` are those of the index (None: those of the
    map). Of an index of several maps, `rule_of` gives the rule for a place by its number (None: `rule`). `follows`: the
    flight is followed; not where the index is a part of the map in which the aircraft need not be."""

    technique: Technique = field(kw_only=False)
    index: PlaceIndex = field(kw_only=False)
    rule: AcceptRule = field(kw_only=False)
    search: SequenceSearch | None = field(default=None, kw_only=False)
    layers: Layers | None = None
    rule_of: Callable[[int], AcceptRule] | None = None
    follows: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkSettings:
    """Settings of the recogniser. `candidates` places are compared (None: all in full, see `places.retrieve.compare`).
    `verify` turns the check by landmarks on; with `all_evidence` they are compared where they decide nothing, too, as a
    model needs to be fitted. The accuracy of a position is never below `min_accuracy_m` (1-sigma)."""

    candidates: int | None = None
    verify: bool = True
    all_evidence: bool = False
    min_accuracy_m: float = 1.0


class Recogniser:
    """Recognises places of an open map, frame after frame.

    `prior` makes hints that narrow each query (None: the whole map is searched). `follower` follows the flight from
    query to query (None: each is judged alone). The governor changes `candidates`, a survey of the camera's mount the
    `preparation`; `take` and `extend` the index.
    """

    def __init__(
        self,
        matcher: Matcher,
        place_map: ReadMap,
        meter: QueryMeter,
        settings: WalkSettings = WalkSettings(),
        *,
        preparation: Preparation = AS_IT_IS,
        prior: Prior | Told | None = None,
        follower: Follower | None = None,
    ) -> None:
        self.place_map, self.meter, self.candidates = place_map, meter, settings.candidates
        self._settings, self.preparation = settings, preparation
        self._prior, self._follower = prior, follower
        self._told = 0  # number of left out places that events have reported
        self._new: dict[int, float] = {}  # places by their numbers, and the times they were learnt
        self._layers = matcher.layers or layers_of(place_map)
        self.take(matcher)

    def take(self, matcher: Matcher) -> None:
        """Use another matcher from the next frame on."""
        self.technique, self.index = matcher.technique, matcher.index
        self.rule, self.search, self._rule_of = matcher.rule, matcher.search, matcher.rule_of
        self._layers = matcher.layers or self._layers
        self._following = self._follower if matcher.follows else None
        # Places nearer to each other show the same ground: neither is a rival of the other.
        self._footprint_m = max(self._layers.footprints_m, default=0.0)
        # 1-sigma accuracy of a place's position as a fix: the aircraft may be anywhere between two places.
        self.accuracy_m = max(self._settings.min_accuracy_m, matcher.index.spacing_m() or 0.0)

    @property
    def sequence(self) -> int:
        """Number of queries that are matched together."""
        return self.search.length if self.search else 1

    def extend(self, index: PlaceIndex, place_id: int, t_mono_s: float) -> None:
        """Use an index that has one more place, `place_id`, learnt from the frame taken at `t_mono_s`."""
        self._new = {new: t_s for new, t_s in self._new.items() if t_mono_s - t_s <= NEW_FOR_S}
        self._new[place_id] = t_mono_s
        self.take(Matcher(self.technique, index, self.rule, self.search))

    def step(self, frame: Frame, vehicle: Vehicle | None = None) -> Recognition:
        """Recognise one frame; `vehicle` is the autopilot's report at that moment (None: no report).

        Never raises an Exception: an error in a frame, a place or the technique becomes a rejection with its reason.
        """
        self.meter.begin()
        event = Recognition(frame=frame, vehicle=vehicle)
        preparation = self.preparation
        try:
            with self.meter.step("prepare"):
                event.picture = picture = self._picture(frame, vehicle)
            with self.meter.step("gate"):
                event.worth = preparation.gate.look(frame.image) if preparation.gate else None
            with self.meter.step("encode"):
                event.descriptor = descriptor = self.technique.encode(picture.image, picture.mask)
            looked = Verification(self.technique.spec, picture, self.index, self.place_map)
            self._measure_stride(event, looked)
            verdict, where = self._recognise(event, frame, looked, descriptor)
            event.accepted, event.reason = verdict.accepted, verdict.reason
            if event.accepted and where:
                event.located, event.accuracy_m = where, max(self._settings.min_accuracy_m, where.accuracy_m)
        except Exception as error:
            _log.debug("%s failed", frame.name, exc_info=True)
            event.failed, event.reason = True, _sentence(error)
            event.map_lost = isinstance(error, MapError) and not isinstance(error, PlaceError)
        event.left_out = tuple(islice(self.place_map.left_out.items(), self._told, None))
        self._told += len(event.left_out)
        event.steps, event.cost = self.meter.steps(), self.meter.cost()
        return event

    def _picture(self, frame: Frame, vehicle: Vehicle | None) -> Levelled:
        """Prepare a picture, scaled to the places to look among, and by what the matches before have shown."""
        return self.preparation.picture(frame, vehicle, layers=self._layers, scale=self._scale)

    @property
    def _scale(self) -> float:
        """The factor to enlarge the next picture by."""
        return self._prior.scale(self.technique.spec.height_ratios) if self._prior else 1.0

    @property
    def area(self) -> Reach | None:
        """The area in which the aircraft was at the last query, as far as it is known by other means than its place."""
        return self._prior.area if isinstance(self._prior, Prior) else None

    @property
    def measures_strides(self) -> bool:
        """True if the motion between two frames is measured."""
        return self.preparation.strides is not None

    def stride(self, frame: Frame, vehicle: Vehicle | None = None) -> Recognition:
        """Measure the motion from the frame before to this one, and nothing else. Never raises an Exception."""
        self.meter.begin()
        event = Recognition(frame=frame, vehicle=vehicle)
        try:
            with self.meter.step("prepare"):
                event.picture = picture = self._picture(frame, vehicle)
            self._measure_stride(event, Verification(self.technique.spec, picture, self.index, self.place_map))
        except Exception as error:
            _log.debug("%s failed", frame.name, exc_info=True)
            event.failed, event.reason = True, _sentence(error)
        event.steps, event.cost = self.meter.steps(), self.meter.cost()
        return event

    def _measure_stride(self, event: Recognition, looked: Verification) -> None:
        """Measure the stride of a frame from the one before, if its picture lies on the ground."""
        strides = self.preparation.strides
        if strides and event.frame and event.view.is_laid:
            with self.meter.step("stride"):
                event.stride = strides.to(event.frame.t_mono_s, event.view, looked.landmarks)

    def unread(self, error: Exception) -> Recognition:
        """Return the event of a frame that could not even be read."""
        self.meter.begin()
        steps, cost = self.meter.steps(), self.meter.cost()
        return Recognition(frame=None, reason=_sentence(error), failed=True, steps=steps, cost=cost)

    def landmarks(self, event: Recognition) -> bytes | None:
        """Return the landmarks to store for a frame that becomes a place; None if the technique has no use for them."""
        picture, spec = event.picture, self.technique.spec
        return packed(landmarks_in(picture, spec)) if picture and spec.cells else None

    def _recognise(
        self, event: Recognition, frame: Frame, looked: Verification, descriptor: Descriptor
    ) -> tuple[Verdict, Located | None]:
        """Search the map for an encoded frame. Returns the verdict and the aircraft's position (None: unknown)."""
        follower = self._following
        nothing = says_nothing(descriptor, self.rule.min_quality)
        event.says_nothing = nothing is not None
        objection = nothing or (event.worth.reason if event.worth else None)
        if follower:
            follower.went_on(frame, event.vehicle, event.stride)
        if not len(self.index):
            return Verdict(False, "the map has no place yet"), None
        if objection and self.search is None:  # a sequence needs every query
            if follower:
                follower.saw_nothing(self.index)
            return Verdict(False, objection), None
        verdict, best, where = self._found(event, frame, looked, descriptor)
        if follower:
            follower.settle()
        if objection:
            verdict = Verdict(False, objection)
        if self._prior:
            by_height_m = looked.picture.view.footprint_m
            self._prior.learn(best, verdict.accepted, frame.t_mono_s, self._scale, by_height_m, self._layers)
            if event.followed:
                self._prior.follow(event.followed.estimate, event.followed.mass, frame.t_mono_s)
        return verdict, where

    def _found(self, event: Recognition, frame: Frame, looked: Verification, descriptor: Descriptor) -> _Judged:
        """Search for a query as expected and, if nothing is accepted, at all other heights; return as `_judged`."""
        prior, spec, search = self._prior, self.technique.spec, self.search
        if prior:
            margin_m = max(self.accuracy_m, self.rule.neighbour_m)
            event.hints = prior.hints(seen_as(frame, looked.picture.view), event.vehicle, self.index, margin_m)
        height_ratio = prior.height_ratio / self._scale if prior else 1.0
        expected = expected_of(event.hints, height_ratio, self.index)
        footprint_m = looked.picture.view.footprint_m or (prior.footprint_m if prior else None)
        ranking = self._look(descriptor, self._layers.narrowed(expected, self.index, footprint_m))
        if search:
            ranking = search.follow(ranking, self.index, frame.t_mono_s)
        judged = self._judged(event, ranking, looked)
        others = other_heights(spec.height_ratios, height_ratio)
        if judged[0].accepted or search or not others or (prior and not prior.looks_again):
            return judged
        for ratio in others:
            # Matches of all looks are judged together: each can speak against the best one.
            look = self._look(descriptor, replace(expected, height_ratio=ratio), _OF_CANDIDATES)
            ranking = together(ranking, look)
        return self._judged(event, ranking, looked)

    def _look(self, descriptor: Descriptor, expected: Expectation, part: float = 1.0) -> Ranking:
        """Search the map once for a query, with the share `part` of the candidates. Raises as `compare` does."""
        query = self._query(descriptor, expected)
        with self.meter.step("scan"):
            self.place_map.require_unchanged()
            scanned = scan(query)
        with self.meter.step("compare"):
            candidates = self.candidates and max(1, round(part * self.candidates))
            return compare(query, scanned, candidates, max(self.rule.neighbour_m, self._footprint_m))

    def _query(self, descriptor: Descriptor, expected: Expectation = NOTHING) -> Query:
        technique, place_map, index = self.technique, self.place_map, self.index
        return Query(technique=technique, descriptor=descriptor, place_map=place_map, index=index, expected=expected)

    def _judged(
        self, event: Recognition, ranking: Ranking, looked: Verification, followed: Followed | None = None
    ) -> _Judged:
        """Judge the best place of a ranking by its landmarks, the places around it, and the flight so far. If the
        flight makes another place more likely, judge that one (`followed`: the flight's result is known already).
        Returns the verdict, the place judged, and the aircraft's position (None: unknown)."""
        index, place_map, spec, rule = self.index, self.place_map, self.technique.spec, self.rule
        with self.meter.step("compare"):
            (best,) = named(ranking, index, place_map, first=1)
        rule = self._rule_of(best.place.place_id) if self._rule_of else rule
        where = proof = evidence = None
        is_worth_it = best.match.score >= rule.worth_a_look
        # The newest query of a sequence need not be sure by itself.
        verifies = is_worth_it and self._settings.verify and self.search is None and spec.cells is not None
        if verifies and spec.looks_down:
            with self.meter.step("verify"):
                proof = looked.proof(ranking)
        if is_worth_it:
            with self.meter.step("locate"):
                found = named(ranking, index, place_map, first=HEARD if spec.looks_down else 1)
                where = located(found, spec.cells, looked.picture.view, proof)
                if where is None and best.place.position:
                    where = at_place(best.place.position, self.accuracy_m)
        same: Collection[int] = where.places if where else ()
        if verifies and proof and not same:
            with self.meter.step("verify"):
                same = looked.same_ground(ranking)
        if rule.sure:
            evidence = evidence_of(ranking, index, rule.neighbour_m, proof, same, spec.looks_down)
        if rule.sure and evidence and verifies and not spec.looks_down:
            evidence["proof"] = self._proven(ranking, looked, rule.sure, evidence)
        if evidence and verifies and proof and is_hardly_ahead(evidence):
            with self.meter.step("verify"):
                evidence["rival"] = of_count(looked.rival(ranking, rule.neighbour_m, same))
        if self._following and followed is None and rule.sure and evidence is not None:
            with self.meter.step("locate"):
                followed = self._following.heard(ranking, index, evidence, rule.sure, where)
            if followed.slot is not None and followed.leads_from(int(ranking.slots[0])):
                return self._judged(event, ranking.led_by(followed.slot), looked, followed)
        event.ranking, event.best, event.followed = ranking, best, followed
        event.proof, event.evidence = proof, evidence
        event.confidence = rule.sure.confidence(evidence) if rule.sure and evidence else None
        age_s = (event.frame.t_mono_s if event.frame else 0.0) - self._new.get(best.place.place_id, -math.inf)
        findings = Findings(
            ranking,
            is_new=age_s <= NEW_FOR_S,
            proof=proof,
            where=where,
            evidence=evidence,
            by_flight=followed.confidence if followed else None,
        )
        verdict = judge(findings, index, rule, self.search)
        if verdict.accepted and spec.looks_down and self.search is None:
            is_turned_known = event.hints and event.hints.heading_deg is not None and best.place.heading_deg is not None
            findings = replace(findings, at_rest_elsewhere=self._at_rest_elsewhere(event, ranking, best.match))
            if evidence and not is_turned_known:
                findings = replace(findings, ahead_of_turned=evidence["agree"] - self._turned(event, best))
            verdict = judge(findings, index, rule, self.search)
        return verdict, best, where

    def _proven(self, ranking: Ranking, looked: Verification, sure: Sureness, evidence: Evidence) -> float:
        """Return the evidence of the landmarks where the camera looks ahead: 0 where it would decide nothing."""
        if not (self._settings.all_evidence or sure.is_open(evidence)):
            return 0.0
        with self.meter.step("verify"):
            return proven(looked.inliers(ranking), looked.rival(ranking, self.rule.neighbour_m, ()))

    def _turned(self, event: Recognition, best: Candidate) -> float:
        """Return how much agrees, as in the evidence, with the best place if the picture is turned otherwise."""
        assert event.descriptor is not None
        with self.meter.step("compare"):
            fine, _ = self.place_map.fine_part(best.place.place_id)
            return log_share(share_of(self.technique.turned(event.descriptor, fine, best.match)))

    def _at_rest_elsewhere(self, event: Recognition, ranking: Ranking, best: FineMatch) -> float:
        """Return the share of a few places elsewhere that agree with the query at rest, as the best one (0: it is not
        at rest, or there are none)."""
        if not is_at_rest(best):
            return 0.0
        assert event.descriptor is not None
        with self.meter.step("compare"):
            query = self._query(event.descriptor)
            matches = unmoved_elsewhere(query, int(ranking.slots[0]), self.accuracy_m)
        least = LIKE_AT_REST * share_of(best)
        return sum(is_at_rest(match) and share_of(match) >= least for match in matches) / max(len(matches), 1)


def _sentence(error: Exception) -> str:
    """Return an error as a sentence. An error that is not edgevpr's own is a fault of a technique or of a library."""
    if isinstance(error, EdgevprError):
        return str(error)
    return f"an unforeseen {type(error).__name__} ({error}): report it, with the output of --debug"
