"""Evidence of a match: the figures from which its confidence is made (see `confidence.model`).

There are three kinds, since a camera that looks ahead sees other things than one that looks straight down, and not
every map has landmarks. All figures are larger the more they speak for the match, but for `rank_gap`.

* agree: log of the share of regions that agree on a step; ahead, of the geometric mean of both ways
* lead: how far that is above the best place elsewhere
* lead_around: the same, of the mean of a place with the one before and the one after it (ahead)
* coverage: log of the share of the place's regions that agree, each counted once
* mutual, mutual_best: log of the share of regions that find each other, and whether no place elsewhere has more (ahead)
* rank_gap: how much better the regions of another place rank at its step (ahead)
* back, likeness: see `Support` (ahead)
* landmarks: log of one more than the landmarks that agree as expected (down)
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from edgevpr.core.contract import TechniqueSpec
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.confidence import Model

AHEAD, DOWN, DOWN_BARE = "ahead", "down", "down_bare"
_LOOKING_DOWN = {DOWN: ("agree", "lead", "coverage", "landmarks"), DOWN_BARE: ("agree", "lead", "coverage")}
# What tells whether a query shows ground of the map, and which of its places it shows.
OF_MAP = {AHEAD: ("mutual", "coverage", "back", "likeness"), **_LOOKING_DOWN}
OF_PLACE = {AHEAD: ("agree", "lead", "lead_around", "mutual_best", "coverage", "rank_gap"), **_LOOKING_DOWN}
WITH_CONFIDENCE = "cohog"  # the technique that gives evidence, for want of its spec (see `kinds_of`)
_LEAST = 1e-3  # of a share whose logarithm is taken
_BY_CHANCE = 0.07  # a share that pictures of foreign ground reach, where there is no place elsewhere to compare with
_BESIDE = 0.5  # weight of either neighbour


def kinds_of(spec: TechniqueSpec) -> tuple[str, ...]:
    """Return the kinds of evidence that a technique gives; none for one that is judged by its limits."""
    if spec.cells is not None:
        return DOWN, DOWN_BARE
    return (AHEAD,) if spec.scan_counts else ()


def kind_of(evidence: Mapping[str, float]) -> str:
    """Return the kind of some evidence."""
    if "likeness" in evidence:
        return AHEAD
    return DOWN if "landmarks" in evidence else DOWN_BARE


def require_usable(kind: str, model: Model) -> None:
    """Raise ValueError for a model of a kind, or with evidence, that there is not (it comes from another edgevpr), and
    ValueError or ArithmeticError for figures that make no sense."""
    if kind not in OF_MAP:
        raise ValueError(f"there is no evidence of kind {kind!r:.40}")
    for name in (*model.of_map.names, *model.of_place.names):
        if name not in OF_MAP[kind] + OF_PLACE[kind]:
            raise ValueError(f"there is no evidence {name!r:.40} of kind {kind}")
    for value in (-1.0, 0.0, 1.0):
        model.confidence(dict.fromkeys(OF_MAP[kind] + OF_PLACE[kind], value))
    model.threshold(0.5), model.threshold(0.999999)


def said(evidence: Mapping[str, float]) -> str:
    """Say the evidence of a match in words, for the log."""
    ahead = (
        f"{math.exp(evidence['lead']):.2f} times as many regions agree as elsewhere ({math.exp(evidence['agree']):.1%})"
    )
    if "landmarks" in evidence:
        return f"{ahead}, {math.expm1(evidence['landmarks']):.0f} landmarks agree"
    return f"{ahead}, {math.exp(evidence['coverage']):.1%} of the place agrees"


def evidence_ahead(ranking: Ranking, index: PlaceIndex, neighbour_m: float) -> dict[str, float] | None:
    """Return the evidence of the best place of a ranking, of a camera that looks ahead; None where there is none."""
    slots = [slot for slot in ranking.slots.tolist() if slot in ranking.compared]
    matches = {slot: ranking.compared[slot] for slot in slots}
    if not slots or any(match.support is None for match in matches.values()):
        return None
    best = slots[0]
    away = _away(index, best, slots, neighbour_m)
    agree = {slot: math.sqrt(match.score * match.support.back) for slot, match in matches.items()}
    score = {slot: match.score for slot, match in matches.items()}
    mutual = {slot: match.support.mutual for slot, match in matches.items()}
    around = _with_neighbours(score)
    support = matches[best].support
    most_mutual = max(mutual, key=mutual.get)
    return {
        "agree": _log(agree[best]),
        "lead": _lead(agree, best, away),
        "lead_around": _lead(around, best, away),
        "coverage": _log(matches[best].coverage or 0.0),
        "mutual": _log(support.mutual),
        "mutual_best": float(most_mutual not in away),
        "rank_gap": support.log_rank - min(match.support.log_rank for match in matches.values()),
        "back": _log(support.back),
        "likeness": support.likeness,
    }


def evidence_down(
    ranking: Ranking,
    index: PlaceIndex,
    neighbour_m: float,
    proof: Agreement | None,
    same: Sequence[int] = (),
) -> dict[str, float] | None:
    """Return the evidence of the best place of a ranking, of a camera that looks straight down; None where there is
    none. `proof` is how its landmarks agree (None: nothing is known of them). The places numbered `same` show the same
    ground, and are not elsewhere."""
    slots = [slot for slot in ranking.slots.tolist() if slot in ranking.compared]
    if not slots:
        return None
    best = slots[0]
    score = {slot: ranking.compared[slot].score for slot in slots}
    evidence = {
        "agree": _log(score[best]),
        "lead": _lead(score, best, _away(index, best, slots, neighbour_m, same)),
        "coverage": _log(ranking.compared[best].coverage or 0.0),
    }
    if proof is not None:
        evidence["landmarks"] = math.log1p(proof.inliers if proof.is_expected and not proof.is_at_rest else 0)
    return evidence


def _away(
    index: PlaceIndex, best: int, slots: Sequence[int], neighbour_m: float, same: Sequence[int] = ()
) -> frozenset[int]:
    """Return those of the slots that are elsewhere."""
    slots = np.array(slots)
    return frozenset(slots[elsewhere(index, best, slots, neighbour_m, same)].tolist())


def _lead(share: dict[int, float], best: int, away: frozenset[int]) -> float:
    return _log(share[best]) - _log(max((share[slot] for slot in away), default=_BY_CHANCE))


def _with_neighbours(share: dict[int, float]) -> dict[int, float]:
    """Return the weighted mean of each place with the one before and the one after it in the index. One that was not
    compared counts as the least of those that were."""
    least = min(share.values())
    return {
        slot: (own + _BESIDE * (share.get(slot - 1, least) + share.get(slot + 1, least))) / (1 + 2 * _BESIDE)
        for slot, own in share.items()
    }


def _log(share: float) -> float:
    return math.log(max(share, _LEAST))
