"""A mission rehearsed over a map: pictures along it from another orthophoto than the map's, flown in real time by a
real `edgevpr run` beside a simulated plane that loses GPS on the way. `edgevpr simulate rehearsal` does it."""

import logging
import math
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.core.text import progress
from edgevpr.core.types import Frame, Place
from edgevpr.frames.positions import GeoTag, read_positions
from edgevpr.lab.simulate.foreseen import Flown, Foreseen, expect, late_s, with_truth
from edgevpr.lab.simulate.motion import read_track
from edgevpr.lab.simulate.processes import autopilot_process, started
from edgevpr.lab.simulate.rehearsal import SPEED_M_S, footprint_m, ground_under, write_rehearsal
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.power.boards import load_board
from edgevpr.review.album import Album, album_of_map
from edgevpr.review.logged import LoggedFlight, read_lines, value
from edgevpr.review.matchpage import thresholds_of
from edgevpr.review.overhead import read_ground
from edgevpr.review.page import page_of
from edgevpr.runtime.flight.flightlog import flight_of
from edgevpr.runtime.recognise.opening import open_recogniser

_MOST_GPS_S, _GPS_SHARE = 20.0, 0.25  # of the flight with GPS, from which its filter starts
_LEAST_S = 40.0
_POLLED_S = 1.0
_TRIED, _SPARE = 4, 1.5  # searches that are timed, and the time for a query in times the slowest of them

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A mission to rehearse: the file of its map, the pictures to take (see `read_shots`) of the ground of
    `orthophoto`, the least way between two, their angle of view, the seed of their sway, and the pictures of the map,
    for the page."""

    place_map: str
    shots: Sequence[GeoTag]
    orthophoto: str
    every_m: float
    fov_deg: float
    seed: int
    map_images: Sequence[str]


def rehearse(mission: Mission, folder: Path) -> Foreseen:
    """Fly a mission, and return what it lets expect. Leaves in `folder`, which is to be new or empty: images/ and
    positions.csv, flight.jsonl, flight.txt (what the programs said) and report.html. Raises UsageError for a track that
    is too short or leaves the orthophoto, EdgevprError if the flight fails or the computer is too slow for it."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} is there already, and not empty: name a new folder.")
    times_s = [shot.t_utc_s or 0.0 for shot in mission.shots]
    if (span_s := times_s[-1] - times_s[0]) < _LEAST_S:
        raise UsageError(f"The track is flown in {span_s:.0f} s: a rehearsal needs one of {_LEAST_S:.0f} s or more.")
    ground = read_ground(mission.place_map)
    references = album_of_map(mission.map_images, ground)
    orthophoto = Orthophoto(mission.orthophoto, ground_under(mission.shots, mission.fov_deg))
    mission = replace(mission, shots=thinned(mission.shots, _paced_m(mission)))
    try:
        _take_pictures(mission, folder, orthophoto)
    except UsageError:
        shutil.rmtree(folder)  # so that the command can be given again, with another track
        raise
    gps_until_s = min(_MOST_GPS_S, _GPS_SHARE * span_s)
    _fly(mission, folder, gps_until_s)
    flown = _read(folder)
    found = expect(flown, ground, footprint_m(mission.shots, mission.fov_deg), gps_until_s)
    flown.flight.notes = (answer_of(found),)
    _write_page(folder, flown.flight, ground, references)
    return found


def _paced_m(mission: Mission) -> float:
    """Return the way between two pictures: `every_m`, or as far as one is flown while this computer searches the whole
    map in vain. A camera's late pictures are dropped, a recording's are not: each would be later than the one before.
    """
    keys = {"map": mission.place_map, "source.camera": "nadir", "source.fov_deg": mission.fov_deg}
    config = load_config(None, keys)
    recogniser = open_recogniser(config, load_board(config.board))
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    image, took_s = np.ascontiguousarray(noise.repeat(4, 0).repeat(4, 1)), []
    for number in range(_TRIED):
        began_s = time.perf_counter()
        recogniser.step(Frame(image=image, name="noise", t_mono_s=float(number)))
        took_s.append(time.perf_counter() - began_s)
    recogniser.place_map.close()
    needed_m = SPEED_M_S * _SPARE * max(took_s[1:])  # the first one is slower than any later
    if needed_m > mission.every_m:
        _log.info("a query takes up to %.1f s here: pictures come every %.0f m", max(took_s[1:]), needed_m)
    return max(needed_m, mission.every_m)


def _take_pictures(mission: Mission, folder: Path, orthophoto: Orthophoto) -> None:
    """Write the pictures. Raises UsageError if some would show ground beyond the orthophoto."""
    taken = write_rehearsal(folder, orthophoto, list(mission.shots), mission.fov_deg, mission.seed)
    written = sum(1 for _ in progress(taken, len(mission.shots), "taking pictures"))
    if lacking := len(mission.shots) - written:
        raise UsageError(
            f"{mission.orthophoto} does not cover the track: {lacking} of {len(mission.shots)} pictures would show "
            "ground beyond it. Give one that reaches a picture's width beyond the track on all sides."
        )


def answer_of(found: Foreseen) -> str:
    """Return the outcome of a rehearsal in a sentence."""
    if not found.is_to_work:
        return f"This mission is not to be expected to work over this map: {'; '.join(found.reasons)}."
    most_m = found.autopilot_error.most_m if found.autopilot_error else math.nan
    return (
        f"This mission is to be expected to work over this map: without GPS the autopilot was at most {most_m:.0f} m "
        f"off, and no match was wrong."
    )


def _fly(mission: Mission, folder: Path, gps_until_s: float) -> None:
    """Fly the pictures in `folder` with the commands themselves."""
    log = folder / "flight.jsonl"
    camera = ("--camera", "nadir", "--fov-deg", mission.fov_deg)
    track = ("--track", folder / "positions.csv", "--gps-s", gps_until_s)
    with open(folder / "flight.txt", "w", encoding="utf-8") as said, autopilot_process(*track, said=said) as link:
        run = ("run", "--map", mission.place_map, "--source", folder / "images", *camera, "--link", link, "--log", log)
        with started(*run, said=said) as flight:
            count = len(mission.shots)
            for _ in progress(_queries_flown(flight, log), count, "flying"):
                pass


def _queries_flown(flight: "subprocess.Popen[bytes]", log: Path) -> Iterator[None]:
    """Yield once for each query in the log, until the flight has ended."""
    seen = 0
    while flight.poll() is None:
        with suppress(subprocess.TimeoutExpired):
            flight.wait(_POLLED_S)
        logged = log.read_bytes().count(b'"kind": "query"') if log.is_file() else 0
        yield from [None] * (logged - seen)
        seen = logged


def _read(folder: Path) -> Flown:
    """Read a flight, judged by where its pictures were taken. Raises EdgevprError if it ended early, or they came
    late."""
    log, tags = folder / "flight.jsonl", read_positions(folder / "positions.csv")
    lines = list(flight_of(log)) if log.is_file() else []
    flight = read_lines(lines, log)
    if not flight.end:
        last = (folder / "flight.txt").read_text("utf-8").strip().rpartition("\n")[2].removeprefix("edgevpr: ")
        raise EdgevprError(f"The flight has ended early: {last or 'it does not say why'}")
    if not flight.queries:
        raise EdgevprError(f"No picture became a query: {folder / 'flight.txt'} says why.")
    began_s = min(tag.t_utc_s or 0.0 for tag in tags.values())
    taken_s = [(tags[query.name].t_utc_s or 0.0) - began_s for query in flight.queries]
    start_s, is_late = late_s(taken_s, [query.line["t_frame_s"] for query in flight.queries])
    if is_late:
        took_s = sorted(after.t_s - query.t_s for query, after in pairwise(flight.queries))[-len(taken_s) // 10]
        raise EdgevprError(
            f"This computer is too slow for pictures so close together: from one query to the next it takes up to "
            f"{took_s:.1f} s, so they came late, and the flight shows the computer and not the map. Give a larger "
            "--every-m."
        )
    flight.truth = "the truth"
    places = [tags[query.name].position for query in flight.queries]
    flight.queries = [
        with_truth(query, (at.lat_deg, at.lon_deg)) for query, at in zip(flight.queries, places, strict=True) if at
    ]
    return Flown(flight, lines, read_track(folder / "positions.csv"), start_s)


def _write_page(folder: Path, flight: LoggedFlight, ground: Sequence[Place], references: Album) -> None:
    thresholds = thresholds_of(value(flight.start, "decided", "rule", "sure"))
    page = page_of(flight, ground, Album([folder / "images"]), references, thresholds=thresholds)
    write_whole(folder / "report.html", lambda out: out.write_text(page, "utf-8", errors="backslashreplace"))


def thinned(shots: Sequence[GeoTag], every_m: float) -> list[GeoTag]:
    """Return the shots that are at least `every_m` of the way after the one before them that is returned."""
    kept = [shots[0]]
    for shot in shots[1:]:
        if (shot.t_utc_s or 0.0) - (kept[-1].t_utc_s or 0.0) > every_m / SPEED_M_S - 1e-3:
            kept.append(shot)
    return kept
