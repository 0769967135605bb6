"""The parts of a query, once each: what `bench_arm64.py` counts under emulation.

`python work.py AHEAD.gpkg DOWN.gpkg` marks the beginning and the end of each part by a call of getppid(), which costs
next to nothing, and prints its name.
"""

import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from counted import SMALL

from edgevpr.core.arrays import Image
from edgevpr.frames.level import View
from edgevpr.places.index import PlaceIndex, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import NO_EXPECTATION, Expectation, Query, compare_places, scan_index
from edgevpr.runtime.recognise.landmarks import QUERY_LANDMARKS, detect_landmarks
from edgevpr.runtime.recognise.odometry import VisualOdometry
from edgevpr.techniques import create

PER_PLACE = ("place_ids", "lat_deg", "lon_deg", "heading_deg", "rows")


def parts(ahead: str, down: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the name of each part, and a function that does it."""
    yield from of_camera("ahead", "forward", ahead)
    yield from of_camera("down", "nadir", down)
    yield from of_landmarks(_picture(np.random.default_rng(0)))


def _picture(rng: np.random.Generator) -> Image:
    """Return noise, smoothed and stretched: nearly all regions are good, as over a town."""
    noise = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), np.uint8), (0, 0), 2)
    return cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)


def of_camera(name: str, camera: str, path: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the parts of a query of `cohog` in one map."""
    rng = np.random.default_rng(0)
    picture = _picture(rng)
    technique = create("cohog", {"camera": camera})
    with PlaceMap.open(path) as place_map:
        index = load_index(place_map, technique, 100_000_000)
        small = replace(index, **{each: getattr(index, each)[:SMALL] for each in PER_PLACE})
        known = Expectation(rotation_deg=rng.choice([0.0, 180.0], len(index)))
        fine, _ = place_map.read_fine_part(index.place_ids[0])
        asked, one = technique.encode(picture), [0] if camera == "nadir" else None

        def encoded(places: PlaceIndex, expected: Expectation = NO_EXPECTATION) -> Query:
            seen = technique.encode(picture)
            return Query(technique=technique, descriptor=seen, place_map=place_map, index=places, expected=expected)

        def scanned(places: PlaceIndex) -> object:
            return scan_index(encoded(places))

        def query(expected: Expectation) -> object:
            one = encoded(index, expected)
            return compare_places(one, scan_index(one), technique.candidates)

        yield f"{name}: encode a frame", lambda: technique.encode(picture)
        yield f"{name}: read a place", lambda: place_map.read_fine_part(index.place_ids[1])
        yield f"{name}: glance at a place", lambda: technique.score_quickly(asked, fine, one)
        yield f"{name}: compare a place in full", lambda: technique.match(asked, fine, one)
        yield f"{name}: encode, and scan {len(small)} places", lambda: scanned(small)
        yield f"{name}: encode, and scan {len(index)} places", lambda: scanned(index)
        yield f"{name}: a query", lambda: query(NO_EXPECTATION)
        if camera == "nadir":
            yield f"{name}: a query, heading known", lambda: query(known)


def of_landmarks(picture: Image) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield what a flight does beside its queries: the landmarks of a frame, and its stride."""
    moved = cv2.warpAffine(picture, np.float32([[1, 0, 40], [0, 1, 15]]), picture.shape[::-1])
    view = View(up_deg=0.0, footprint_m=130.0, nadir_offset=(0.0, 0.0), focal=0.77)
    before, now = detect_landmarks(picture, None, QUERY_LANDMARKS), detect_landmarks(moved, None, QUERY_LANDMARKS)

    def stride() -> object:
        strides = VisualOdometry()
        strides.measure(0.0, view, before)
        if (found := strides.measure(1.0, view, now)) is None:
            raise RuntimeError("no stride was found")
        return found

    yield "flight: landmarks of a frame", lambda: detect_landmarks(moved, None, QUERY_LANDMARKS)
    yield "flight: the stride since the frame before", stride


def mark_each(*maps: str) -> None:
    for name, work in parts(*maps):
        work()
        os.getppid()
        work()
        os.getppid()
        print(name, flush=True)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    mark_each(*sys.argv[1:])
