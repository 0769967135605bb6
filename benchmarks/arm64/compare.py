"""The same pictures on two processors: maps made on each, and flights of each over both maps."""

import json
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.geodesy import distance_m

_PART_DTYPES = {("nadir", "coarse"): "<u2"}  # words; all else are bytes
EVERY = 6  # picture of the flight is asked for: a query takes seconds under emulation
CAMERAS = ("nadir", "forward")
PARTS = ("coarse", "fine", "landmarks")
Run = Callable[..., str]  # runs edgevpr with arguments, returns what it prints


@dataclass(frozen=True, slots=True, kw_only=True)
class MapsRow:
    """How many of the `numbers` of a part of all places differ between two maps, and by how much at most."""

    camera: str
    seed: int
    part: str
    numbers: int
    differ: int
    most: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightsRow:
    """Two flights of the same pictures over one map, one on each processor: how often another decision was made
    (accepted or not), another place accepted, another place found by a query that both refuse, or another reason told,
    down to the last digit in it; and by how much scores, confidences and accepted positions differ at most (they
    are told to 1e-8 degrees, which is 1.1 mm)."""

    camera: str
    seed: int
    map_made_on: str
    queries: int
    accepted: int
    other_decision: int
    other_place: int
    other_refused: int
    other_words: int
    score: float
    confidence: float
    located_mm: float


def make_pictures(folder: Path, seed: int, here: Run) -> dict[str, Path]:
    """Make the pictures of a map and those asked for, and return where they are."""
    pictures = {which: folder / f"{which}-{seed}" for which in ("map", "query")}
    for which, path in pictures.items():
        here("simulate", "flight", path, "--which", which, "--seed", seed)
    for number, picture in enumerate(sorted((pictures["query"] / "images").iterdir())):
        if number % EVERY:
            picture.unlink()
    return {which: path / "images" for which, path in pictures.items()}


def compared(
    folder: Path, pictures: dict[str, Path], camera: str, seed: int, here: Run, there: Run
) -> tuple[list[MapsRow], list[FlightsRow]]:
    """Make a map of the pictures on each processor, and fly over both maps with each; both maps at a time."""
    fov = ("--fov-deg", 66) if camera == "nadir" else ()
    maps = {name: folder / f"{camera}-{seed}-{name}.gpkg" for name in ("x86-64", "aarch64")}

    def made_and_flown(made_on: str, maker: Run) -> FlightsRow:
        path = maps[made_on]
        source = ("--images", pictures["map"], "--camera", camera, *fov)
        maker("map", "build", path, *source, "--technique", "cohog", "--no-calibrate")
        asked = ("match", path, "--images", pictures["query"], *fov, "--follow", "--json")
        return flights_row(json.loads(here(*asked)), json.loads(there(*asked)), camera, seed, made_on)

    with ThreadPoolExecutor() as pool:
        rows = list(pool.map(made_and_flown, maps, (here, there)))
    return [maps_row(*maps.values(), camera, seed, part) for part in PARTS], rows


def maps_row(one: Path, other: Path, camera: str, seed: int, part: str) -> MapsRow:
    """Compare a part of all places of two maps of the same pictures."""
    dtype = np.dtype(_PART_DTYPES.get((camera, part), "u1"))
    before, after = (_all_of(path, part, dtype) for path in (one, other))
    if before.shape != after.shape:
        raise RuntimeError(f"{one} and {other} have not as much {part}")
    steps = np.abs(before.astype(int) - after)
    return MapsRow(
        camera=camera,
        seed=seed,
        part=part,
        numbers=steps.size,
        differ=int((steps > 0).sum()),
        most=int(steps.max(initial=0)),
    )


def flights_row(
    one: list[dict[str, Any]], other: list[dict[str, Any]], camera: str, seed: int, made_on: str
) -> FlightsRow:
    """Compare two flights of the same pictures, as `edgevpr match --json` tells them."""
    pairs = list(zip(one, other, strict=True))

    def most(name: str) -> float:
        return max((abs((a.get(name) or 0.0) - (b.get(name) or 0.0)) for a, b in pairs), default=0.0)

    other = [(a, b) for a, b in pairs if a["place"] != b["place"]]
    refused = sum(not (a["accepted"] or b["accepted"]) for a, b in other)
    both = [(told_position(a), told_position(b)) for a, b in pairs if a["accepted"] and b["accepted"]]
    apart_m = [float(distance_m(*one, *other)) for one, other in both]
    return FlightsRow(
        camera=camera,
        seed=seed,
        map_made_on=made_on,
        queries=len(pairs),
        accepted=sum(a["accepted"] for a, _ in pairs),
        other_decision=sum(a["accepted"] != b["accepted"] for a, b in pairs),
        other_place=len(other) - refused,
        other_refused=refused,
        other_words=sum(a["reason"] != b["reason"] for a, b in pairs),
        score=most("score"),
        confidence=most("confidence"),
        located_mm=1000 * max(apart_m, default=0.0),
    )


def told_position(match: dict[str, Any]) -> tuple[float, float]:
    """Return latitude and longitude of an accepted match: where it was located, else those of its place."""
    where = match["located"] or match["position"]
    return where["lat_deg"], where["lon_deg"]


def _all_of(path: Path, part: str, dtype: np.dtype) -> np.ndarray:
    with sqlite3.connect(path) as database:
        found = database.execute(f"SELECT {part} FROM places ORDER BY place_id").fetchall()
    return np.concatenate([np.frombuffer(blob or b"", dtype) for (blob,) in found])
