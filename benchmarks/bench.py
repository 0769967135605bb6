"""Measure every speed and memory figure: `make bench` writes benchmarks/results/bench.md and bench.json.

Times the stages of a `cohog` query on one thread, and compares its two-stage search with the vote over all places.
Frames, 640x480 grey, come from the generated scene and, if available, from image sets. Large maps are generated, with
random content. `bench_flight.py` measures the whole program. Times are not valid on a busy machine.
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
    """Return frames of the generated scene and of image sets, uint8 (480, 640)."""
    ground = cv2.cvtColor(make_scene(seed=3, width_m=220, depth_m=170).albedo, cv2.COLOR_BGR2GRAY)
    frames = [ground[top : top + FRAME_PX[1], left : left + FRAME_PX[0]] for top, left in ((100, 100), (500, 600))]
    for folder in sorted(DATA.glob("*/query")):
        paths = sorted(folder.iterdir())
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths[:: -(-len(paths) // FRAMES_PER_SET)]]
        large_enough = [image for image in images if image is not None and min(image.shape) >= 100]
        frames += [cv2.resize(image, FRAME_PX, interpolation=cv2.INTER_AREA) for image in large_enough]
    return frames


def time_call_s(function: Callable, *arguments: object) -> float:
    """Return the wall time of the second of two calls: the first one fills the caches."""
    function(*arguments)
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def measure_encoding() -> Iterator[Row]:
    """Yield the median time to encode a frame, for each definition of entropy."""
    for entropy in ("shannon", "filled_bins"):
        technique = create("cohog", {"entropy": entropy})
        times_s = [time_call_s(technique.encode, picture) for picture in load_frames() for _ in range(ENCODE_REPEATS)]
        yield {"entropy": entropy, "ours_ms": 1000 * statistics.median(times_s)}


def measure_matching() -> Iterator[Row]:
    """Yield the median time to compare one place in full, by the displacement vote. As in a map, all places differ."""
    technique, pictures = create("cohog"), load_frames()
    # Shifted copies make up for missing pictures: the time does not depend on what they show.
    places = [technique.encode(np.roll(pictures[place % len(pictures)], place)) for place in range(REFERENCES)]
    query = technique.encode(pictures[0])
    repeats = range(MATCH_REPEATS)
    times_s = [time_call_s(lambda: [technique.match(query, place.fine, None) for place in places]) for _ in repeats]
    yield {"references": REFERENCES, "ours_ms": 1000 * statistics.median(times_s) / REFERENCES}


@contextmanager
def open_big_map(camera: str) -> Iterator[tuple[Technique, PlaceMap, PlaceIndex]]:
    """Make a map of `PLACES` places, and yield the technique, the open map and its index."""
    technique = create("cohog", {"camera": camera})
    with TemporaryDirectory() as folder:
        make_big_map(Path(folder) / "big.gpkg", technique.spec, PLACES)
        with PlaceMap.open(Path(folder) / "big.gpkg") as place_map:
            yield technique, place_map, load_index(place_map, technique, 100_000_000)


def measure_queries() -> Iterator[Row]:
    """Time one query in a large map, encoding included: the scan, then the vote over the best places. The forward query
    is also timed with the vote over all places (`exact_s`), the nadir one with the prior that `beside` names."""
    with open_big_map("forward") as opened:
        yield _time_query(opened, "forward", "", NO_EXPECTATION)
    with open_big_map("nadir") as opened:
        index = opened[2]
        # Headings of a map that was flown on parallel legs, to and fro, with some sway.
        rng = np.random.default_rng(0)
        rotation_deg = (rng.choice([0, 180], len(index)) + rng.normal(0, 5, len(index))) % 360
        is_near = index.find_within(Position(float(index.lat_deg.mean()), float(index.lon_deg.mean())), MAX_DISTANCE_M)
        near_text = f"{np.count_nonzero(is_near)} places within {MAX_DISTANCE_M:.0f} m"
        yield _time_query(opened, "nadir", "24 rotations", NO_EXPECTATION)
        yield _time_query(opened, "nadir, heading known", "3 rotations", Expectation(rotation_deg=rotation_deg))
        yield _time_query(opened, "nadir, in reach", near_text, Expectation(in_reach=is_near))
        yield _time_query(opened, "nadir, both", f"{near_text}, 3 rotations", Expectation(is_near, rotation_deg))


def _time_query(opened: tuple[Technique, PlaceMap, PlaceIndex], camera: str, prior: str, expected: Expectation) -> Row:
    """Return the median times of a query with what is `expected`, in an open map; `prior` describes it."""
    technique, place_map, index = opened
    picture = load_frames()[0]

    def match(candidates: int | None) -> None:
        descriptor = technique.encode(picture)
        query = Query(technique=technique, descriptor=descriptor, place_map=place_map, index=index, expected=expected)
        compare_places(query, scan_index(query), candidates, 0.0)

    match(technique.candidates)
    encode_s = statistics.median(time_call_s(technique.encode, picture) for _ in range(QUERY_REPEATS))
    two_stage_s, exact_s = [], []
    for repeat in range(QUERY_REPEATS):
        two_stage_s.append(time_call_s(match, technique.candidates))
        if camera == "forward" and repeat % 3 == 0:
            exact_s.append(time_call_s(match, None))
    two_stage, exact = statistics.median(two_stage_s), statistics.median(exact_s) if exact_s else None
    return {
        "camera": camera,
        "beside": prior,
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
    """Return the results as Markdown."""
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
