"""The demonstration `edgevpr demo`: two generated flights, and the real commands between them, each as a process."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from edgevpr.core.arrays import Image
from edgevpr.core.geodesy import distance_m
from edgevpr.core.text import progress
from edgevpr.core.types import Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate.camera import lit, view_on_ground
from edgevpr.lab.simulate.generated import (
    SCENE_DEPTH_M,
    SCENE_WIDTH_M,
    GeneratedFlight,
    later_flight,
    mapping_flight,
    to_metres,
    write_flight,
)
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.lab.simulate.processes import autopilot_process, run_to_end
from edgevpr.runtime.flight.flightlog import flight_of

_SEED = 1
_INTERVAL_S = 0.2  # of the later flight, which is flown by the times of its pictures
_CAMERA = ("--camera", "nadir", "--fov-deg", 66)  # that of the generated flights
# A place is the right one where the two pictures share 30 % of their ground, which is 78 m long from a height of 80 m.
RIGHT_M = 55.0
_PICTURE_PX = (1600, 1050)
# Colours (blue, green, red) of the places, of the later flight, and of the answers by their outcome.
_MAPPED, _LATER = (255, 255, 255), (10, 214, 255)
_RIGHT, _WRONG, _REJECTED = (91, 191, 47), (59, 56, 229), (36, 165, 245)
_LEGEND = {
    "places of flight 1": _MAPPED,
    "flight 2": _LATER,
    "accepted": _RIGHT,
    "accepted, wrong": _WRONG,
    "rejected: no position is sent": _REJECTED,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedAnswer:
    """One query: `at` is the position where it was taken, `named` that of the place recognised. `is_right`: that place
    is near enough; `on_map`: the map has such a place. `fix_off_m` is the distance from `at` to the fix, in metres
    (None: the match was not accepted)."""

    query: str
    reference_image: str
    at: Position
    named: Position
    score: float
    is_right: bool
    on_map: bool
    fix_off_m: float | None

    @property
    def colour(self) -> tuple[int, int, int]:
        """The colour of its outcome in the picture."""
        if self.fix_off_m is None:
            return _REJECTED
        return _RIGHT if self.is_right else _WRONG


def run_demo(folder: str | Path) -> str:
    """Generate both flights, map the first one, fly the second one against a simulated flight controller; return what
    came out, as text.

    Leaves in `folder`: flight-1/ and flight-2/ (images, positions.csv), map.gpkg, flight.jsonl and demo.png.
    Raises EdgevprError where a part of it fails.
    """
    folder = Path(folder)
    log_path, picture_path = folder / "flight.jsonl", folder / "demo.png"
    for old in (*folder.glob("map.gpkg*"), log_path, picture_path):
        old.unlink(missing_ok=True)
    scene = make_scene(_SEED, SCENE_WIDTH_M, SCENE_DEPTH_M)
    mapping, later = mapping_flight(_SEED), replace(later_flight(_SEED), interval_s=_INTERVAL_S)
    for name, flight, label in (
        ("flight-1", mapping, "flight 1, to map     "),
        ("flight-2", later, "flight 2, hours later"),
    ):
        for _ in progress(write_flight(folder / name, scene, flight), len(flight.poses), label):
            pass
    _fly(folder)
    answers = read_answers(log_path, folder / "flight-1", folder / "flight-2")
    _draw(picture_path, lit(scene, mapping.light, mapping.seed), mapping, answers)
    return f"""{summary_of(answers)}
picture           {picture_path}
page              edgevpr report {log_path} --out {folder / "report.html"}"""


def summary_of(answers: Sequence[JudgedAnswer]) -> str:
    """Return the results as text."""
    on_map = [answer for answer in answers if answer.on_map]
    accepted = [answer for answer in answers if answer.fix_off_m is not None]
    errors_m = [answer.fix_off_m or 0.0 for answer in accepted] or [np.nan]
    off_map = len(answers) - len(on_map)
    off_map_rejected = off_map - sum(not answer.on_map for answer in accepted)
    recall = sum(answer.is_right for answer in on_map) / max(len(on_map), 1)
    return f"""
queries           {len(answers)}: {len(on_map)} over the map, {off_map} beyond it
recall@1          {recall:.2f} of those over the map (best place within {RIGHT_M:g} m)
accepted          {len(accepted)}, {sum(not answer.is_right for answer in accepted)} of them wrong
rejected          {len(answers) - len(accepted)}, among them {off_map_rejected} of the {off_map} beyond the map
position error    median {np.median(errors_m):.1f} m, 90 % within {np.quantile(errors_m, 0.9):.1f} m, \
largest {max(errors_m):.1f} m (of the accepted; places are 21 m apart)"""


def _fly(folder: Path) -> None:
    """Map the first flight of a demonstration and fly the second one."""
    first, second = folder / "flight-1" / "images", folder / "flight-2" / "images"
    map_path, log_path = folder / "map.gpkg", folder / "flight.jsonl"
    # The flight controller is started first: it listens long before the map is built.
    with autopilot_process() as link:
        run_to_end("map", "build", map_path, "--images", first, *_CAMERA, "--technique", "cohog", "--no-calibrate")
        run_to_end("run", "--map", map_path, "--source", second, *_CAMERA, "--link", link, "--log", log_path)


def read_answers(log_path: Path, mapped: Path, flown: Path) -> list[JudgedAnswer]:
    """Read the queries of a flight log, and judge them by the positions.csv in the folders of the two flights."""
    places, taken = (
        {name: tag.position for name, tag in read_positions(each / "positions.csv").items() if tag.position}
        for each in (mapped, flown)
    )
    answers = []
    for line in flight_of(log_path):
        if line["kind"] == "query":
            at, named, fix = taken[line["query"]], places[line["reference_image"]], line["located"]
            answers.append(
                JudgedAnswer(
                    query=line["query"],
                    reference_image=line["reference_image"],
                    at=at,
                    named=named,
                    score=line["score"],
                    is_right=_apart_m(at, named) <= RIGHT_M,
                    on_map=any(_apart_m(at, place) <= RIGHT_M for place in places.values()),
                    fix_off_m=_apart_m(at, Position(fix["lat_deg"], fix["lon_deg"])) if line["accepted"] else None,
                )
            )
    return answers


def _apart_m(one: Position, other: Position) -> float:
    return float(distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg))


def _draw(path: Path, ground: Image, mapping: GeneratedFlight, answers: Sequence[JudgedAnswer]) -> None:
    """Draw both tracks on the lit landscape `ground`, uint8 (H, W, 3) BGR, and write the picture to `path`. Land
    outside of the map is darkened, and a line joins each query to the place that was recognised."""
    scale = _PICTURE_PX[0] / SCENE_WIDTH_M

    def pixels(points_m: ArrayLike) -> list[tuple[int, int]]:
        return [(round(east * scale), round(_PICTURE_PX[1] - north * scale)) for east, north in np.asarray(points_m)]

    seen = np.zeros(_PICTURE_PX[::-1], np.uint8)
    for pose in mapping.poses:
        if (corners_m := view_on_ground(pose, mapping.camera)) is not None:
            cv2.fillConvexPoly(seen, np.array(pixels(corners_m)), 1)
    picture = cv2.resize(ground, _PICTURE_PX, interpolation=cv2.INTER_AREA)
    picture = np.where(seen[..., None] > 0, picture, picture // 3 + 20).astype(np.uint8)
    places = pixels([(pose.east_m, pose.north_m) for pose in mapping.poses])
    taken, named = (
        pixels([to_metres(at.lat_deg, at.lon_deg) for at in each])
        for each in ([answer.at for answer in answers], [answer.named for answer in answers])
    )
    for track, colour in ((places, _MAPPED), (taken, _LATER)):
        cv2.polylines(picture, [np.array(track)], False, colour, 2, cv2.LINE_AA)
    for place in places:
        cv2.circle(picture, place, 4, _MAPPED, -1, cv2.LINE_AA)
    for answer, here, there in zip(answers, taken, named, strict=True):
        cv2.line(picture, here, there, answer.colour, 1 if answer.fix_off_m is None else 3, cv2.LINE_AA)
        cv2.circle(picture, here, 7, answer.colour, -1, cv2.LINE_AA)
    for row, (text, colour) in enumerate(_LEGEND.items()):
        cv2.putText(picture, text, (20, 920 + 28 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
    cv2.imwrite(str(path), np.hstack([picture, _pairs(path.parent, answers)]))


def _pairs(folder: Path, answers: Sequence[JudgedAnswer]) -> Image:
    """Draw ten queries, evenly spread over the flight, each beside the picture of its place: uint8 (H, W, 3) BGR."""
    pairs: list[Image] = []
    for index in np.linspace(0, len(answers) - 1, 10).astype(int):
        answer = answers[index]
        files = (folder / "flight-1/images" / answer.reference_image, folder / "flight-2/images" / answer.query)
        place, query = (cv2.resize(read_image(file), (240, 180), interpolation=cv2.INTER_AREA) for file in files)
        pair = cv2.copyMakeBorder(np.hstack([query, place]), 25, 5, 5, 5, cv2.BORDER_CONSTANT, value=answer.colour)
        said = f"{answer.fix_off_m:.1f} m off" if answer.fix_off_m is not None else "rejected"
        text = f"query, and its place: {said}, score {answer.score:.2f}"
        cv2.putText(pair, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        pairs.append(pair.astype(np.uint8))
    return np.hstack([np.vstack(pairs[:5]), np.vstack(pairs[5:])])
