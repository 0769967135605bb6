"""One query in a map of 10 000 places: the scan of place codes and the vote over the best of them, against the vote
over all places, through the map file and the index that fly; and with what may be known beforehand. One thread; the
map is generated, its content random.
"""

import os

import base  # noqa: F401

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import statistics
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from bench_encode import frames, timed_s
from big_map import make_big_map

from edgevpr.core.contract import Technique
from edgevpr.core.types import Position
from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import NOTHING, Expected, compare, scan
from edgevpr.techniques import create

PLACES = 10_000
TURNS = 9
REACH_M = 300.0


@dataclass(frozen=True, slots=True)
class QueryRow:
    """Median seconds of a query, encoding included; `exact_s` and `ratio` are None where it would take minutes.
    `beside` says what was searched."""

    camera: str
    beside: str
    candidates: int
    encode_ms: float
    two_stage_ms: float
    exact_s: float | None
    ratio: float | None
    bytes_per_place: int


def rows(places: int = PLACES) -> list[QueryRow]:
    """`forward` looks ahead; `nadir` tries 24 rotations, or 3 where the heading is known."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    found = []
    for camera in ("forward", "nadir"):
        technique = create("cohog", {"camera": camera})
        with TemporaryDirectory() as folder:
            path = Path(folder) / "big.gpkg"
            make_big_map(path, technique.spec, places)
            with PlaceMap.open(path) as place_map:
                index = load_index(place_map, technique, 100_000_000)
                if camera == "forward":
                    found.append(measure("forward", "", technique, place_map, index))
                else:
                    found += looking_down(technique, place_map, index)
    cv2.setNumThreads(threads)
    return found


def looking_down(technique: Technique, place_map: PlaceMap, index: PlaceIndex) -> list[QueryRow]:
    # A map as it is flown, on parallel legs to and fro, with some sway.
    rng = np.random.default_rng(0)
    turned_deg = (rng.choice([0, 180], len(index)) + rng.normal(0, 5, len(index))) % 360
    near = index.within(Position(float(index.lat_deg.mean()), float(index.lon_deg.mean())), REACH_M)
    in_reach = f"{np.count_nonzero(near)} places within {REACH_M:.0f} m"
    cases = (
        ("nadir", "24 rotations", NOTHING),
        ("nadir, heading known", "3 rotations", Expected(turned_deg=turned_deg)),
        ("nadir, in reach", in_reach, Expected(in_reach=near)),
        ("nadir, both", f"{in_reach}, 3 rotations", Expected(near, turned_deg)),
    )
    return [measure(name, beside, technique, place_map, index, expected) for name, beside, expected in cases]


def measure(
    camera: str, beside: str, technique: Technique, place_map: PlaceMap, index: PlaceIndex, expected: Expected = NOTHING
) -> QueryRow:
    picture = frames()[0]

    def query(candidates: int | None) -> None:
        asked = technique.encode(picture)
        scanned = scan(technique, asked, index, expected)
        compare(technique, asked, scanned, place_map, index, candidates=candidates, expected=expected)

    query(technique.candidates)
    encode_s = statistics.median(timed_s(technique.encode, picture) for _ in range(TURNS))
    two_stage_s, exact_s = [], []
    for turn in range(TURNS):
        two_stage_s.append(timed_s(query, technique.candidates))
        if camera == "forward" and turn % 3 == 0:
            exact_s.append(timed_s(query, None))
    two_stage = statistics.median(two_stage_s)
    exact = statistics.median(exact_s) if exact_s else None
    return QueryRow(
        camera,
        beside,
        technique.candidates,
        1000 * encode_s,
        1000 * two_stage,
        exact,
        exact / two_stage if exact else None,
        bytes_per_place(technique.spec),
    )


def table(results: list[QueryRow]) -> str:
    """The results as a Markdown table."""
    lines = [
        f"| a query, {PLACES} places | candidates | encode ms | whole query ms | exact over all s | ratio "
        "| bytes a place in RAM |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in results:
        exact, ratio = (f"{row.exact_s:.1f}", f"{row.ratio:.0f}") if row.exact_s else ("not run", "")
        lines.append(
            f"| {row.camera} | {row.candidates} | {row.encode_ms:.1f} | {row.two_stage_ms:.0f} | {exact} | {ratio} "
            f"| {row.bytes_per_place} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(rows()))
