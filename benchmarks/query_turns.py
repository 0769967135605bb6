"""Times of queries in a map of 10 000 places, one turn at a time: `beside_before.py` starts it in two versions of
edgevpr, so it uses only what both have. It prints the cases as JSON, then for each line that it reads the milliseconds
of one query a case, as JSON.
"""

import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from big_map import make_big_map

from edgevpr.lab.simulate.scene import make_scene
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import NOTHING, Expected, compare, scan
from edgevpr.techniques import create

PLACES = 10_000


def main() -> None:
    cv2.setNumThreads(1)
    ground = cv2.cvtColor(make_scene(seed=3, width_m=220, depth_m=170).albedo, cv2.COLOR_BGR2GRAY)
    picture = ground[100:580, 100:740]
    # A map as it is flown, on parallel legs to and fro, with some sway.
    rng = np.random.default_rng(0)
    turned_deg = (rng.choice([0, 180], PLACES) + rng.normal(0, 5, PLACES)) % 360
    cases = {
        "ahead": ("forward", NOTHING),
        "down, heading unknown": ("nadir", NOTHING),
        "down, heading known": ("nadir", Expected(turned_deg=turned_deg)),
    }
    with TemporaryDirectory() as folder:
        opened = {}
        for camera in ("forward", "nadir"):
            technique, path = create("cohog", {"camera": camera}), Path(folder) / f"{camera}.gpkg"
            make_big_map(path, technique.spec, PLACES)
            place_map = PlaceMap.open(path)
            opened[camera] = technique, place_map, load_index(place_map, technique, 100_000_000)

        def query_ms(camera: str, expected: Expected) -> float:
            technique, place_map, index = opened[camera]
            start = time.perf_counter()
            asked = technique.encode(picture)
            scanned = scan(technique, asked, index, expected)
            compare(technique, asked, scanned, place_map, index, candidates=technique.candidates, expected=expected)
            return 1000 * (time.perf_counter() - start)

        for case in cases.values():
            query_ms(*case)
        print(json.dumps(list(cases)), flush=True)
        for _ in sys.stdin:
            print(json.dumps([query_ms(*case) for case in cases.values()]), flush=True)


if __name__ == "__main__":
    main()
