"""A place map as large as wanted, made in seconds: every row and blob has its right form, and random content."""

import math
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edgevpr.core.contract import PartSpec, TechniqueSpec
from edgevpr.places import geopackage
from edgevpr.places.mapfile import PlaceMap

_CORNER_DEG = (47.0, 8.0)  # lat, lon
_STEP_DEG = (0.0005, 0.0005)  # of latitude: 56 m
_INSERT = """
INSERT INTO places (geom, time, alt_m, heading_deg, source_image, quality, coarse, fine) VALUES (?, ?, ?, ?, ?, ?, ?, ?)
"""


def file_bytes(spec: TechniqueSpec, places: int) -> int:
    """About how large the file of such a map is; while it is written, no more than this is needed."""
    fine = spec.fine.nbytes if spec.fine else 0
    return places * math.ceil(1.1 * (spec.coarse.nbytes + fine + 100)) + 200_000


def make_big_map(
    path: Path,
    spec: TechniqueSpec,
    places: int,
    seed: int = 0,
    corner_deg: tuple[float, float] = _CORNER_DEG,
    step_deg: tuple[float, float] = _STEP_DEG,
) -> None:
    """Write a map of `spec` with `places` places on a square grid, all in one transaction. `corner_deg`: the place in
    the south-west (lat, lon); `step_deg`: from there to the next."""
    PlaceMap.create(path, spec).close()
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA journal_mode = OFF")  # a file that nobody has seen yet is in no danger
        points = _grid(places, corner_deg, step_deg)
        db.executemany(_INSERT, _rows(spec, points, np.random.default_rng(seed)))
        db.execute(geopackage.GROW_EXTENT, {"table": "places", "lat": corner_deg[0], "lon": corner_deg[1]})
    db.close()


def _grid(places: int, corner_deg: tuple[float, float], step_deg: tuple[float, float]) -> Iterator[tuple[float, float]]:
    side = math.ceil(math.sqrt(places))
    for number in range(places):
        steps = divmod(number, side)
        yield corner_deg[0] + steps[0] * step_deg[0], corner_deg[1] + steps[1] * step_deg[1]


def _rows(spec: TechniqueSpec, points: Iterator[tuple[float, float]], rng: np.random.Generator) -> Iterator[tuple]:
    for number, point in enumerate(points):
        coarse, fine = _blob(spec.coarse, rng), _blob(spec.fine, rng) if spec.fine else None
        time, name = geopackage.utc_text(1.7e9 + number), f"{number:06d}.jpg"
        yield geopackage.point_blob(*point), time, 500.0, 0.0, name, 0.8, coarse, fine


def _blob(part: PartSpec, rng: np.random.Generator) -> bytes:
    """Integers over the whole range for an integer part, and a random vector of length 1 for one of floats."""
    if np.dtype(part.dtype).kind != "f":
        return rng.bytes(part.nbytes)
    vector = rng.random(part.shape, np.float32)
    return (vector / np.linalg.norm(vector)).astype(part.dtype).tobytes()
