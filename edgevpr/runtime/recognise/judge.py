"""The one judge: when a match is accepted as the place. A match that is not accepted moves nothing."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.config import MatchConfig
from edgevpr.contract import Technique
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking, elsewhere, margin
from edgevpr.places.sequence import Search, SequenceSearch

NEW_FOR_S = 30.0  # a place learnt so recently says only what the autopilot has just said

# They are many, so one of them is good by chance. With half the margin no wrong sequence of corridor was accepted from
# hog, seqslam or cohog, flown as it was mapped, twice as fast, or the other way. At half the speed cohog accepted
# places three away from the right one.
_OF_MARGIN_AT_OTHER_SPEEDS = 0.5
_LONGEST = 10


@dataclass(frozen=True, slots=True)
class AcceptRule:
    """Accept from `min_score` on, if the best place beats the best one farther than `neighbour_m` by `min_margin`."""

    min_score: float
    min_margin: float
    neighbour_m: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the best place is accepted as the place, and why (not), in a few words for the log."""

    accepted: bool
    reason: str


def accept_rule(technique: Technique, config: MatchConfig, length: int = 1) -> AcceptRule:
    """Take the configuration's figures, and the technique's own where it leaves them open.

    A technique's margin is that of one query. The mean score of a sequence of `length` varies less, as a mean does; of
    a long one not so much less, since queries that show the same ground are not independent.
    """
    own_margin = technique.min_margin
    if own_margin < 1:  # from 1 on nothing is to be accepted, in sequences neither
        own_margin /= math.sqrt(min(length, _LONGEST))
    return AcceptRule(
        technique.min_score if config.min_score is None else config.min_score,
        own_margin if config.min_margin is None else config.min_margin,
        config.neighbour_m,
    )


def judge(ranking: Ranking, index: PlaceIndex, rule: AcceptRule, search: Search, is_new: bool) -> Verdict:
    """Decide whether the best place of a ranking is accepted. `search` is what the ranking comes from; `is_new` is
    whether the best place was learnt within the last `NEW_FOR_S`."""
    if search.frames < search.length:
        return Verdict(False, f"the sequence has {search.frames} queries of {search.length} yet")
    score = float(ranking.scores[0])
    if not score >= rule.min_score:  # so written, a score that is no number is refused as well
        return Verdict(False, f"score {score:.3f} is below {rule.min_score:.3f}")
    if isinstance(search, SequenceSearch) and (objection := _lost_track(ranking, index, rule, search)):
        return Verdict(False, objection)
    ahead = margin(ranking, index, rule.neighbour_m)
    if ahead is None and rule.min_score == 0:
        return Verdict(False, "there is no place elsewhere to compare with, and this score alone says nothing")
    if ahead is not None and not ahead >= rule.min_margin:
        return Verdict(False, f"only {ahead:.3f} ahead of a place elsewhere, {rule.min_margin:.3f} needed")
    if is_new:  # a fix would bring the autopilot nothing, and make its errors look confirmed
        return Verdict(False, f"this place was learnt within the last {NEW_FOR_S:g} s and says nothing new")
    if ahead is None:
        return Verdict(True, f"score {score:.3f}; there is no place elsewhere to compare with")
    return Verdict(True, f"score {score:.3f}, {ahead:.3f} ahead of any place elsewhere")


def _lost_track(ranking: Ranking, index: PlaceIndex, rule: AcceptRule, search: SequenceSearch) -> str | None:
    """Say why the mean of a sequence is not to be believed, None where it is."""
    away = elsewhere(index, ranking.slots[0], np.arange(len(index)), rule.neighbour_m)
    if not search.goes_on(~away, rule.min_score):
        return "the newest queries no longer see what those before them saw"
    ahead_of_rivals = float(ranking.scores[0]) - float(search.rivals[away].max(initial=0))
    if not ahead_of_rivals >= _OF_MARGIN_AT_OTHER_SPEEDS * rule.min_margin:
        return f"only {ahead_of_rivals:.3f} ahead of a place elsewhere that is passed at another speed"
    return None
