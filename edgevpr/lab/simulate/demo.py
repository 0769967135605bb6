"""Runs `edgevpr demo`: generates two flights and runs the real commands on them, each in a process of its own."""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from edgevpr.core.arrays import Image, LatLon
from edgevpr.core.errors import EdgevprError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.text import progress
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate import generated
from edgevpr.lab.simulate.camera import light_scene, project_view
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.review.logged import LoggedQuery, read_flight

_SEED = 1
_INTERVAL_S = 0.2  # between pictures of the later flight, which is replayed at the times of its pictures
_CAMERA = ("--camera", "nadir", "--fov-deg", 66)  # of the generated flights
# A place is correct if the two pictures overlap by 30 %. From a height of 80 m a picture shows 78 m of ground.
MAX_CORRECT_M = 55.0
_PICTURE_PX = (1600, 1050)
# Colours (blue, green, red) of the places, of the later flight, and of matches by outcome.
_MAPPED_COLOUR = (255, 255, 255)
_LATER_COLOUR = (10, 214, 255)
_CORRECT_COLOUR = (91, 191, 47)
_WRONG_COLOUR = (59, 56, 229)
_REJECTED_COLOUR = (36, 165, 245)
_LEGEND = {
    "places of flight 1": _MAPPED_COLOUR,
    "flight 2": _LATER_COLOUR,
    "accepted": _CORRECT_COLOUR,
    "accepted, wrong": _WRONG_COLOUR,
    "rejected: no position is sent": _REJECTED_COLOUR,
}


def run_demo(folder: str | Path) -> str:
    """Generate both flights, map the first, fly the second without a flight controller, and return the results as text.

    Writes to `folder`: flight-1/ and flight-2/ (images, positions.csv), map.gpkg, flight.jsonl and demo.png.
    Raises EdgevprError if a command fails."""
    folder = Path(folder)
    map_path, log_path, picture_path = (folder / name for name in ("map.gpkg", "flight.jsonl", "demo.png"))
    first, second = folder / "flight-1", folder / "flight-2"
    for old_file in (*folder.glob("map.gpkg*"), log_path, picture_path):
        old_file.unlink(missing_ok=True)
    scene = make_scene(_SEED, generated.SCENE_WIDTH_M, generated.SCENE_DEPTH_M)
    mapping = generated.plan_mapping_flight(_SEED)
    later = replace(generated.plan_later_flight(_SEED), interval_s=_INTERVAL_S)
    for out, flight, label in ((first, mapping, "flight 1, to map     "), (second, later, "flight 2, hours later")):
        for _ in progress(generated.write_flight(out, scene, flight), len(flight.poses), label):
            pass
    images = ("--images", first / "images", *_CAMERA)
    run_command("map", "build", map_path, *images, "--technique", "cohog", "--no-calibrate")
    run_command("run", "--map", map_path, "--source", second / "images", *_CAMERA, "--log", log_path)
    queries, places = read_queries(log_path, first, second)
    _draw(picture_path, light_scene(scene, mapping.light, mapping.seed), mapping, queries)
    return f"""{summarise(queries, places)}
picture           {picture_path}
page              edgevpr report {log_path} --out {folder / "report.html"}"""


def run_command(*words: object) -> None:
    """Run an edgevpr command and wait for it. Raises EdgevprError if it fails."""
    command = list(map(str, words))
    code = subprocess.run([sys.executable, "-m", "edgevpr", *command], stdout=subprocess.DEVNULL).returncode
    if code:
        raise EdgevprError(f"`edgevpr {' '.join(command)}` failed with exit code {code}: see its message above.")


def read_queries(log_path: Path, mapping_folder: Path, later_folder: Path) -> tuple[list[LoggedQuery], list[LatLon]]:
    """Read the queries of a flight log, with true positions from the positions.csv in `later_folder`, and the
    positions of the places from the one in `mapping_folder`."""
    true_positions, places = (
        {name: (tag.position.lat_deg, tag.position.lon_deg) for name, tag in tags.items() if tag.position}
        for tags in (read_positions(folder / "positions.csv") for folder in (later_folder, mapping_folder))
    )
    queries = [
        replace(query, gps_position=true_positions[query.name], true_position=true_positions[query.name])
        for query in read_flight(log_path).queries
        if query.name in true_positions
    ]
    return queries, list(places.values())


def is_correct(query: LoggedQuery) -> bool:
    """Return True if the matched place is near enough to the true position of the query."""
    return _are_near(query.true_position, query.place_position)


def _are_near(point: LatLon | None, other: LatLon | None) -> bool:
    return point is not None and other is not None and float(distance_m(*point, *other)) <= MAX_CORRECT_M


def summarise(queries: Sequence[LoggedQuery], places: Sequence[LatLon]) -> str:
    """Return the results as text."""
    on_map = [query for query in queries if any(_are_near(query.true_position, place) for place in places)]
    accepted = [query for query in queries if query.accepted]
    errors_m = [query.off_m or 0.0 for query in accepted] or [np.nan]
    off_map = len(queries) - len(on_map)
    off_map_rejected = off_map - sum(query not in on_map for query in accepted)
    recall = sum(map(is_correct, on_map)) / max(len(on_map), 1)
    return f"""
queries           {len(queries)}: {len(on_map)} over the map, {off_map} outside it
recall@1          {recall:.2f} of the queries over the map (best place within {MAX_CORRECT_M:g} m)
accepted          {len(accepted)}, {sum(not is_correct(query) for query in accepted)} of them wrong
rejected          {len(queries) - len(accepted)}, including {off_map_rejected} of the {off_map} outside the map
position error    median {np.median(errors_m):.1f} m, 90 % within {np.quantile(errors_m, 0.9):.1f} m, \
largest {max(errors_m):.1f} m (accepted queries; places are 21 m apart)"""


def _choose_colour(query: LoggedQuery) -> tuple[int, int, int]:
    if not query.accepted:
        return _REJECTED_COLOUR
    return _CORRECT_COLOUR if is_correct(query) else _WRONG_COLOUR


def _draw(path: Path, ground: Image, mapping: generated.GeneratedFlight, queries: Sequence[LoggedQuery]) -> None:
    """Draw both tracks on the lit landscape `ground`, uint8 (H, W, 3) BGR, and write the picture to `path`. Unmapped
    land is darkened, and a line connects each query to its matched place."""
    scale = _PICTURE_PX[0] / generated.SCENE_WIDTH_M

    def pixels(points_m: ArrayLike) -> list[tuple[int, int]]:
        return [(round(east * scale), round(_PICTURE_PX[1] - north * scale)) for east, north in np.asarray(points_m)]

    covered = np.zeros(_PICTURE_PX[::-1], np.uint8)
    for pose in mapping.poses:
        if (corners_m := project_view(pose, mapping.camera)) is not None:
            cv2.fillConvexPoly(covered, np.array(pixels(corners_m)), 1)
    picture = cv2.resize(ground, _PICTURE_PX, interpolation=cv2.INTER_AREA)
    picture = np.where(covered[..., None] > 0, picture, picture // 3 + 20).astype(np.uint8)
    mapped_px = pixels([(pose.east_m, pose.north_m) for pose in mapping.poses])
    matches = [query for query in queries if query.true_position and query.place_position]
    query_px = pixels([generated.to_metres(*query.true_position) for query in matches if query.true_position])
    place_px = pixels([generated.to_metres(*query.place_position) for query in matches if query.place_position])
    for track, colour in ((mapped_px, _MAPPED_COLOUR), (query_px, _LATER_COLOUR)):
        cv2.polylines(picture, [np.array(track)], False, colour, 2, cv2.LINE_AA)
    for place in mapped_px:
        cv2.circle(picture, place, 4, _MAPPED_COLOUR, -1, cv2.LINE_AA)
    for query, start, end in zip(matches, query_px, place_px, strict=True):
        cv2.line(picture, start, end, _choose_colour(query), 3 if query.accepted else 1, cv2.LINE_AA)
        cv2.circle(picture, start, 7, _choose_colour(query), -1, cv2.LINE_AA)
    for row, (text, colour) in enumerate(_LEGEND.items()):
        cv2.putText(picture, text, (20, 920 + 28 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
    cv2.imwrite(str(path), np.hstack([picture, _draw_pairs(path.parent, matches)]))


def _draw_pairs(folder: Path, queries: Sequence[LoggedQuery]) -> Image:
    """Draw ten queries, evenly spread over the flight, each next to its matched place: uint8 (H, W, 3) BGR."""
    pairs: list[Image] = []
    for index in np.linspace(0, len(queries) - 1, 10).astype(int):
        query = queries[index]
        files = (folder / "flight-2/images" / query.name, folder / f"flight-1/images/{query.reference_image}")
        pictures = [cv2.resize(read_image(file), (240, 180), interpolation=cv2.INTER_AREA) for file in files]
        pair = cv2.copyMakeBorder(np.hstack(pictures), 25, 5, 5, 5, cv2.BORDER_CONSTANT, value=_choose_colour(query))
        outcome = "rejected" if query.off_m is None else f"error {query.off_m:.1f} m"
        text = f"query and matched place: {outcome}, score {query.line['score']:.2f}"
        cv2.putText(pair, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        pairs.append(pair.astype(np.uint8))
    return np.hstack([np.vstack(pairs[:5]), np.vstack(pairs[5:])])
