"""When a match is accepted as the place. A match that is not accepted moves nothing."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.config import MatchConfig
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking, elsewhere, margin
from edgevpr.places.sequence import Sequence
from edgevpr.types import Technique

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


def accept_rule(technique: Technique, config: MatchConfig, length: int = 1) -> AcceptRule:
    """The configuration's figures, and the technique's own where it leaves them open.

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


def accepted(
    ranking: Ranking, index: PlaceIndex, rule: AcceptRule, sequence: Sequence | None = None
) -> tuple[bool, str]:
    """Whether the best place is accepted, and why (not), in a few words for the log. `sequence` is the one that the
    ranking comes from, where there is one."""
    if sequence and sequence.frames < sequence.length:
        return False, f"the sequence has {sequence.frames} queries of {sequence.length} yet"
    score = float(ranking.scores[0])
    if not score >= rule.min_score:  # so written, a score that is no number is refused as well
        return False, f"score {score:.3f} is below {rule.min_score:.3f}"
    if sequence:
        away = elsewhere(index, ranking.slots[0], np.arange(len(index)), rule.neighbour_m)
        if not sequence.goes_on(~away, rule.min_score):
            return False, "the newest queries no longer see what those before them saw"
        ahead_of_rivals = score - float(sequence.rivals[away].max(initial=0))
        if not ahead_of_rivals >= _OF_MARGIN_AT_OTHER_SPEEDS * rule.min_margin:
            return False, f"only {ahead_of_rivals:.3f} ahead of a place elsewhere that is passed at another speed"
    ahead = margin(ranking, index, rule.neighbour_m)
    if ahead is None:
        if rule.min_score == 0:
            return False, "there is no place elsewhere to compare with, and this score alone says nothing"
        return True, f"score {score:.3f}; there is no place elsewhere to compare with"
    if not ahead >= rule.min_margin:
        return False, f"only {ahead:.3f} ahead of a place elsewhere, {rule.min_margin:.3f} needed"
    return True, f"score {score:.3f}, {ahead:.3f} ahead of any place elsewhere"
