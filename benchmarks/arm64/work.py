"""The parts of a query, whose instructions `bench_arm64.py` counts under emulation.

`python work.py FORWARD.gpkg NADIR.gpkg` runs each part, marks its start and end by a call of getppid(), which costs
almost nothing, and prints its name.
"""

import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from counted import SMALL_MAP_PLACES

from edgevpr.core.arrays import Image
from edgevpr.frames.level import View
from edgevpr.places.index import PlaceIndex, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import NO_EXPECTATION, Expectation, Query, compare_places, scan_index
from edgevpr.runtime.recognise.landmarks import QUERY_LANDMARKS, detect_landmarks
from edgevpr.runtime.recognise.odometry import VisualOdometry
from edgevpr.techniques import create

ARRAYS_BY_PLACE = ("place_ids", "lat_deg", "lon_deg", "heading_deg", "rows")


def list_parts(forward_map: str, nadir_map: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the name of each part and a function that runs it."""
    yield from list_query_parts("ahead", "forward", forward_map)
    yield from list_query_parts("down", "nadir", nadir_map)
    yield from list_landmark_parts(_make_picture(np.random.default_rng(0)))


def _make_picture(rng: np.random.Generator) -> Image:
    """Return smoothed noise with stretched contrast: nearly all its regions have enough texture, as over a town."""
    noise = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), np.uint8), (0, 0), 2)
    return cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)


def list_query_parts(name: str, camera: str, path: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the parts of a query of `cohog` in the map at `path`."""
    rng = np.random.default_rng(0)
    picture = _make_picture(rng)
    technique = create("cohog", {"camera": camera})
    with PlaceMap.open(path) as place_map:
        index = load_index(place_map, technique, 100_000_000)
        small = replace(index, **{name: getattr(index, name)[:SMALL_MAP_PLACES] for name in ARRAYS_BY_PLACE})
        heading_known = Expectation(rotation_deg=rng.choice([0.0, 180.0], len(index)))
        fine, _ = place_map.read_fine_part(index.place_ids[0])
        descriptor, rotations = technique.encode(picture), [0] if camera == "nadir" else None

        def encode(places: PlaceIndex, expected: Expectation = NO_EXPECTATION) -> Query:
            encoded = technique.encode(picture)
            return Query(technique=technique, descriptor=encoded, place_map=place_map, index=places, expected=expected)

        def match(expected: Expectation) -> object:
            query = encode(index, expected)
            return compare_places(query, scan_index(query), technique.candidates, 0.0)

        yield f"{name}: encode a frame", lambda: technique.encode(picture)
        yield f"{name}: read a place", lambda: place_map.read_fine_part(index.place_ids[1])
        yield f"{name}: quick score of a place", lambda: technique.score_quickly(descriptor, fine, rotations)
        yield f"{name}: compare a place in full", lambda: technique.match(descriptor, fine, rotations)
        yield f"{name}: encode, and scan {len(small)} places", lambda: scan_index(encode(small))
        yield f"{name}: encode, and scan {len(index)} places", lambda: scan_index(encode(index))
        yield f"{name}: a query", lambda: match(NO_EXPECTATION)
        if camera == "nadir":
            yield f"{name}: a query, heading known", lambda: match(heading_known)


def list_landmark_parts(picture: Image) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the parts of a flight besides queries: landmarks of a frame, and a step of visual odometry."""
    moved = cv2.warpAffine(picture, np.float32([[1, 0, 40], [0, 1, 15]]), picture.shape[::-1])
    view = View(up_deg=0.0, footprint_m=130.0, nadir_offset=(0.0, 0.0), focal=0.77)
    before, after = detect_landmarks(picture, None, QUERY_LANDMARKS), detect_landmarks(moved, None, QUERY_LANDMARKS)

    def measure_step() -> object:
        odometry = VisualOdometry()
        odometry.measure(0.0, view, before)
        if (step := odometry.measure(1.0, view, after)) is None:
            raise RuntimeError("visual odometry found no step")
        return step

    yield "flight: landmarks of a frame", lambda: detect_landmarks(moved, None, QUERY_LANDMARKS)
    yield "flight: odometry since the last frame", measure_step


def run_parts(*maps: str) -> None:
    for name, work in list_parts(*maps):
        work()
        os.getppid()
        work()
        os.getppid()
        print(name, flush=True)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    run_parts(*sys.argv[1:])
