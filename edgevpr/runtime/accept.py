"""When a match is accepted as the place. A match that is not accepted moves nothing."""

from dataclasses import dataclass

from edgevpr.config import MatchConfig
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking, margin
from edgevpr.types import Technique


@dataclass(frozen=True, slots=True)
class AcceptRule:
    """Accept from `min_score` on, if the best place beats the best one farther than `neighbour_m` by `min_margin`."""

    min_score: float
    min_margin: float
    neighbour_m: float


def accept_rule(technique: Technique, config: MatchConfig) -> AcceptRule:
    """The configuration's figures, and the technique's own where it leaves them open."""
    return AcceptRule(
        technique.min_score if config.min_score is None else config.min_score,
        technique.min_margin if config.min_margin is None else config.min_margin,
        config.neighbour_m,
    )


def accepted(ranking: Ranking, index: PlaceIndex, rule: AcceptRule) -> tuple[bool, str]:
    """Whether the best place is accepted, and why (not), in a few words for the log."""
    score = float(ranking.scores[0])
    if not score >= rule.min_score:  # so written, a score that is no number is refused as well
        return False, f"score {score:.3f} is below {rule.min_score:.3f}"
    ahead = margin(ranking, index, rule.neighbour_m)
    if ahead is None:
        if rule.min_score == 0:
            return False, "there is no place elsewhere to compare with, and this score alone says nothing"
        return True, f"score {score:.3f}; there is no place elsewhere to compare with"
    if not ahead >= rule.min_margin:
        return False, f"only {ahead:.3f} ahead of a place elsewhere, {rule.min_margin:.3f} needed"
    return True, f"score {score:.3f}, {ahead:.3f} ahead of any place elsewhere"
