"""A map that refines itself: pictures of a generated flight with known true positions and noisy recorded ones."""

import csv
import dataclasses
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import expect_refusal, run_json
from map_writer import write_sql

from edgevpr.cli.main import main
from edgevpr.core.geodesy import distance_m, move_position, offset_position
from edgevpr.core.text import iterate_silently
from edgevpr.core.types import Frame, Pose, Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.lab.simulate.camera import Camera, light_scene, photograph
from edgevpr.lab.simulate.generated import plan_mapping_flight, to_position
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.mapmaking.refine import refine
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import describe_map
from edgevpr.runtime.recognise.opening import create_technique
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

NOISE_M = 5.0
GLITCH_M = 250.0
FOOTPRINT_M = 80.0 * 640 / 493  # of the generated camera
LEGS = 2
_DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).parents[3] / "shared" / "data")


@pytest.fixture(scope="module")
def flown_dir(tmp_path_factory):
    """A folder of pictures of two legs, their true poses, and noisy positions of which one is a glitch."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "images").mkdir()
    flight, rng, tags = plan_mapping_flight(7), np.random.default_rng(7), {}
    scene, poses = make_scene(7, 420.0, 220.0), flight.poses[: 14 * LEGS]
    ground = light_scene(scene, flight.light, flight.seed)
    for number, pose in enumerate(poses):
        image = photograph(ground, scene.metres_per_pixel, pose, Camera(), flight.light, rng)
        cv2.imwrite(str(folder / "images" / f"{number:03d}.jpg"), image)
        true, (east_m, north_m) = to_position(pose), rng.normal(0, NOISE_M, 2)
        east_m += GLITCH_M if number == 9 else 0.0
        tags[f"{number:03d}.jpg"] = GeoTag(position=move_position(true, east_m, north_m))
    write_positions(folder / "positions.csv", tags)
    return folder, poses


@pytest.fixture(scope="module")
def unrefined_map(flown_dir, tmp_path_factory):
    """A map of them, not refined."""
    path = tmp_path_factory.mktemp("built") / "m.gpkg"
    flags = ["--images", str(flown_dir[0] / "images"), "--technique", "cohog", "--camera", "nadir", "--no-refine"]
    assert main(["map", "build", str(path), *flags]) == 0
    return path


@pytest.fixture
def map_path(unrefined_map, tmp_path):
    return shutil.copy(unrefined_map, tmp_path / "m.gpkg")


def measure_errors_m(place_map, poses):
    """How far each place is from where it was taken, and its direction from that of the camera, in degrees."""
    off_m, rotation_deg = [], []
    for place, pose in zip(place_map.read_places(), poses, strict=True):
        true = to_position(pose)
        here = place.position
        off_m.append(float(distance_m(here.lat_deg, here.lon_deg, true.lat_deg, true.lon_deg)))
        if place.pose:
            rotation_deg.append((place.pose.up_deg - pose.heading_deg + 180) % 360 - 180)
    return np.array(off_m), np.array(rotation_deg)


def test_refine_moves_places_to_the_true_positions_of_their_images(flown_dir, map_path, capsys):
    _, poses = flown_dir
    with PlaceMap.open(map_path) as place_map:
        before_m, _ = measure_errors_m(place_map, poses)
    refined = run_json(capsys, "map", "refine", map_path)
    assert (refined["refined"], refined["is_mirrored"]) == (len(poses), False)
    ((place_id, image, off_m),) = refined["contradictory"]
    assert (place_id, image) == (10, "009.jpg")
    assert off_m == pytest.approx(GLITCH_M, abs=25)
    with PlaceMap.open(map_path) as place_map:
        after_m, rotation_deg = measure_errors_m(place_map, poses)
        footprints_m = np.array([place.pose.footprint_m for place in place_map.read_places()])
        info = describe_map(place_map)
        recorded = [place.pose.recorded for place in place_map.read_places()]
    assert np.median(after_m) < np.median(before_m) / 2
    assert after_m.max() < 10
    assert abs(rotation_deg).max() < 8
    assert abs(footprints_m / FOOTPRINT_M - 1).max() < 0.15
    assert (info.with_pose, info.footprints_m) == (len(poses), (pytest.approx(FOOTPRINT_M, rel=0.1),))
    assert 0.5 < info.position_sd_m < 6
    with PlaceMap.open(map_path) as place_map:
        assert len(recorded) == len(place_map)
        assert refined["moved_m"] > 1


@pytest.mark.parametrize("wrong", [lambda lat, lon: (lon, lat), lambda lat, lon: (lat, -lon)])
def test_refine_notices_exchanged_lat_and_lon_and_a_lost_sign(map_path, capsys, wrong):
    east_deg = 120.0  # the flight is moved to where its longitude could be a latitude
    with PlaceMap.open_for_writing(map_path) as place_map, place_map.transaction():
        for place in list(place_map.read_places()):
            lat_deg, lon_deg = wrong(place.position.lat_deg, place.position.lon_deg - east_deg)
            place_map.move_place(place.place_id, Position(lat_deg, lon_deg), None)
    refined = run_json(capsys, "map", "refine", map_path)
    assert (refined["refined"], refined["is_mirrored"]) == (0, True)


def test_refine_notices_positions_turned_against_the_recorded_headings(map_path, capsys, flown_dir):
    with PlaceMap.open_for_writing(map_path) as place_map, place_map.transaction():
        for place, pose in zip(list(place_map.read_places()), flown_dir[1], strict=True):
            recorded = Pose(up_deg=pose.heading_deg, footprint_m=FOOTPRINT_M, covariance_m2=(9.0, 0.0, 9.0))
            place_map.move_place(place.place_id, Position(-place.position.lat_deg, -place.position.lon_deg), recorded)
    refined = run_json(capsys, "map", "refine", map_path)
    assert (refined["refined"], abs(refined["turned_deg"])) == (0, pytest.approx(180, abs=8))


def test_refine_restarts_from_the_recorded_positions(map_path, capsys):
    def read_positions():
        with PlaceMap.open(map_path) as place_map:
            return [(place.position, place.pose) for place in place_map.read_places()]

    main(["map", "refine", str(map_path)])
    first = read_positions()
    main(["map", "refine", str(map_path)])
    assert read_positions() == first
    said = capsys.readouterr().out
    assert said.count("28 of 28") == said.count("place 10 (009.jpg)") == 2


def copy_some_places(unrefined_map, path, numbers, position=lambda number, place: place.position):
    """A map of some places of another, in this order, at other positions."""
    with PlaceMap.open(unrefined_map) as there, PlaceMap.create(path, there.spec) as place_map:
        for place in there.read_places(numbers):
            fine, _ = there.read_fine_part(place.place_id)
            (coarse,) = (part for place_id, *_, part in there.read_coarse_parts() if place_id == place.place_id)
            frame = Frame(
                image=np.zeros((8, 8), np.uint8),
                name=place.source_image,
                t_mono_s=0.0,
                position=position(place.place_id, place),
            )
            descriptor = create_technique(there).encode(np.zeros((64, 64), np.uint8))
            descriptor = dataclasses.replace(descriptor, coarse=coarse, fine=fine)
            place_map.add(frame, descriptor, landmarks=there.read_landmarks(place.place_id))
    return path


def refine_copy(path, images=None):
    with PlaceMap.open_for_writing(path) as place_map:
        return refine(place_map, create_technique(place_map), iterate_silently, images), list(place_map.read_places())


@pytest.mark.parametrize(
    ("numbers", "position", "refined", "without_position"),
    [
        ([1], None, 0, 0),  # one place
        ([1, 2, 3], None, 0, 0),  # too few to tell the scale
        (range(1, 9), None, 8, 0),  # in one line
        ([1, 7, 13, 28], None, 0, 0),  # that do not overlap
        (range(1, 9), lambda number, place: None, 0, 8),  # without positions
        (range(1, 9), lambda number, place: Position(50.0, 8.0), 0, 0),  # all recorded at one point
        (range(1, 9), lambda number, place: None if number % 2 else place.position, 4, 4),
    ],
)
def test_refine_refines_maps_of_any_kind_as_far_as_they_can_be(
    unrefined_map, tmp_path, numbers, position, refined, without_position
):
    path = copy_some_places(unrefined_map, tmp_path / "m.gpkg", numbers, *([position] if position else []))
    with PlaceMap.open(path) as place_map:
        before = [place.position for place in place_map.read_places()]
    found, places = refine_copy(path)
    assert (found.places, found.refined, found.without_position) == (len(before), refined, without_position)
    for place, was in zip(places, before, strict=True):
        if place.pose is None and was is not None:
            assert place.position == was, "a place that is not tied stays"


def test_refine_reports_and_claims_an_offset_in_the_direction_of_the_camera(flown_dir, map_path, capsys):
    _, poses = flown_dir
    with PlaceMap.open_for_writing(map_path) as place_map, place_map.transaction():
        for place, pose in zip(list(place_map.read_places()), poses, strict=True):
            behind = -20 * np.exp(1j * np.radians(90 - pose.heading_deg))
            place_map.move_place(place.place_id, move_position(place.position, behind.real, behind.imag), None)
    refined = run_json(capsys, "map", "refine", map_path)
    assert refined["common_offset_m"] == pytest.approx(20, abs=5)
    assert refined["position_sd_m"] == pytest.approx(20, abs=5)


@pytest.mark.parametrize("displacement_m", [40, 150])
def test_refine_reports_and_claims_that_half_of_the_positions_are_displaced(
    flown_dir, map_path, capsys, caplog, displacement_m
):
    _, poses = flown_dir
    with PlaceMap.open_for_writing(map_path) as place_map, place_map.transaction():
        for number, place in enumerate(list(place_map.read_places())):
            if 7 <= number < 21:
                place_map.move_place(place.place_id, move_position(place.position, displacement_m, 0.0), None)
    refined = run_json(capsys, "map", "refine", map_path)
    first, last, shift_m = refined["displaced"]
    assert (first, last) == ("007.jpg", "020.jpg")
    assert shift_m == pytest.approx(displacement_m, rel=0.2)
    assert refined["position_sd_m"] == pytest.approx(shift_m, rel=0.1)
    assert "007.jpg to 020.jpg are displaced" in caplog.text
    with PlaceMap.open(map_path) as place_map:
        off_m, _ = measure_errors_m(place_map, poses)
        claimed_m = [place.pose.covariance_m2[0] ** 0.5 for place in place_map.read_places()]
    assert (off_m < claimed_m).all()


def test_refine_claims_no_displacement_of_a_map_without_one(map_path, capsys, monkeypatch):
    refined = run_json(capsys, "map", "refine", map_path)
    assert refined["displaced"] is None
    monkeypatch.setattr("edgevpr.mapmaking.refine.find_displaced_run", lambda recorded, solution: (range(0), 0j))
    assert run_json(capsys, "map", "refine", map_path)["position_sd_m"] == refined["position_sd_m"]


@pytest.mark.data
def test_refine_ties_images_by_votes_without_landmarks(tmp_path):
    folder = _DATA / "aerial_garfield28"
    if not folder.is_dir():
        pytest.skip("the pictures are not here")
    technique = create("cohog", {"camera": "nadir"})
    with PlaceMap.create(tmp_path / "m.gpkg", technique.spec) as place_map:
        for row in csv.DictReader((folder / "mosaic_positions.csv").open()):
            if (path := folder / "ref" / row["file"]).is_file():
                here, image = (float(row["x_px"]) / 10, -float(row["y_px"]) / 10), read_image(path)
                position = Position(*offset_position(50.0, 8.0, *here))
                frame = Frame(image=image, name=row["file"], t_mono_s=0.0, position=position)
                place_map.add(frame, technique.encode(image))
    found, _ = refine_copy(tmp_path / "m.gpkg", folder / "ref")
    assert (found.refined, found.contradictory) == (19, ())
    assert found.moved_m < 1.0
    assert found.ties > 65, "of a hundred pairs many overlap by a strip only"


def test_refine_leaves_surveyed_places_unchanged(unrefined_map, tmp_path):
    with PlaceMap.open(unrefined_map) as there, PlaceMap.create(tmp_path / "m.gpkg", there.spec) as place_map:
        lies = Pose(up_deg=0.0, footprint_m=80.0, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=True)
        (first, *_) = there.read_places([1])
        descriptor = create_technique(there).encode(np.zeros((64, 64), np.uint8))
        frame = Frame(image=np.zeros((8, 8), np.uint8), name="1", t_mono_s=0.0, position=first.position, pose=lies)
        place_map.add(frame, descriptor)
    found, (place,) = refine_copy(tmp_path / "m.gpkg")
    assert (found.surveyed, found.refined) == (1, 0)
    assert place.pose == lies


def test_map_refine_explains_why_a_map_cannot_be_refined(tmp_path, flown_dir, map_path, capsys):
    path = tmp_path / "hog.gpkg"
    assert main(["map", "build", str(path), "--images", str(flown_dir[0] / "images"), "--technique", "hog"]) == 0
    assert "refined:" not in capsys.readouterr().out, "a map of another kind is built as it was"
    assert "--camera nadir" in expect_refusal(capsys, "map", "refine", path)


def test_refine_skips_an_unreadable_place(map_path):
    write_sql(
        map_path,
        "UPDATE places SET landmarks = x'00' WHERE place_id = 3",
        "UPDATE places SET up_deg = 5, pose_crc32 = 1 WHERE place_id = 5",
    )
    with PlaceMap.open_for_writing(map_path) as place_map:
        found = refine(place_map, create_technique(place_map), iterate_silently)
    assert found.places == 27
    assert found.refined >= 25
