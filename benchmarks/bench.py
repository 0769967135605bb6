"""Every speed and memory figure in one run: `make bench` writes benchmarks/results/bench.md and bench.json.

Stages of a query of `cohog`, on one thread, and beside the scan the vote over all places. Frames, 640x480 grey, come
from the generated scene and, where they are at hand, from image sets. Large maps are generated, their content random.
The whole program is that of `bench_flight.py`. On a busy machine times do not hold.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import base
import bench_flight
import cv2
import numpy as np
from base import DATA, Row
from big_map import make_big_map

from edgevpr.core.contract import Technique
from edgevpr.core.types import Position
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.places.index import PlaceIndex, compute_place_bytes, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import NO_EXPECTATION, Expectation, Query, compare_places, scan_index
from edgevpr.techniques import create

PLACES = 10_000
REACH_M = 300.0
FRAME = (640, 480)  # width and height
FRAMES_A_SET = 2
ENCODE_TURNS = 10
MATCH_TURNS = 15
QUERY_TURNS = 9
REFERENCES = 60
COLUMNS = {
    "encode": {
        "encode `cohog`": "{entropy}",
        "ms": "{ours_ms:.2f}",
    },
    "match": {
        "compare one place": "{references} references",
        "ms": "{ours_ms:.2f}",
    },
    "two_stage": {
        "a query, 10 000 places": "{camera}",
        "candidates": "{candidates}",
        "encode ms": "{encode_ms:.1f}",
        "whole query ms": "{two_stage_ms:.0f}",
        "exact over all s": "{exact_s:.1f}",
        "ratio": "{ratio:.0f}",
        "bytes a place in RAM": "{bytes_per_place}",
    },
    "flight": {
        "`edgevpr run`, cohog, 10 000 places": "{what}",
        "measured": "{value:.3g} {unit}",
        "target": "< {target:g} {unit}",
    },
}


def frames() -> list[np.ndarray]:
    """Return generated frames and real ones, uint8 (480, 640)."""
    ground = cv2.cvtColor(make_scene(seed=3, width_m=220, depth_m=170).albedo, cv2.COLOR_BGR2GRAY)
    found = [ground[top : top + FRAME[1], left : left + FRAME[0]] for top, left in ((100, 100), (500, 600))]
    for folder in sorted(DATA.glob("*/query")):
        paths = sorted(folder.iterdir())
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths[:: -(-len(paths) // FRAMES_A_SET)]]
        large_enough = [image for image in images if image is not None and min(image.shape) >= 100]
        found += [cv2.resize(image, FRAME, interpolation=cv2.INTER_AREA) for image in large_enough]
    return found


def timed_s(function: Callable, *arguments: object) -> float:
    """Return the wall time of a call right after another: the first pays for the caches and the memory that the others
    left."""
    function(*arguments)
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def encode_rows() -> Iterator[Row]:
    """Encode each frame with both definitions of entropy."""
    for entropy in ("shannon", "filled_bins"):
        technique = create("cohog", {"entropy": entropy})
        times_s = [timed_s(technique.encode, picture) for picture in frames() for _ in range(ENCODE_TURNS)]
        yield {"entropy": entropy, "ours_ms": 1000 * statistics.median(times_s)}


def match_rows() -> Iterator[Row]:
    """Compare one place in full, with the displacement vote. Each reference is another picture, as in a map."""
    technique, pictures = create("cohog"), frames()
    # Shifted copies stand in where there are too few pictures: the time does not depend on what they show.
    places = [technique.encode(np.roll(pictures[at % len(pictures)], at)) for at in range(REFERENCES)]
    query = technique.encode(pictures[0])
    times_s = [
        timed_s(lambda: [technique.match(query, place.fine, None) for place in places]) for _ in range(MATCH_TURNS)
    ]
    yield {"references": REFERENCES, "ours_ms": 1000 * statistics.median(times_s) / REFERENCES}


@contextmanager
def opened(camera: str) -> Iterator[tuple[Technique, PlaceMap, PlaceIndex]]:
    """Make and open a large map."""
    technique = create("cohog", {"camera": camera})
    with TemporaryDirectory() as folder:
        make_big_map(Path(folder) / "big.gpkg", technique.spec, PLACES)
        with PlaceMap.open(Path(folder) / "big.gpkg") as place_map:
            yield technique, place_map, load_index(place_map, technique, 100_000_000)


def query_rows() -> Iterator[Row]:
    """Ask one query, encoding included, in a large map: the scan and the vote over the best places, looking ahead
    against the vote over all (`exact_s`); looking down with what may be known beforehand, which `beside` tells."""
    with opened("forward") as large:
        yield _query(large, "forward", "", NO_EXPECTATION)
    with opened("nadir") as large:
        index = large[2]
        # A map as it is flown, on parallel legs to and fro, with some sway.
        rng = np.random.default_rng(0)
        rotation_deg = (rng.choice([0, 180], len(index)) + rng.normal(0, 5, len(index))) % 360
        near = index.find_within(Position(float(index.lat_deg.mean()), float(index.lon_deg.mean())), REACH_M)
        in_reach = f"{np.count_nonzero(near)} places within {REACH_M:.0f} m"
        yield _query(large, "nadir", "24 rotations", NO_EXPECTATION)
        yield _query(large, "nadir, heading known", "3 rotations", Expectation(rotation_deg=rotation_deg))
        yield _query(large, "nadir, in reach", in_reach, Expectation(in_reach=near))
        yield _query(large, "nadir, both", f"{in_reach}, 3 rotations", Expectation(near, rotation_deg))


def _query(large: tuple[Technique, PlaceMap, PlaceIndex], camera: str, beside: str, expected: Expectation) -> Row:
    (technique, place_map, index), picture = large, frames()[0]

    def query(candidates: int | None) -> None:
        asked = Query(
            technique=technique,
            descriptor=technique.encode(picture),
            place_map=place_map,
            index=index,
            expected=expected,
        )
        compare_places(asked, scan_index(asked), candidates)

    query(technique.candidates)
    encode_s = statistics.median(timed_s(technique.encode, picture) for _ in range(QUERY_TURNS))
    two_stage_s, exact_s = [], []
    for turn in range(QUERY_TURNS):
        two_stage_s.append(timed_s(query, technique.candidates))
        if camera == "forward" and turn % 3 == 0:
            exact_s.append(timed_s(query, None))
    two_stage, exact = statistics.median(two_stage_s), statistics.median(exact_s) if exact_s else None
    return {
        "camera": camera,
        "beside": beside,
        "candidates": technique.candidates,
        "encode_ms": 1000 * encode_s,
        "two_stage_ms": 1000 * two_stage,
        "exact_s": exact,  # None where it would take minutes
        "ratio": exact / two_stage if exact else None,
        "bytes_per_place": compute_place_bytes(technique.spec),
    }


def main() -> None:
    found = base.made_by()
    rows_of = {"encode": encode_rows, "match": match_rows, "two_stage": query_rows, "flight": bench_flight.rows}
    for name, rows in rows_of.items():
        found[name] = list(rows())
    base.write("bench", found, page(found))


def page(found: Row) -> str:
    """Return the page for people."""
    ran_on = found["machine"]
    tables = {name: base.table(found[name], columns) for name, columns in COLUMNS.items()}
    return f"""# Speed and memory

Made by `make bench` on {found["date"]}, commit {found["commit"]}.
Machine: {ran_on["cpu"]}, {ran_on["cores"]} cores; one thread; Python {ran_on["python"]}, NumPy {ran_on["numpy"]},
OpenCV {ran_on["opencv"]}. Medians.

## Encoding a frame

{tables["encode"]}

## Comparing one place in full

{tables["match"]}

## A query over 10 000 places

{tables["two_stage"]}

## The whole program

{tables["flight"]}
"""


if __name__ == "__main__":
    base.run(main)
