"""Evidence, and a confidence for tests of what decides by it, without the figures of the shipped models."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.core.contract import PartSpec, TechniqueSpec
from edgevpr.places.index import PlaceIndex, allocate_index
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.confidence import Figures
from edgevpr.runtime.recognise.evidence import MAP_FIGURES
from edgevpr.runtime.recognise.judge import AcceptRule, ConfidenceRule

NEEDED = 0.9


@dataclass(frozen=True, slots=True)
class FixedModel:
    """A model of confidence that is told what to say of evidence; a match that is wrong is then of no place at all."""

    confidence: Callable[[Figures], float]
    of_map: Callable[[Figures], float] | None = None
    needed: float = NEEDED
    max_reported: float = 1.0

    def map_confidence(self, evidence: Figures) -> float:
        return (self.of_map or self.confidence)(evidence)

    def threshold(self, precision: float) -> float:
        return self.needed


def make_model(
    confidence: Callable[[Figures], float], of_map: Callable[[Figures], float] | None = None, needed: float = NEEDED
) -> ConfidenceRule:
    """The decision by a confidence that is told what to say."""
    return ConfidenceRule(dict.fromkeys(MAP_FIGURES, FixedModel(confidence, of_map, needed)), 0.999)


def make_rule(confidence: Callable[[Figures], float], needed: float = NEEDED, **limits: float) -> AcceptRule:
    """The rule that accepts a match whose confidence is `needed`."""
    no_limits = {"min_score": 0.0, "min_margin": 0.0, "neighbour_m": 50.0}
    return AcceptRule(confidence_rule=make_model(confidence, needed=needed), **no_limits | limits)


def make_bare_index(places: int) -> PlaceIndex:
    """An index of places without positions: neighbours are those beside each other."""
    return allocate_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), places, None)


def make_agreement(inliers: int, shift_share: tuple[float, float] = (0.1, 0.0), **more) -> Agreement:
    """An agreement of so many landmarks."""
    found = {"matched": 60, "possible": 250, "rotation_deg": 0.0, "scale": 1.0, "covariance_share2": (1e-4, 0.0, 1e-4)}
    return Agreement(inliers=inliers, shift_share=shift_share, **{"is_expected": True} | found | more)


def rate_landmarks(evidence: Figures) -> float:
    """Sure where ten landmarks agree as expected, whatever else is known."""
    return float(evidence.get("landmarks", 0.0) >= math.log1p(10))
