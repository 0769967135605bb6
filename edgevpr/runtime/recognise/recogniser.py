"""The steps of one frame, written once: for a flight, `match`, `eval`, the probe, and while a map is made.

No link, flight log, thread or clock is inside: what is handed in with a frame decides the result.
"""

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.errors import EdgevprError, MapError, PlaceError
from edgevpr.core.types import Candidate, Frame, Vehicle
from edgevpr.frames.mask import AnyMask, NoMask, encoded
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Expected, Ranking, compare, named, scan, together
from edgevpr.places.sequence import Alone, Search
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.evidence import evidence_ahead, evidence_down
from edgevpr.runtime.recognise.follow import Followed, Follower, NoFollower
from edgevpr.runtime.recognise.gate import says_nothing
from edgevpr.runtime.recognise.hints import NoPrior, Prior, expected_of, other_heights
from edgevpr.runtime.recognise.judge import NEW_FOR_S, AcceptRule, Verdict, is_hardly_ahead, judge
from edgevpr.runtime.recognise.levelling import AnyLevelling, NoLevelling, seen_as
from edgevpr.runtime.recognise.locate import HEARD, Located, at_place, located
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import Gate, NoGate
from edgevpr.runtime.recognise.verify import Verification, landmarks_of

_log = logging.getLogger(__name__)
_OF_CANDIDATES = 0.4  # are compared from each height but the first


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judged:
    """The ranking of a query after all that is known, its best place, the verdict on it, and what led to it."""

    ranking: Ranking | None = None
    best: Candidate | None = None
    verdict: Verdict | None = None
    proof: Agreement | None = None
    where: Located | None = None
    evidence: dict[str, float] | None = None
    followed: Followed | None = None


_NOT_JUDGED = _Judged()


class Recogniser:
    """Recognises places of an open map, frame after frame.

    `candidates` places are compared (None: all in full, see `places.retrieve.compare`). `gate` refuses frames that are
    not memorable, `mask` leaves parts of every frame out, and `levelling` lays each on the ground. `search` joins
    several queries, and `prior` narrows each; without them each query is ranked alone, over the whole map. `verify`
    holds the best place against its landmarks, where the map has some. `follower` follows the flight from query to
    query. The governor changes `candidates`; the learner and the governor change the index (`take`, `extend`).
    """

    def __init__(
        self,
        *,
        technique: Technique,
        place_map: PlaceMap,
        index: PlaceIndex,
        rule: AcceptRule,
        meter: QueryMeter,
        candidates: int | None = None,
        search: Search | None = None,
        prior: Prior | NoPrior | None = None,
        min_accuracy_m: float = 1.0,
        mask: AnyMask | None = None,
        gate: Gate | NoGate | None = None,
        levelling: AnyLevelling | None = None,
        verify: bool = True,
        follower: Follower | NoFollower | None = None,
    ) -> None:
        self.place_map, self.meter, self.candidates = place_map, meter, candidates
        self._prior, self._min_accuracy_m, self._mask = prior or NoPrior(), min_accuracy_m, mask or NoMask()
        self._gate, self._levelling, self._verifies = gate or NoGate(), levelling or NoLevelling(), verify
        self._follower = follower or NoFollower()
        self._told = 0  # number of places left out that an event has told of
        self._new: deque[tuple[int, float]] = deque()  # place id, and the time it was learnt at
        self.take(technique, index, rule, search or Alone())

    def take(self, technique: Technique, index: PlaceIndex, rule: AcceptRule, search: Search) -> None:
        """Recognise with these from the next frame on. Another form of the same vectors has other scores, and so other
        limits."""
        self.technique, self.rule, self.search = technique, rule, search
        self._take_index(index)

    def accept_with(self, precision: float) -> None:
        """Accept matches with this precision from the next frame on. A rule that goes by limits stays as it is."""
        if self.rule.sure:
            self.rule = replace(self.rule, sure=replace(self.rule.sure, precision=precision))

    def extend(self, index: PlaceIndex, place_id: int, t_mono_s: float) -> None:
        """Recognise in an index that has one place more, learnt from the frame taken at `t_mono_s`."""
        self._new.append((place_id, t_mono_s))
        self._take_index(index)

    def lose_index(self, error: Exception) -> None:
        """Fail every frame with this error until there is an index again (see `take`)."""
        self._lost = _sentence(error)

    def _take_index(self, index: PlaceIndex) -> None:
        self.index, self._lost = index, None
        # 1-sigma accuracy of a place as a fix: such a match cannot tell where between two places the aircraft is.
        self.accuracy_m = max(self._min_accuracy_m, index.spacing_m() or 0.0)

    def step(self, frame: Frame, vehicle: Vehicle | None = None) -> Recognition:
        """Recognise one frame; `vehicle` is the autopilot's report at that moment.

        Never raises an Exception: an error of a frame, a place or the technique becomes a refusal with its reason.
        """
        meter, technique, index = self.meter, self.technique, self.index
        worth = descriptor = hints = judged = nothing = objection = picture = None
        map_lost = False
        meter.begin()
        try:
            with meter.step("prepare"):
                picture = self._levelling.prepare(frame, vehicle, self._mask.fitted(frame.image))
            with meter.step("gate"):
                worth = self._gate.look(frame.image)
            with meter.step("encode"):
                descriptor = encoded(technique, picture.image, picture.mask)
            if self._lost:
                raise MapError(self._lost)
            nothing = says_nothing(descriptor, self.rule.min_quality)
            objection = nothing or (worth and worth.reason)
            self._follower.went_on(frame, vehicle)
            if not len(index):
                verdict = Verdict(False, "the map has no place yet")
            elif objection and self.search.length == 1:  # in a sequence it is searched for, to keep the others in step
                verdict = Verdict(False, objection)
                self._follower.saw_nothing(index)
            else:
                margin_m = max(self.accuracy_m, self.rule.neighbour_m)
                hints = self._prior.hints(seen_as(frame, picture.view), vehicle, index, margin_m)
                expected = replace(expected_of(hints, index), height_ratio=self._prior.height_ratio)
                ranking = self.search.follow(self._look(descriptor, expected), index, frame.t_mono_s)
                looked = Verification(technique.spec, picture, index, self.place_map)
                judged = self._judged(frame, ranking, looked)
                if not judged.verdict.accepted and self.search.length == 1 and self._prior.looks_again:
                    others = other_heights(technique.spec.height_ratios, self._prior.height_ratio)
                    for ratio in others:
                        # What spoke against the first look counts in the others as well.
                        look = self._look(descriptor, replace(expected, height_ratio=ratio), _OF_CANDIDATES)
                        ranking = together(ranking, look)
                    if others:
                        judged = self._judged(frame, ranking, looked)
                self._follower.settle()
                verdict = Verdict(False, objection) if objection else judged.verdict
                self._prior.learn(judged.best, verdict.accepted, frame.t_mono_s)
            failed = False
        except Exception as error:
            _log.debug("%s failed", frame.name, exc_info=True)
            verdict, failed = Verdict(False, _sentence(error)), True
            map_lost = isinstance(error, MapError) and not isinstance(error, PlaceError)
        judged = judged or _NOT_JUDGED
        where = judged.where if verdict.accepted else None
        sure, evidence = self.rule.sure, judged.evidence
        return Recognition(
            frame=frame,
            vehicle=vehicle,
            picture=picture,
            worth=worth,
            descriptor=descriptor,
            hints=hints,
            ranking=judged.ranking,
            best=judged.best,
            proof=judged.proof,
            evidence=evidence,
            followed=judged.followed,
            confidence=sure.confidence(evidence) if sure and evidence else None,
            accepted=verdict.accepted,
            reason=verdict.reason,
            says_nothing=nothing is not None,
            failed=failed,
            map_lost=map_lost,
            left_out=self._newly_left_out(),
            located=where,
            accuracy_m=max(self._min_accuracy_m, where.accuracy_m) if where else None,
            steps=meter.steps(),
            cost=meter.cost(),
        )

    def _look(self, descriptor: Descriptor, expected: Expected, part: float = 1.0) -> Ranking:
        """Search the map for a query, with a `part` of the candidates. Raises MapError and PlaceError as `compare`
        does."""
        candidates = self.candidates and max(1, round(part * self.candidates))
        with self.meter.step("scan"):
            self.place_map.require_unchanged()
            scanned = scan(self.technique, descriptor, self.index, expected)
        with self.meter.step("compare"):
            return compare(
                self.technique,
                descriptor,
                scanned,
                self.place_map,
                self.index,
                candidates=candidates,
                neighbour_m=self.rule.neighbour_m,
                expected=expected,
            )

    def _judged(
        self, frame: Frame, ranking: Ranking, looked: Verification, followed: Followed | None = None
    ) -> _Judged:
        """Judge the best place of a ranking, with its landmarks, what the places beside it say, and the flight so far:
        that may know better which place is the best (`followed`: it has been asked)."""
        index, place_map, cells, rule = self.index, self.place_map, self.technique.spec.cells, self.rule
        with self.meter.step("compare"):
            (best,) = named(ranking, index, place_map, first=1)
            is_new = self._is_new(best.place.place_id, frame.t_mono_s)
        where = proof = None
        is_worth_it = best.match.score >= rule.worth_a_look
        # The newest query of a sequence need not be sure by itself.
        if verifies := is_worth_it and self._verifies and self.search.length == 1 and cells is not None:
            with self.meter.step("verify"):
                proof = looked.proof(ranking)
        if is_worth_it:
            with self.meter.step("locate"):
                found = named(ranking, index, place_map, first=HEARD if cells else 1)
                where = located(found, cells, looked.picture.view, proof)
                if where is None and best.place.position:
                    where = at_place(best.place.position, self.accuracy_m)
        same = where.places if where else ()
        if verifies and proof and not same:
            with self.meter.step("verify"):
                same = looked.same_ground(ranking)
        evidence, rival = self._evidence(ranking, proof, same), 0
        if followed is None and evidence is not None:
            with self.meter.step("locate"):
                followed = self._follower.heard(ranking, index, evidence, rule.sure, where)
            if followed and followed.leads_from(int(ranking.slots[0])):
                return self._judged(frame, ranking.led_by(followed.slot), looked, followed)
        if verifies and proof and is_hardly_ahead(evidence):
            with self.meter.step("verify"):
                rival = looked.rival(ranking, rule.neighbour_m, same)
        sure = followed and followed.confidence
        verdict = judge(ranking, index, rule, self.search, is_new, proof, rival, where, evidence, sure)
        return _Judged(
            ranking=ranking,
            best=best,
            verdict=verdict,
            proof=proof,
            where=where,
            evidence=evidence,
            followed=followed,
        )

    def _evidence(self, ranking: Ranking, proof: Agreement | None, same: Sequence[int]) -> dict[str, float] | None:
        if self.rule.sure is None:
            return None
        if self.technique.spec.cells is None:
            return evidence_ahead(ranking, self.index, self.rule.neighbour_m)
        return evidence_down(ranking, self.index, self.rule.neighbour_m, proof, same)

    def landmarks(self, event: Recognition) -> bytes | None:
        """Return what a map keeps of the landmarks of a frame that becomes a place, None for a technique that does not
        look straight down."""
        return landmarks_of(self.technique, event.picture) if event.picture else None

    def unread(self, error: Exception) -> Recognition:
        """Return the event of a frame that could not even be read."""
        self.meter.begin()
        return Recognition(
            frame=None, reason=_sentence(error), failed=True, steps=self.meter.steps(), cost=self.meter.cost()
        )

    def _newly_left_out(self) -> tuple[tuple[int, str], ...]:
        found = self.place_map.left_out
        newly = tuple(islice(found.items(), self._told, None))
        self._told = len(found)
        return newly

    def _is_new(self, place_id: int, t_mono_s: float) -> bool:
        while self._new and t_mono_s - self._new[0][1] > NEW_FOR_S:
            self._new.popleft()
        return any(place_id == new for new, _ in self._new)


def _sentence(error: Exception) -> str:
    """Return the error as a sentence. An error that is not edgevpr's own is a fault of a technique or of a library."""
    if isinstance(error, EdgevprError):
        return str(error)
    return f"an unforeseen {type(error).__name__} ({error}): report it, with the output of --debug"
