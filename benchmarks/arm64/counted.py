"""Instruction counts of `cohog` by stage of a flight, computed from the counts of the parts in `work.py`: the content
of the file by which `edgevpr profile` estimates the speed of ARM boards."""

from collections.abc import Mapping
from typing import Any

from edgevpr.techniques import create

# Sizes of the two maps whose scans are counted.
SMALL_MAP_PLACES = 1_000
LARGE_MAP_PLACES = 10_000
_CAMERAS = {"forward": "ahead", "nadir": "down"}


def compute_counts(parts: Mapping[str, float]) -> dict[str, Any]:
    """Return the content of the file; `parts` are instruction counts by the name of the part."""
    content: dict[str, Any] = {}
    for camera, name in _CAMERAS.items():
        encode = parts[f"{name}: encode a frame"]
        small = parts[f"{name}: encode, and scan {SMALL_MAP_PLACES} places"] - encode
        large = parts[f"{name}: encode, and scan {LARGE_MAP_PLACES} places"] - encode
        scan_per_place = (large - small) / (LARGE_MAP_PLACES - SMALL_MAP_PLACES)
        technique = create("cohog", {"camera": camera})
        full = technique.spec.max_matches * (parts[f"{name}: read a place"] + parts[f"{name}: compare a place in full"])
        landmarks = 0.0
        if camera == "nadir":  # of the frame; matched with those of the best place and of the last frame
            landmarks = parts["flight: landmarks of a frame"] + 2 * parts["flight: odometry since the last frame"]
        work = {
            "encode": encode,
            "match_per_place": (parts[f"{name}: a query"] - encode - large - full) / technique.candidates,
            "compare_once": full + landmarks,
            "scan_per_place": scan_per_place,
            "scan_once": small - SMALL_MAP_PLACES * scan_per_place,
        }
        content[camera] = {stage: round(count) for stage, count in work.items()}
    return content
