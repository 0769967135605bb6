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
_STEP_DEG = 0.0005  # of latitude: 56 m
_INSERT = """
INSERT INTO places (geom, time, alt_m, heading_deg, source_image, quality, coarse, fine) VALUES (?, ?, ?, ?, ?, ?, ?, ?)
"""


def estimate_file_bytes(spec: TechniqueSpec, places: int) -> int:
    """About how large the file of such a map is; while it is written, no more than this is needed."""
    fine = spec.fine.nbytes if spec.fine else 0
    return places * math.ceil(1.1 * (spec.coarse.nbytes + fine + 100)) + 200_000


def make_big_map(path: Path, spec: TechniqueSpec, places: int) -> None:
    """Write a map of `spec` with `places` places on a square grid, all in one transaction."""
    PlaceMap.create(path, spec).close()
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA journal_mode = OFF")  # a file that nobody has seen yet is in no danger
        db.executemany(_INSERT, _rows(spec, places, np.random.default_rng(0)))
        db.execute(geopackage.GROW_EXTENT, {"table": "places", "lat": _CORNER_DEG[0], "lon": _CORNER_DEG[1]})
    db.close()


def _rows(spec: TechniqueSpec, places: int, rng: np.random.Generator) -> Iterator[tuple]:
    side = math.ceil(math.sqrt(places))
    for number in range(places):
        point = [corner + _STEP_DEG * steps for corner, steps in zip(_CORNER_DEG, divmod(number, side), strict=True)]
        coarse, fine = _blob(spec.coarse, rng), _blob(spec.fine, rng) if spec.fine else None
        time, name = geopackage.format_utc(1.7e9 + number), f"{number:06d}.jpg"
        yield geopackage.encode_point(*point), time, 500.0, 0.0, name, 0.8, coarse, fine


def _blob(part: PartSpec, rng: np.random.Generator) -> bytes:
    """Integers over the whole range for an integer part, and a random vector of length 1 for one of floats."""
    if np.dtype(part.dtype).kind != "f":
        return rng.bytes(part.nbytes)
    vector = rng.random(part.shape, np.float32)
    return (vector / np.linalg.norm(vector)).astype(part.dtype).tobytes()
