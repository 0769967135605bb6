"""The instructions of `cohog` by what a flight does with them, from those of the parts that `work.py` names: the file
by which `edgevpr profile` estimates ARM boards."""

from collections.abc import Mapping
from typing import Any

from edgevpr.techniques import create

# The two maps whose scans were counted.
SMALL_MAP_PLACES = 1_000
LARGE_MAP_PLACES = 10_000
_CAMERAS = {"forward": "ahead", "nadir": "down"}


def compute_counts(parts: Mapping[str, float]) -> dict[str, Any]:
    """Return the content of the file."""
    content: dict[str, Any] = {}
    for camera, name in _CAMERAS.items():
        encode = parts[f"{name}: encode a frame"]
        small = parts[f"{name}: encode, and scan {SMALL_MAP_PLACES} places"] - encode
        large = parts[f"{name}: encode, and scan {LARGE_MAP_PLACES} places"] - encode
        scan_per_place = (large - small) / (LARGE_MAP_PLACES - SMALL_MAP_PLACES)
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
            "scan_once": small - SMALL_MAP_PLACES * scan_per_place,
        }
        content[camera] = {stage: round(count) for stage, count in work.items()}
    return content
