"""`kill -9` at random moments while a map is built and while a flight learns: what was confirmed must be there."""

import random
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from base import Row
from flight_process import start, write_frames

from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.flight.flightlog import read_log

_PICTURES = 40
_LONGEST_LIFE_S = 2.5
_STEP_DEG = 0.0002  # 22 m: each picture is a place of its own


def run(count: int, seed: int) -> list[Row]:
    """Kill `count` builders and as many learning flights, each at a moment drawn from the seed. Counted are places that
    a program had confirmed, and how many of them were `lost`, were there twice (`doubled`), or stood in a map that
    SQLite calls damaged (`corrupt`, maps)."""
    rng = random.Random(seed)
    with TemporaryDirectory(prefix="edgevpr-kills-") as folder:
        frames = Path(folder) / "frames"
        write_frames(frames, _PICTURES)
        lines = [f"{number:04d}.jpg,{47 + number * _STEP_DEG:.6f},11.0" for number in range(_PICTURES)]
        (frames / "positions.csv").write_text("file,lat,lon\n" + "\n".join(lines) + "\n")
        return [_killed("map build", count, rng, frames, _built), _killed("run --learn", count, rng, frames, _learnt)]


def _killed(kind, count, rng, frames, go) -> Row:
    confirmed: set[str] = set()
    totals = {"confirmed": 0, "lost": 0, "doubled": 0, "corrupt": 0}
    path = frames.parent / f"{kind.split()[-1].strip('-')}.gpkg"
    for number in range(count):
        if len(confirmed) >= _PICTURES - 1:  # all are mapped: begin anew
            path.unlink()
            confirmed = set()
        confirmed |= go(path, frames, frames.parent / f"{number}.jsonl", rng.uniform(0.3, _LONGEST_LIFE_S))
        held = _held(path)
        totals["confirmed"] += len(confirmed)
        totals["lost"] += len(confirmed - set(held))
        totals["doubled"] += len(held) - len(set(held))
        totals["corrupt"] += not _is_whole(path)
        confirmed |= set(held)  # what was there once must stay
    return {"kind": kind, "kills": count, **totals}


def _built(path: Path, frames: Path, log: Path, life_s: float) -> set[str]:
    append = ["--append"] if path.exists() else []
    command = [sys.executable, "-m", "edgevpr", "map", "build", path, "--images", frames, "--technique", "hog", *append]
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _kill_after(process, life_s)
    return set()  # a builder says nothing of single places; what a look into the file has seen counts


def _learnt(path: Path, frames: Path, log: Path, life_s: float) -> set[str]:
    process = start(path, frames, log, "--learn", "--technique", "hog", "--rate-hz", "60")
    _kill_after(process, life_s)
    return {line["query"] for line in read_log(log) if line["kind"] == "learnt"} if log.exists() else set()


def _kill_after(process: subprocess.Popen, life_s: float) -> None:
    time.sleep(life_s)
    process.kill()
    process.communicate()


def _held(path: Path) -> list[str]:
    if not path.exists():
        return []
    with PlaceMap.open(path) as place_map:
        return [place.source_image for place in place_map.places()]


def _is_whole(path: Path) -> bool:
    if not path.exists():
        return True
    database = sqlite3.connect(path)
    try:
        return database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    finally:
        database.close()
