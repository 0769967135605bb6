"""A confidence for tests of what decides by it, without the figures of the shipped models."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.confidence.model import Evidence
from edgevpr.runtime.recognise.evidence import OF_MAP
from edgevpr.runtime.recognise.judge import AcceptRule, Sureness

NEEDED = 0.9


@dataclass(frozen=True, slots=True)
class Told:
    """A model of confidence that is told what to say of evidence."""

    confidence: Callable[[Evidence], float]

    def threshold(self, precision: float) -> float:
        return NEEDED


def sure_rule(confidence: Callable[[Evidence], float], **limits: float) -> AcceptRule:
    """The rule that accepts a match whose confidence is `NEEDED`."""
    sure = Sureness(dict.fromkeys(OF_MAP, Told(confidence)), 0.999)
    return AcceptRule(**{"min_score": 0.0, "min_margin": 0.0, "neighbour_m": 50.0, "sure": sure, **limits})


def landmarks_count(evidence: Evidence) -> float:
    """Sure where ten landmarks agree as expected, whatever else is known."""
    return float(evidence.get("landmarks", 0.0) >= math.log1p(10))
