"""The same pictures on two processors: maps made on each, and flights of each over both maps."""

import json
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.geodesy import distance_m

_PART_DTYPES = {("nadir", "coarse"): "<u2"}  # words; all else are bytes
EVERY = 6  # picture of the flight is asked for: a query takes seconds under emulation
CAMERAS = ("nadir", "forward")
PARTS = ("coarse", "fine", "landmarks")
_SAME_MM = 2.0  # positions are told in steps of 1.1 mm
_FEW = 1e-5  # of the values of the fine part and of the landmarks may differ by their last bit, for other roundings
Run = Callable[..., str]  # runs edgevpr with arguments, returns what it prints
Row = dict[str, Any]


def make_pictures(folder: Path, seed: int, here: Run) -> dict[str, Path]:
    """Make the pictures of a map and those asked for, and return where they are."""
    pictures = {which: folder / which for which in ("map", "query")}
    for which, path in pictures.items():
        here("simulate", "flight", path, "--which", which, "--seed", seed)
    for number, picture in enumerate(sorted((pictures["query"] / "images").iterdir())):
        if number % EVERY:
            picture.unlink()
    return {which: path / "images" for which, path in pictures.items()}


def compared(
    folder: Path, pictures: dict[str, Path], camera: str, here: Run, there: Run
) -> tuple[list[Row], list[Row]]:
    """Make a map of the pictures on each processor, and fly over both maps with each; both maps at a time. Return a row
    of each part of the maps, and one of each map that was flown over."""
    fov = ("--fov-deg", 66) if camera == "nadir" else ()
    maps = {name: folder / f"{camera}-{name}.gpkg" for name in ("x86-64", "aarch64")}

    def made_and_flown(made_on: str, maker: Run) -> Row:
        source = ("--images", pictures["map"], "--camera", camera, *fov)
        maker("map", "build", maps[made_on], *source, "--technique", "cohog", "--no-calibrate")
        asked = ("match", maps[made_on], "--images", pictures["query"], *fov, "--follow", "--json")
        told = flights_row(json.loads(here(*asked)), json.loads(there(*asked)))
        return {"camera": camera, "map_made_on": made_on, **told}

    with ThreadPoolExecutor() as pool:
        rows = list(pool.map(made_and_flown, maps, (here, there)))
    return [{"camera": camera, "part": part, **maps_row(*maps.values(), camera, part)} for part in PARTS], rows


def maps_row(one: Path, other: Path, camera: str, part: str) -> Row:
    """Return how many of the `numbers` of a part of all places differ between two maps, and by how much at most."""
    dtype = np.dtype(_PART_DTYPES.get((camera, part), "u1"))
    before, after = (_all_of(path, part, dtype) for path in (one, other))
    if before.shape != after.shape:
        raise RuntimeError(f"{one} and {other} have not as much {part}")
    steps = np.abs(before.astype(int) - after)
    return {"numbers": steps.size, "differ": int((steps > 0).sum()), "most": int(steps.max(initial=0))}


def flights_row(one: list[Row], other: list[Row]) -> Row:
    """Compare two flights of the same pictures, as `edgevpr match --json` tells them: how often another decision was
    made (accepted or not), another place accepted, another place found by a query that both refuse, or another reason
    told, down to the last digit in it; and by how much scores, confidences and accepted positions differ at most (they
    are told to 1e-8 degrees, which is 1.1 mm)."""
    pairs = list(zip(one, other, strict=True))
    elsewhere = [(a, b) for a, b in pairs if a["place"] != b["place"]]
    refused = sum(not (a["accepted"] or b["accepted"]) for a, b in elsewhere)
    apart_m = [float(distance_m(*_told(a), *_told(b))) for a, b in pairs if a["accepted"] and b["accepted"]]
    most = {
        name: max((abs((a.get(name) or 0.0) - (b.get(name) or 0.0)) for a, b in pairs), default=0.0)
        for name in ("score", "confidence")
    }
    return {
        "queries": len(pairs),
        "accepted": sum(a["accepted"] for a, _ in pairs),
        "other_decision": sum(a["accepted"] != b["accepted"] for a, b in pairs),
        "other_place": len(elsewhere) - refused,
        "other_refused": refused,
        "other_words": sum(a["reason"] != b["reason"] for a, b in pairs),
        **most,
        "located_mm": 1000 * max(apart_m, default=0.0),
    }


def wrongs(found: Row) -> list[str]:
    """List what is not the same on both, a sentence each."""
    said = []
    for each in found["maps"]:
        if each["differ"] > (0 if each["part"] == "coarse" else _FEW * each["numbers"]):
            said.append(f"{each['camera']}: {each['differ']} values of {each['part']} differ.")
    for each in found["flights"]:
        if each["other_place"] or each["other_decision"] or each["located_mm"] > _SAME_MM:
            said.append(
                "{camera}, map made on {map_made_on}: {other_place} other places accepted, {other_decision} other "
                "decisions, {located_mm:.3f} mm apart.".format(**each)
            )
    return said


def _told(match: Row) -> tuple[float, float]:
    """Return latitude and longitude of an accepted match: where it was located, else those of its place."""
    where = match["located"] or match["position"]
    return where["lat_deg"], where["lon_deg"]


def _all_of(path: Path, part: str, dtype: np.dtype) -> np.ndarray:
    with sqlite3.connect(path) as database:
        found = database.execute(f"SELECT {part} FROM places ORDER BY place_id").fetchall()
    return np.concatenate([np.frombuffer(blob or b"", dtype) for (blob,) in found])
