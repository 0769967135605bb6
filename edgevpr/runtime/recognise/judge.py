"""The one judge: decides when a match is accepted as the place. A match that is not accepted carries no position."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.config import MatchConfig
from edgevpr.contract import FineMatch, Technique
from edgevpr.landmarks.agreement import PROVEN, Agreement
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking, elsewhere, margin
from edgevpr.places.sequence import Search, SequenceSearch
from edgevpr.runtime.recognise.locate import Located

NEW_FOR_S = 30.0  # seconds; a place learnt so recently only repeats what the autopilot has just said

# Trajectories at other speeds are many, so one of them scores well by chance: half the margin over them is enough. With
# it, no wrong sequence of the corridor set was accepted from hog, seqslam or cohog, flown as it was mapped, twice as
# fast, or the other way. At half the speed cohog accepted places three away from the right one.
_OF_MARGIN_AT_OTHER_SPEEDS = 0.5
_LONGEST = 10

# Least share of a place's regions that agree, each counted once. Of 961 regions, 48 or more did in every right match of
# all sets, and 30 at most in the best matches of pictures that are of no place of the map.
_MIN_COVERAGE = 0.04

# Looking down, a place elsewhere that agrees without any step or rotation, as the best one does, shares with it what is
# drawn over every frame. Such places scored .14 or more behind a display, and .05 or less in all sets without one.
_DISPLAY_SCORE = 0.08
_AT_REST_CELLS = 1.5
_AT_REST_DEG = 7.5
_AT_REST_HEIGHT = 0.2

# A match that scores so much has landmarks that agree: all of the 413 right ones that do, of all sets from the air, had
# six or more. Weaker ones, of grass under other light, may have none. Asked where both pictures have enough of them.
_CLEAR_SCORE, _LEAST_INLIERS, _LANDMARKS_ENOUGH = 0.2, 5, 100
# Landmarks that agree make up for a score that is too low, down to so much of it.
_OF_SCORE_WHEN_PROVEN = 0.5


@dataclass(frozen=True, slots=True)
class AcceptRule:
    """Least score, and least lead over the best place farther away than `neighbour_m` metres, of an accepted match; and
    least quality of its picture."""

    min_score: float
    min_margin: float
    neighbour_m: float
    min_quality: float = 0.0


ACCEPT_NOTHING = AcceptRule(min_score=1.0, min_margin=1.0, neighbour_m=0.0)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision on the best place: accepted as the place or not, and the reason in a few words for the log. `is_open`:
    it was refused for what landmarks may make up for."""

    accepted: bool
    reason: str
    is_open: bool = False


def accept_rule(technique: Technique, config: MatchConfig, length: int = 1) -> AcceptRule:
    """Return the configuration's limits, and the technique's own where the configuration leaves them open.

    A technique's margin is that of one query. The mean score of `length` queries varies less, so the margin of a
    sequence is divided by the root of its length. Lengths above ten count as ten: queries that show the same ground are
    not independent.
    """
    own_margin = technique.min_margin
    if own_margin < 1:  # a margin of 1 or more accepts nothing, not in sequences either
        own_margin /= math.sqrt(min(length, _LONGEST))
    return AcceptRule(
        technique.min_score if config.min_score is None else config.min_score,
        own_margin if config.min_margin is None else config.min_margin,
        config.neighbour_m,
        technique.min_quality,
    )


def judge(
    ranking: Ranking,
    index: PlaceIndex,
    rule: AcceptRule,
    search: Search,
    is_new: bool,
    proof: Agreement | None = None,
    rival: int = 0,
    where: Located | None = None,
) -> Verdict:
    """Decide whether the best place of a ranking is accepted.

    `search` is the search that made the ranking; `is_new` tells whether the best place was learnt within the last
    `NEW_FOR_S` seconds. `proof` is how the landmarks of query and place agree (None: nothing is known of it), and
    `rival` the number of those of the best place elsewhere that agree. `where` is the position that the best places say
    together (None: only that of the best one is known); a place that says the same as the best one is no rival.
    """
    proven = proof is not None and _proves(proof, rival)
    may_be_proven = proof is None and search.length == 1 and rule.min_margin < 1
    if search.frames < search.length:
        return Verdict(False, f"the sequence has {search.frames} queries of {search.length} yet")
    score = float(ranking.scores[0])
    least = rule.min_score * (_OF_SCORE_WHEN_PROVEN if proven else 1)
    if not score >= least:  # `not >=` refuses NaN as well
        is_open = may_be_proven and score >= rule.min_score * _OF_SCORE_WHEN_PROVEN
        return Verdict(False, f"score {score:.3f} is below {least:.3f}", is_open)
    if isinstance(search, SequenceSearch) and (objection := _lost_track(ranking, index, rule, search)):
        return Verdict(False, objection)
    if len(ranking.unread):
        return Verdict(False, "a place that cannot be read may be the right one")
    ahead = margin(ranking, index, rule.neighbour_m, where.places if where else ())
    if ahead is None and rule.min_score == 0:
        return Verdict(False, "there is no place elsewhere to compare with, and this score alone says nothing")
    if not proven and ahead is not None and not ahead >= rule.min_margin:
        reason = f"only {ahead:.3f} ahead of a place elsewhere, {rule.min_margin:.3f} needed"
        return Verdict(False, reason, may_be_proven)
    if not proven and search.length == 1 and (objection := _covers_little(ranking)):
        return Verdict(False, objection, may_be_proven)
    if search.length == 1 and (objection := _is_display(ranking, index, rule)):
        return Verdict(False, objection)
    if proof is not None and (objection := _disproves(proof, score)):
        return Verdict(False, objection)
    if where and where.objection:
        return Verdict(False, where.objection)
    if is_new:  # a fix would only repeat the autopilot's position, and make its errors look confirmed
        return Verdict(False, f"this place was learnt within the last {NEW_FOR_S:g} s and says nothing new")
    landmarks = f"; {proof.inliers} landmarks agree" if proof else ""
    if ahead is None:
        return Verdict(True, f"score {score:.3f}; there is no place elsewhere to compare with{landmarks}")
    return Verdict(True, f"score {score:.3f}, {ahead:.3f} ahead of any place elsewhere{landmarks}")


def _proves(proof: Agreement, rival: int) -> bool:
    """Tell whether landmarks alone show that it is the place. Those that have not moved may be a display, and where a
    place elsewhere has half as many that agree, the ground repeats itself."""
    return proof.is_expected and not proof.is_at_rest and proof.inliers >= max(PROVEN, 2 * rival)


def _disproves(proof: Agreement, score: float) -> str | None:
    """Return the reason why landmarks show that it is another place, None where they do not."""
    if not proof.is_expected:
        return f"its landmarks lie otherwise than its regions: {proof.inliers} agree on another step"
    if score >= _CLEAR_SCORE and proof.inliers < _LEAST_INLIERS and proof.possible >= _LANDMARKS_ENOUGH:
        return f"its landmarks do not agree: {proof.inliers} do, and {_LEAST_INLIERS} are needed where so much does"
    return None


def _covers_little(ranking: Ranking) -> str | None:
    """Return the reason why too little of the best place agrees, None where enough does. It is not asked in a sequence,
    where the newest query need not be sure by itself."""
    match = ranking.compared.get(int(ranking.slots[0]))
    if match is None or match.coverage is None or match.coverage >= _MIN_COVERAGE:
        return None
    return f"only {match.coverage:.1%} of the place agrees, {_MIN_COVERAGE:.0%} needed"


def _is_display(ranking: Ranking, index: PlaceIndex, rule: AcceptRule) -> str | None:
    """Return the reason why what agrees may be a display over every frame, None where nothing points to one. Only a
    camera that looks down can tell: ahead, places one after the other agree without a step."""
    if not _at_rest(ranking.compared.get(int(ranking.slots[0]))):
        return None
    others = ranking.slots[elsewhere(index, ranking.slots[0], ranking.slots, rule.neighbour_m)]
    matches = (ranking.compared.get(slot) for slot in others.tolist())
    if not any(_at_rest(match) and match.score >= _DISPLAY_SCORE for match in matches):
        return None
    return "a place elsewhere has not moved either, as behind a display: learn a mask with `edgevpr check --learn-mask`"


def _at_rest(match: FineMatch | None) -> bool:
    if match is None or match.rotation_deg is None or match.shift_cells is None:
        return False
    off_deg = abs((match.rotation_deg + 180) % 360 - 180)
    if off_deg > _AT_REST_DEG or abs((match.height_ratio or 1.0) - 1) > _AT_REST_HEIGHT:
        return False
    return max(map(abs, match.shift_cells)) <= _AT_REST_CELLS


def _lost_track(ranking: Ranking, index: PlaceIndex, rule: AcceptRule, search: SequenceSearch) -> str | None:
    """Return the reason why the mean of a sequence is not to be believed, None where there is none."""
    away = elsewhere(index, ranking.slots[0], np.arange(len(index)), rule.neighbour_m)
    if not search.goes_on(~away, rule.min_score):
        return "the newest queries no longer see what those before them saw"
    ahead_of_rivals = float(ranking.scores[0]) - float(search.rivals[away].max(initial=0))
    if not ahead_of_rivals >= _OF_MARGIN_AT_OTHER_SPEEDS * rule.min_margin:
        return f"only {ahead_of_rivals:.3f} ahead of a place elsewhere that is passed at another speed"
    return None
