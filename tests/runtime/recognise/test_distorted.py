"""Lenses with distortion in the walk: positions in metres, where map and query were taken by different cameras."""

import math

import cv2
import pytest
from distorted_cameras import DistortedCamera, make_fisheye_camera, make_wide_camera
from pictures import draw_rough_ground

from edgevpr.core.config import load_config
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Frame, Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.mapmaking.making import MapPlan, make_map
from edgevpr.mapmaking.pictures import FlightPictures
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser

pytestmark = pytest.mark.slow

ORIGIN = 50.0, 8.0
M_PER_PX = 0.25
FOCAL_PX = 493.0
CAMERAS = {
    "straight": DistortedCamera(FOCAL_PX, (0,) * 4),
    "wide": make_wide_camera(),
    "fisheye": make_fisheye_camera(),
}
SEEN_DEG = {"straight": 2 * math.degrees(math.atan(320 / FOCAL_PX)), "wide": 101.0, "fisheye": 136.0}
STRAIGHT = {"height_m": 100.0, "heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0}
ROUTE_M = [
    (262.0, 196.0, {"heading_deg": 40.0}),
    (240.0, 310.0, {"roll_deg": 10.0, "pitch_deg": -6.0, "heading_deg": 200.0}),
    (255.0, 205.0, {"height_m": 80.0, "pitch_deg": 12.0}),
]


@pytest.fixture(scope="module")
def ground():
    return draw_rough_ground(2000)


@pytest.fixture(scope="module")
def lenses(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lenses")
    return {name: str(camera.write(folder / f"{name}.yaml")) for name, camera in CAMERAS.items()}


@pytest.fixture(scope="module")
def maps(ground, lenses, tmp_path_factory):
    """Maps of three places, made of pictures of each camera."""
    made = {}
    for name, camera in CAMERAS.items():
        folder, tags = tmp_path_factory.mktemp(name), {}
        for number, north_m in enumerate((100.0, 200.0, 300.0)):
            image = camera.photograph(ground, M_PER_PX, east_m=250.0, north_m=north_m, **STRAIGHT)
            cv2.imwrite(str(folder / f"{number}.png"), image)
            tags[f"{number}.png"] = GeoTag(position=Position(*offset_position(*ORIGIN, 250.0, north_m)), **STRAIGHT)
        write_positions(folder / "positions.csv", tags)
        made[name] = str(folder / "map.gpkg")
        pictures = FlightPictures(source=str(folder))
        asked = {"technique": "cohog", "parameters": {"camera": "nadir"}, "refine": False, "calibrate": False}
        order = MapPlan(path=made[name], pictures=pictures, **asked)
        make_map(order, load_config(None, {"source.lens": lenses[name]}), pytest.fail, lambda all_, *_: all_)
    return made


def measure_errors_m(map_path, camera, ground, **source):
    """How far off the positions of accepted queries are; None for one that is not accepted."""
    settings = load_config(None, {"map": map_path, **{f"source.{key}": value for key, value in source.items()}})
    recogniser, found = open_recogniser(settings, load_board("this")), []
    with recogniser.place_map:
        for east_m, north_m, changed in ROUTE_M:
            pose = STRAIGHT | changed
            image = camera.photograph(ground, M_PER_PX, east_m=east_m, north_m=north_m, **pose)
            event = recogniser.step(Frame(image=image, name="it", t_mono_s=0.0, **pose))
            assert not event.failed, event.reason
            where = event.located.position if event.accepted else None
            truth = offset_position(*ORIGIN, east_m, north_m)
            found.append(where and math.hypot(*offset_m(*truth, where.lat_deg, where.lon_deg)))
    return found


@pytest.mark.parametrize(("of", "by"), [("straight", "wide"), ("wide", "fisheye"), ("fisheye", "straight")])
def test_cameras_find_their_position_in_the_map_of_any_camera(maps, lenses, ground, of, by):
    assert max(measure_errors_m(maps[of], CAMERAS[by], ground, lens=lenses[by])) < 4.0


def test_positions_are_wrong_without_a_calibration(maps, ground):
    found = measure_errors_m(maps["straight"], CAMERAS["wide"], ground, fov_deg=SEEN_DEG["wide"])
    assert max(each or math.inf for each in found) > 5.0


def test_field_of_view_that_contradicts_the_calibration_is_refused(maps, lenses, ground):
    with pytest.raises(UsageError, match=r"`source\.fov_deg` is 66"):
        measure_errors_m(maps["wide"], CAMERAS["wide"], ground, lens=lenses["wide"], fov_deg=66.0)
    assert measure_errors_m(maps["wide"], CAMERAS["wide"], ground, lens=lenses["wide"], fov_deg=SEEN_DEG["wide"])
