"""Instructions that the parts of a query take on an ARM core, counted by `make bench-arm64`.

A board whose profile says how many instructions a second one of its cores runs (`arm64_mips`) is estimated by them:
they are of its own instruction set, and no busy moment of this machine is in them.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from edgevpr.techniques import create

PATH = Path(__file__).with_name("counted.json")
SMALL, LARGE = 1_000, 10_000  # places of the two maps whose scans were counted
_CAMERAS = {"forward": "ahead", "nadir": "down"}
_ROUNDS = {"products": "micro-benchmark: a round of products", "passes": "micro-benchmark: a round of passes"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """Instructions of `cohog`, by the fields of `TechniqueCosts` of the same names."""

    encode: float
    match_per_place: float
    compare_once: float
    scan_per_place: float
    scan_once: float


def figures(parts: Mapping[str, float]) -> dict[str, Any]:
    """Return the content of the file, of the instructions of each part that `benchmarks/arm64/work.py` names."""
    found: dict[str, Any] = {}
    for camera, name in _CAMERAS.items():
        encode = parts[f"{name}: encode a frame"]
        small, large = (parts[f"{name}: encode, and scan {places} places"] - encode for places in (SMALL, LARGE))
        scan_per_place = (large - small) / (LARGE - SMALL)
        technique = create("cohog", {"camera": camera})
        full = technique.spec.in_full * (parts[f"{name}: read a place"] + parts[f"{name}: compare a place in full"])
        work = Work(
            encode=encode,
            match_per_place=(parts[f"{name}: a query"] - encode - large - full) / technique.candidates,
            compare_once=full,
            scan_per_place=scan_per_place,
            scan_once=small - SMALL * scan_per_place,
        )
        found[camera] = {stage: round(count) for stage, count in asdict(work).items()}
    return {**found, **{kind: round(parts[name]) for kind, name in _ROUNDS.items()}}


def of(name: str, parameters: Mapping[str, Any]) -> Work | None:
    """Return the counted work of a technique with these parameters; None where it was not counted."""
    usual = {"w1": 512, "w2": 16, "bins": 8, "entropy": "shannon", "matching": "displacement"}
    if name != "cohog" or any(parameters.get(key, value) != value for key, value in usual.items()):
        return None
    return Work(**_content()[parameters.get("camera", "forward")])


def rounds_hz(kind: str, mips: float) -> float:
    """Return how often a second a core of `mips` million instructions a second does a round of the micro-benchmark:
    `kind` is "products" or "passes" (see `power.speed`)."""
    return 1e6 * mips / _content()[kind]


@lru_cache(maxsize=1)
def _content() -> dict[str, Any]:
    return json.loads(PATH.read_text("utf-8"))
