"""The instructions of `cohog` by what a flight does with them, from those of the parts that `work.py` names: the file
by which `edgevpr profile` estimates ARM boards."""

from collections.abc import Mapping
from typing import Any

from edgevpr.techniques import create

SMALL, LARGE = 1_000, 10_000  # places of the two maps whose scans were counted
_CAMERAS = {"forward": "ahead", "nadir": "down"}


def figures(parts: Mapping[str, float]) -> dict[str, Any]:
    """Return the content of the file."""
    content: dict[str, Any] = {}
    for camera, name in _CAMERAS.items():
        encode = parts[f"{name}: encode a frame"]
        small, large = (parts[f"{name}: encode, and scan {places} places"] - encode for places in (SMALL, LARGE))
        scan_per_place = (large - small) / (LARGE - SMALL)
        technique = create("cohog", {"camera": camera})
        full = technique.spec.max_matches * (parts[f"{name}: read a place"] + parts[f"{name}: compare a place in full"])
        landmarks = 0.0
        if camera == "nadir":  # those of the frame, held against the best place's and the last frame's
            landmarks = parts["flight: landmarks of a frame"] + 2 * parts["flight: the stride since the frame before"]
        work = {
            "encode": encode,
            "match_per_place": (parts[f"{name}: a query"] - encode - large - full) / technique.candidates,
            "compare_once": full + landmarks,
            "scan_per_place": scan_per_place,
            "scan_once": small - SMALL * scan_per_place,
        }
        content[camera] = {stage: round(count) for stage, count in work.items()}
    return content
