"""The later stages of recognition: verify the best place of a ranking, locate the aircraft by it, and decide."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

from edgevpr.core.contract import Technique
from edgevpr.core.types import Candidate
from edgevpr.places.index import PlaceIndex
from edgevpr.places.layers import Layers
from edgevpr.places.readmap import ReadMap
from edgevpr.places.retrieve import NOTHING, Query, Ranking, named, unmoved_elsewhere
from edgevpr.places.sequence import SequenceSearch
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.encoder import EncodedFrame
from edgevpr.runtime.recognise.evidence import (
    Evidence,
    gather_evidence,
    log_count,
    log_share,
    log_times_more,
    share_of,
)
from edgevpr.runtime.recognise.hints import Hints
from edgevpr.runtime.recognise.judge import (
    LIKE_AT_REST,
    NEW_FOR_S,
    AcceptRule,
    Findings,
    Sureness,
    Verdict,
    is_at_rest,
    judge,
)
from edgevpr.runtime.recognise.locate import MAX_PLACES_CHECKED, Located, at_place, locate
from edgevpr.runtime.recognise.place_filter import Followed, PlaceFilter
from edgevpr.runtime.recognise.verify import Verifier


@dataclass(frozen=True, slots=True, kw_only=True)
class Matcher:
    """What encoded frames are searched in, and how: an index, the rule for accepting its matches, and the search over
    sequences of queries (None: each query is ranked alone). They belong together: another form of the vectors in RAM
    gives other scores, and so needs other limits. `layers` are those of the index (None: those of the map). Of an index
    of several maps, `rule_of` gives the rule for a place by its number (None: `rule`). `follows`: the flight is
    followed; not where the index is a part of the map in which the aircraft need not be."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Examined:
    """The best place of a ranking, the rule for it, and what landmarks (`proof`; None: not compared) and the places
    around it say: the position of the aircraft (None: unknown), and the evidence (None: the rule needs none)."""

    ranking: Ranking
    best: Candidate
    rule: AcceptRule
    proof: Agreement | None
    where: Located | None
    evidence: Evidence | None

    @property
    def confidence(self) -> float | None:
        """Probability, by the evidence, that the match is right (None: it is judged by limits)."""
        return self.rule.sure.confidence(self.evidence) if self.rule.sure and self.evidence else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Verdict on the place that was `examined`, and what the flight so far says of it (None: it is not followed)."""

    verdict: Verdict
    examined: Examined
    followed: Followed | None


class Decider:
    """Decides on rankings of the places of a `matcher`. `accuracy_m` is that of a place's position as a fix, and
    `learnt_s` has the times at which places were learnt in this flight, by their numbers."""

    def __init__(
        self,
        place_map: ReadMap,
        technique: Technique,
        matcher: Matcher,
        settings: WalkSettings,
        meter: QueryMeter,
        accuracy_m: float,
        learnt_s: Mapping[int, float],
    ) -> None:
        self._map, self._technique, self._spec, self._matcher = place_map, technique, technique.spec, matcher
        self._settings, self._meter, self._accuracy_m, self._learnt_s = settings, meter, accuracy_m, learnt_s

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
        index, followed = self._matcher.index, None
        found = self._examine(ranking, query, verifier)
        if place_filter and found.rule.sure and found.evidence:
            with self._meter.step("locate"):
                followed = place_filter.update(ranking, index, found.evidence, found.rule.sure, found.where)
            if followed.slot is not None and followed.leads_from(int(ranking.slots[0])):
                found = self._examine(ranking.led_by(followed.slot), query, verifier)
        age_s = query.frame.t_mono_s - self._learnt_s.get(found.best.place.place_id, -math.inf)
        findings = Findings(
            found.ranking,
            is_new=age_s <= NEW_FOR_S,
            proof=found.proof,
            where=found.where,
            evidence=found.evidence,
            by_flight=followed.confidence if followed else None,
        )
        verdict = judge(findings, index, found.rule, self._matcher.search)
        if verdict.accepted and self._spec.looks_down and self._matcher.search is None:
            heading_deg = found.best.place.heading_deg
            is_heading_known = hints is not None and hints.heading_deg is not None and heading_deg is not None
            findings = replace(
                findings,
                at_rest_elsewhere=self._share_at_rest_elsewhere(found, query),
                ahead_of_turned=None if is_heading_known else self._lead_over_turned(found, query),
            )
            verdict = judge(findings, index, found.rule, self._matcher.search)
        return Decision(verdict=verdict, examined=found, followed=followed)

    def _examine(self, ranking: Ranking, query: EncodedFrame, verifier: Verifier) -> Examined:
        """Verify the best place of a ranking by landmarks, locate the aircraft by it, and gather the evidence."""
        index, spec, step = self._matcher.index, self._spec, self._meter.step
        with step("compare"):
            (best,) = named(ranking, index, self._map, first=1)
        rule = self._matcher.rule_of(best.place.place_id) if self._matcher.rule_of else self._matcher.rule
        where = proof = evidence = None
        is_worth_it = best.match.score >= rule.worth_a_look
        # The newest query of a sequence need not be sure by itself.
        verifies = is_worth_it and self._settings.verify and self._matcher.search is None and spec.cells is not None
        if verifies and spec.looks_down:
            with step("verify"):
                proof = verifier.compare_best(ranking)
        if is_worth_it:
            with step("locate"):
                places = named(ranking, index, self._map, first=MAX_PLACES_CHECKED if spec.looks_down else 1)
                where = locate(places, spec.cells, query.view, proof)
                if where is None and best.place.position:
                    where = at_place(best.place.position, self._accuracy_m)
        same: Collection[int] = where.places if where else ()
        if proof and not same:
            with step("verify"):
                same = verifier.find_same_ground(ranking)
        if rule.sure:
            evidence = gather_evidence(ranking, index, rule.neighbour_m, proof, same, spec.looks_down)
        # Ahead, landmarks only speak for a match: they are compared where they can decide.
        if rule.sure and evidence and verifies and not spec.looks_down and self._can_decide(rule.sure, evidence):
            with step("verify"):
                inliers, rival = verifier.count_inliers(ranking), verifier.count_rival(ranking, rule.neighbour_m)
            evidence = replace(evidence, proof=log_times_more(inliers, rival))
        if evidence and proof and evidence.is_hardly_ahead:
            with step("verify"):
                rival = verifier.count_rival(ranking, rule.neighbour_m, same)
            evidence = replace(evidence, rival=log_count(rival))
        return Examined(ranking=ranking, best=best, rule=rule, proof=proof, where=where, evidence=evidence)

    def _can_decide(self, sure: Sureness, evidence: Evidence) -> bool:
        return self._settings.all_evidence or sure.is_open(evidence)

    def _lead_over_turned(self, found: Examined, query: EncodedFrame) -> float | None:
        """Return the lead, as in the evidence, over the same place if the picture is turned otherwise (None: no
        evidence is needed)."""
        if found.evidence is None:
            return None
        with self._meter.step("compare"):
            fine, _ = self._map.fine_part(found.best.place.place_id)
            turned = self._technique.turned(query.descriptor, fine, found.best.match)
            return found.evidence.agree - log_share(share_of(turned))

    def _share_at_rest_elsewhere(self, found: Examined, encoded: EncodedFrame) -> float:
        """Return the share of a few places elsewhere that agree with the query at rest, as the best one (0: it is not
        at rest, or there are none)."""
        best = found.best.match
        if not is_at_rest(best):
            return 0.0
        query = Query(
            technique=self._technique,
            descriptor=encoded.descriptor,
            place_map=self._map,
            index=self._matcher.index,
            expected=NOTHING,
        )
        with self._meter.step("compare"):
            matches = unmoved_elsewhere(query, int(found.ranking.slots[0]), self._accuracy_m)
        least = LIKE_AT_REST * share_of(best)
        return sum(is_at_rest(match) and share_of(match) >= least for match in matches) / max(len(matches), 1)
