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
MAX_DISTANCE_M = 300.0
FRAME_PX = (640, 480)  # width and height
FRAMES_PER_SET = 2
ENCODE_REPEATS = 10
MATCH_REPEATS = 15
QUERY_REPEATS = 9
REFERENCES = 60
COLUMNS = {
    "encode": {"encode `cohog`": "{entropy}", "ms": "{ours_ms:.2f}"},
    "match": {"compare one place": "{references} references", "ms": "{ours_ms:.2f}"},
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


def load_frames() -> list[np.ndarray]:
    """Return generated frames and real ones, uint8 (480, 640)."""
    ground = cv2.cvtColor(make_scene(seed=3, width_m=220, depth_m=170).albedo, cv2.COLOR_BGR2GRAY)
    frames = [ground[top : top + FRAME_PX[1], left : left + FRAME_PX[0]] for top, left in ((100, 100), (500, 600))]
    for folder in sorted(DATA.glob("*/query")):
        paths = sorted(folder.iterdir())
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths[:: -(-len(paths) // FRAMES_PER_SET)]]
        large_enough = [image for image in images if image is not None and min(image.shape) >= 100]
        frames += [cv2.resize(image, FRAME_PX, interpolation=cv2.INTER_AREA) for image in large_enough]
    return frames


def time_call_s(function: Callable, *arguments: object) -> float:
    """Return the wall time of a call right after another: the first pays for the caches and the memory that the others
    left."""
    function(*arguments)
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def measure_encoding() -> Iterator[Row]:
    """Encode each frame with both definitions of entropy."""
    for entropy in ("shannon", "filled_bins"):
        technique = create("cohog", {"entropy": entropy})
        times_s = [time_call_s(technique.encode, picture) for picture in load_frames() for _ in range(ENCODE_REPEATS)]
        yield {"entropy": entropy, "ours_ms": 1000 * statistics.median(times_s)}


def measure_matching() -> Iterator[Row]:
    """Compare one place in full, with the displacement vote. Each reference is another picture, as in a map."""
    technique, pictures = create("cohog"), load_frames()
    # Shifted copies stand in where there are too few pictures: the time does not depend on what they show.
    places = [technique.encode(np.roll(pictures[place % len(pictures)], place)) for place in range(REFERENCES)]
    query = technique.encode(pictures[0])
    repeats = range(MATCH_REPEATS)
    times_s = [time_call_s(lambda: [technique.match(query, place.fine, None) for place in places]) for _ in repeats]
    yield {"references": REFERENCES, "ours_ms": 1000 * statistics.median(times_s) / REFERENCES}


@contextmanager
def open_big_map(camera: str) -> Iterator[tuple[Technique, PlaceMap, PlaceIndex]]:
    """Make and open a large map."""
    technique = create("cohog", {"camera": camera})
    with TemporaryDirectory() as folder:
        make_big_map(Path(folder) / "big.gpkg", technique.spec, PLACES)
        with PlaceMap.open(Path(folder) / "big.gpkg") as place_map:
            yield technique, place_map, load_index(place_map, technique, 100_000_000)


def measure_queries() -> Iterator[Row]:
    """Ask one query, encoding included, in a large map: the scan and the vote over the best places, looking ahead
    against the vote over all (`exact_s`); looking down with what may be known beforehand, which `beside` tells."""
    with open_big_map("forward") as large:
        yield _time_query(large, "forward", "", NO_EXPECTATION)
    with open_big_map("nadir") as large:
        index = large[2]
        # A map as it is flown, on parallel legs to and fro, with some sway.
        rng = np.random.default_rng(0)
        rotation_deg = (rng.choice([0, 180], len(index)) + rng.normal(0, 5, len(index))) % 360
        near = index.find_within(Position(float(index.lat_deg.mean()), float(index.lon_deg.mean())), MAX_DISTANCE_M)
        in_reach = f"{np.count_nonzero(near)} places within {MAX_DISTANCE_M:.0f} m"
        yield _time_query(large, "nadir", "24 rotations", NO_EXPECTATION)
        yield _time_query(large, "nadir, heading known", "3 rotations", Expectation(rotation_deg=rotation_deg))
        yield _time_query(large, "nadir, in reach", in_reach, Expectation(in_reach=near))
        yield _time_query(large, "nadir, both", f"{in_reach}, 3 rotations", Expectation(near, rotation_deg))


def _time_query(large: tuple[Technique, PlaceMap, PlaceIndex], camera: str, hints: str, expected: Expectation) -> Row:
    (technique, place_map, index), picture = large, load_frames()[0]

    def answer(candidates: int | None) -> None:
        query = Query(
            technique=technique,
            descriptor=technique.encode(picture),
            place_map=place_map,
            index=index,
            expected=expected,
        )
        compare_places(query, scan_index(query), candidates, 0.0)

    answer(technique.candidates)
    encode_s = statistics.median(time_call_s(technique.encode, picture) for _ in range(QUERY_REPEATS))
    two_stage_s, exact_s = [], []
    for turn in range(QUERY_REPEATS):
        two_stage_s.append(time_call_s(answer, technique.candidates))
        if camera == "forward" and turn % 3 == 0:
            exact_s.append(time_call_s(answer, None))
    two_stage, exact = statistics.median(two_stage_s), statistics.median(exact_s) if exact_s else None
    return {
        "camera": camera,
        "beside": hints,
        "candidates": technique.candidates,
        "encode_ms": 1000 * encode_s,
        "two_stage_ms": 1000 * two_stage,
        "exact_s": exact,  # None where it would take minutes
        "ratio": exact / two_stage if exact else None,
        "bytes_per_place": compute_place_bytes(technique.spec),
    }


def main() -> None:
    result = base.describe_run()
    result |= {"encode": [*measure_encoding()], "match": [*measure_matching()], "two_stage": [*measure_queries()]}
    result["flight"] = bench_flight.measure_flight()
    base.write("bench", result, format_page(result))


def format_page(result: Row) -> str:
    """Return the page for people."""
    ran_on = result["machine"]
    tables = {name: base.format_table(result[name], columns) for name, columns in COLUMNS.items()}
    return f"""# Speed and memory

Made by `make bench` on {result["date"]}, commit {result["commit"]}.
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
