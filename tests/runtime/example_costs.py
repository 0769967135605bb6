"""Costs and accuracies in round figures, like those of cohog (many regions) and of hog (a long vector in RAM)."""

from edgevpr.core.types import StageCost
from edgevpr.runtime.preflight.probe import TechniqueCosts

REGIONS = TechniqueCosts(
    encode=StageCost(0.1, 0.1),
    match_per_place=StageCost(0.004, 0.004),
    ram_bytes_per_place=1_000,
    disk_bytes_per_place=124_000,
    process_mb=90.0,
)
VECTOR = TechniqueCosts(
    encode=StageCost(0.05, 0.05),
    match_per_place=StageCost(0.001, 0.001),
    ram_bytes_per_place=286_000,
    disk_bytes_per_place=286_000,
    process_mb=90.0,
)


def make_accuracy(recall, wrong=0):
    """What was measured of a technique on two image sets."""
    accepted = {"accepted": 30, "accepted_wrong": wrong, "accepted_elsewhere": wrong}
    return {"recall_at_1": recall, "sets": 2, "queries": 100, "asked": 120, **accepted}
