"""A program of its own that adds places and says which are confirmed; the tests kill it at any moment."""

import contextlib
import sqlite3
import sys
from pathlib import Path

import numpy as np

from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.types import Frame, Position
from edgevpr.places.mapfile import PlaceMap

SPEC = TechniqueSpec(name="test", parameters={"seed": 1}, coarse=PartSpec((64,), "<f2"), fine=PartSpec((40, 32), "<f4"))


def frame(number: int) -> Frame:
    position = None if number % 5 == 0 else Position(50.0 + number * 1e-4, 8.0, 100.0 + number)
    image = np.zeros((16, 16), np.uint8)
    fields = {"t_mono_s": 0.0, "t_utc_s": 1.7e9 + number, "position": position, "heading_deg": number % 360}
    return Frame(image=image, name=f"{number:05d}.jpg", **fields)


def make_descriptor(number: int) -> Descriptor:
    rng = np.random.default_rng(number)
    return Descriptor(coarse=rng.random(64).astype("<f2"), fine=rng.random((40, 32), dtype=np.float32), quality=0.75)


def make_map(path: Path, places: int) -> Path:
    """Make a map of so many places."""
    with PlaceMap.create(path, SPEC) as place_map:
        for number in range(places):
            place_map.add(frame(number), make_descriptor(number))
    return path


def write_sql(path: Path, *statements: str) -> None:
    """Write to a map as another program does."""
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        for statement in statements:
            db.executescript(statement)


if __name__ == "__main__":
    path, start = sys.argv[1], int(sys.argv[2])
    place_map = PlaceMap.open_for_writing(path)
    for number in range(start, start + 100_000):
        print(place_map.add(frame(number), make_descriptor(number)), flush=True)
