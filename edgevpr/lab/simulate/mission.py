"""A mission rehearsed over a map: pictures along it from another orthophoto than the map's, flown in real time by a
real `edgevpr run` with a simulated plane that loses GPS on the way. `edgevpr simulate rehearsal` does it."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.core.text import at_work, progress
from edgevpr.frames.positions import GeoTag, read_positions
from edgevpr.lab.simulate.motion import read_track
from edgevpr.lab.simulate.processes import autopilot_process, run_to_end
from edgevpr.lab.simulate.rehearsal import footprint_m, ground_under, write_rehearsal
from edgevpr.lab.simulate.rehearsal_report import RehearsalReport, RehearsedFlight, judge_by_tags, report_on
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.review.album import album_of_map, make_album
from edgevpr.review.logged import read_lines
from edgevpr.review.overhead import read_ground
from edgevpr.review.page import make_flight_page
from edgevpr.runtime.flight.flightlog import select_last_flight

_MAX_GPS_S = 20.0  # of the flight with GPS, from which its filter starts
_GPS_SHARE = 0.25
_MIN_S = 40.0
_LATE_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A mission to rehearse: the file of its map, the pictures to take (see `read_shots`) of the ground of
    `orthophoto`, their angle of view, the seed of their sway, and the pictures of the map, for the page."""

    place_map: str
    shots: list[GeoTag]
    orthophoto: str
    fov_deg: float
    seed: int
    map_images: Sequence[str]


def rehearse(mission: Mission, folder: Path) -> RehearsalReport:
    """Fly a mission, and return what it lets expect. Leaves in `folder`, which is to be new or empty: images/ and
    positions.csv, flight.jsonl, flight.txt (the messages of the programs) and report.html. Raises UsageError for a
    track that is too short or leaves the orthophoto, EdgevprError if the flight fails or the computer is too slow for
    it."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} is there already, and not empty: name a new folder.")
    span_s = (mission.shots[-1].t_utc_s or 0.0) - (mission.shots[0].t_utc_s or 0.0)
    if span_s < _MIN_S:
        raise UsageError(f"The track is flown in {span_s:.0f} s: a rehearsal needs one of {_MIN_S:.0f} s or more.")
    ground = read_ground(mission.place_map)
    references = album_of_map(mission.map_images, ground)
    _take_pictures(mission, folder)
    gps_until_s = min(_MAX_GPS_S, _GPS_SHARE * span_s)
    _fly(mission, folder, gps_until_s)
    flown = _read(folder)
    report = report_on(flown, ground, footprint_m(mission.shots, mission.fov_deg), gps_until_s)
    flown.flight.notes = (report.answer,)
    page = make_flight_page(flown.flight, ground, make_album([folder / "images"]), references)
    write_whole(folder / "report.html", lambda out: out.write_text(page, "utf-8", errors="backslashreplace"))
    return report


def _take_pictures(mission: Mission, folder: Path) -> None:
    """Write the pictures. Raises UsageError, and leaves none, if some would show ground beyond the orthophoto."""
    orthophoto = Orthophoto(mission.orthophoto, ground_under(mission.shots, mission.fov_deg))
    try:
        taken = write_rehearsal(folder, orthophoto, mission.shots, mission.fov_deg, mission.seed)
        written = sum(1 for _ in progress(taken, len(mission.shots), "taking pictures"))
        if lacking := len(mission.shots) - written:
            raise UsageError(
                f"{mission.orthophoto} does not cover the track: {lacking} of {len(mission.shots)} pictures would show "
                "ground beyond it. Give one that reaches a picture's width beyond the track on all sides."
            )
    except UsageError:
        shutil.rmtree(folder)  # so that the command can be given again, with another track
        raise


def _fly(mission: Mission, folder: Path, gps_until_s: float) -> None:
    """Fly the pictures in `folder` with the commands themselves."""
    track = ("--track", folder / "positions.csv", "--gps-s", gps_until_s)
    camera = ("--source", folder / "images", "--camera", "nadir", "--fov-deg", mission.fov_deg)
    log = folder / "flight.jsonl"
    output_path = folder / "flight.txt"
    with open(output_path, "w", encoding="utf-8") as output, autopilot_process(*track, output=output) as link:
        run = ("run", "--map", mission.place_map, *camera, "--link", link, "--log", log)
        with at_work("flying"):
            run_to_end(*run, output=output)


def _read(folder: Path) -> RehearsedFlight:
    """Read a flight, judged by where its pictures were taken. Raises EdgevprError if they came late."""
    log, tags = folder / "flight.jsonl", read_positions(folder / "positions.csv")
    lines = list(select_last_flight(log))
    flight = read_lines(lines, log)
    if not flight.queries:
        raise EdgevprError(f"No picture became a query: {folder / 'flight.txt'} says why.")
    began_s = min(tag.t_utc_s or 0.0 for tag in tags.values())
    taken_s = [(tags[query.name].t_utc_s or 0.0) - began_s for query in flight.queries]
    start_s, is_late = find_start(taken_s, [query.line["t_frame_s"] for query in flight.queries])
    if is_late:
        raise EdgevprError(
            "This computer is too slow for pictures so close together: they came late, and the flight shows the "
            "computer and not the map. Give a larger --every-m."
        )
    judge_by_tags(flight, tags)
    return RehearsedFlight(flight, lines, read_track(folder / "positions.csv"), start_s)


def find_start(taken_s: Sequence[float], frames_s: Sequence[float]) -> tuple[float, bool]:
    """Return the start of the track on the clock of a log, by its least late picture, and True if the computer did not
    keep up: a tenth of the pictures came late. `taken_s` are the times of the pictures on the track, `frames_s` in the
    log."""
    starts_s = np.subtract(frames_s, taken_s)
    return float(starts_s.min()), bool(np.quantile(starts_s, 0.9) > starts_s.min() + _LATE_S)
