"""A map of pictures cut from one large picture of the ground, and a flight over it, for the tests of pages."""

from pathlib import Path

import cv2
import numpy as np
from logs import query
from pictures import draw_rough_ground

from edgevpr.core.geodesy import offset_position, picture_axes
from edgevpr.core.types import Place, Pose, Position

ORIGIN = 50.0, 8.0
SIDE_M = 40.0  # of a picture's longest side; pixels of the large picture
METRE_PX = 4
ROWS = 3
COLUMNS = 4
STEP_M = 20.0

LOW_REASON = {"code": "LOW_SCORE", "parameters": {"score": 0.004, "min_score": 0.01}}
UNCERTAIN = {"code": "LOW_CONFIDENCE", "parameters": {"confidence": 0.99, "min_confidence": 0.999, "landmarks": 30}}


def make_landscape() -> np.ndarray:
    """The ground, BGR, a metre `METRE_PX` pixels, with ORIGIN in its middle and north up."""
    seen = draw_rough_ground(560)
    return np.dstack((seen, 255 - seen, seen // 2))


def to_lat_lon(east_m: float, north_m: float) -> tuple[float, float]:
    """A point on the ground (lat_deg, lon_deg)."""
    return offset_position(*ORIGIN, east_m, north_m)


def write_places(folder: Path) -> list[Place]:
    """Cut a picture for each place of a grid, each turned otherwise, and write it into a folder."""
    ground, places = make_landscape(), []
    for at in range(ROWS * COLUMNS):
        middle_m = np.array([at % COLUMNS - (COLUMNS - 1) / 2, at // COLUMNS - (ROWS - 1) / 2]) * STEP_M
        up_deg = 25.0 * at
        width, height = int(SIDE_M * METRE_PX), int(0.75 * SIDE_M * METRE_PX)
        corners = np.array([[-1, 1, 1], [1, 1, -1]]) * [[width / 2], [height / 2]] / METRE_PX
        east, north = middle_m[:, None] + picture_axes(up_deg) @ corners
        seen = np.float32([280 + east * METRE_PX, 280 - north * METRE_PX]).T
        way = cv2.getAffineTransform(seen, np.float32([[0, 0], [width, 0], [width, height]]))
        name = f"{at:02d}.png"
        cv2.imwrite(str(folder / name), cv2.warpAffine(ground, way, (width, height)))
        pose = Pose(up_deg=up_deg % 360, footprint_m=SIDE_M, covariance_m2=(1.0, 0.0, 1.0))
        at_deg = Position(*to_lat_lon(*middle_m.tolist()))
        places.append(Place(place_id=at + 1, source_image=name, position=at_deg, pose=pose))
    return places


def make_flight_lines(places: list[Place], count: int) -> list[tuple[str, dict]]:
    """The lines of a flight over the places; every third query has a low confidence, every fifth a low score."""
    lines = []
    for number in range(count):
        place, t_s = places[number % len(places)], 1001.0 + number
        at = {"lat_deg": place.position.lat_deg, "lon_deg": place.position.lon_deg}
        is_low, refused = number % 5 == 4, number % 3 == 2 or number % 5 == 4
        found = {
            "place": place.place_id,
            "reference_image": place.source_image,
            "position": at,
            "located": None if refused else at,
            "accepted": not refused,
            "reason": LOW_REASON if is_low else UNCERTAIN,
            "vehicle": {**at, "t_received_s": t_s, "gps": at | {"lat_deg": at["lat_deg"] + 3e-5, "t_s": t_s}},
            "t_frame_s": t_s,
        }
        lines.append(("query", query(place.source_image if number < 8 else f"q{number}", **found, t_mono_s=t_s)))
        if refused:
            lines[-1][1]["fix"] = None
    return lines
