"""Levelling in the walk: queries find places that were seen from elsewhere, and bad data costs recognition at most."""

import logging
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from fakes import make_vehicle
from pictures import draw_rough_ground
from walks import make_map, walk_over

from edgevpr.core.config import load_config
from edgevpr.core.geodesy import offset_m
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position
from edgevpr.frames.level import STRAIGHT_DOWN, UNKNOWN_VIEW, Lens, LevelledImage, Mount, View, enlarge_image
from edgevpr.frames.mask import OverlayMask
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, ground_to_pixel, photograph
from edgevpr.places.layers import Layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.decide import MatchSettings
from edgevpr.runtime.recognise.hints import Prior, RecordedPrior
from edgevpr.runtime.recognise.levelling import Levelling, centre_place, make_levelling
from edgevpr.techniques import create

CAMERA = Camera(noise_sigma=0)
LENS = Lens(2 * math.degrees(math.atan(320 / CAMERA.focal_px)))
HEIGHT_M = 100.0
FOOTPRINT_M = HEIGHT_M * 640 / CAMERA.focal_px
LAYER = Layers(FOOTPRINT_M, (FOOTPRINT_M,), np.zeros(0, int), np.zeros(0, int))
NORTH_M = (120.0, 240.0, 360.0, 480.0)
M_PER_DEG = 111_195.0
LEVEL_POSE = {"height_m": HEIGHT_M, "heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0}


@pytest.fixture(scope="module")
def ground():
    return cv2.cvtColor(draw_rough_ground(2400), cv2.COLOR_GRAY2BGR)


def frame(ground, place, t_mono_s=0.0, told=None, **pose):
    """The picture of a place, the middle of it in the middle, and what is told of it (None: the truth)."""
    pose = LEVEL_POSE | pose
    heading, pitch = math.radians(pose["heading_deg"]), math.radians(pose["pitch_deg"])
    ahead_m = math.tan(pitch) * pose["height_m"]
    east_m = 300 - ahead_m * math.sin(heading)
    where = CameraPose(east_m=east_m, north_m=NORTH_M[place] - ahead_m * math.cos(heading), **pose)
    light = Light(sun_azimuth_deg=0, sun_elevation_deg=60)
    image = photograph(ground, 0.25, where, CAMERA, light, np.random.default_rng(0))
    position = Position(50 + where.north_m / M_PER_DEG, 8.0)
    return Frame(image=image, name=f"{place}", t_mono_s=t_mono_s, position=position, **(pose if told is None else told))


@pytest.fixture(scope="module")
def technique():
    return create("cohog", {"camera": "nadir"})


@pytest.fixture(scope="module")
def place_map(ground, technique, tmp_path_factory):
    """A map of four places, made at various headings and tilts, north-up."""
    path = tmp_path_factory.mktemp("levelled") / "m.gpkg"
    poses = ({"heading_deg": 90.0}, {"pitch_deg": 8.0}, {"heading_deg": 200.0, "pitch_deg": -6.0}, {})
    frames = [frame(ground, place, **pose) for place, pose in enumerate(poses)]
    levelling = Levelling(LENS, below=True, is_live=False)
    with PlaceMap.open(make_map(path, technique, frames, levelling=levelling)) as opened:
        yield opened


@pytest.fixture
def walk(place_map, technique):
    def make_walk(levelling, prior=None, mask=None):
        encoder = {"levelling": levelling, "mask": mask}
        return walk_over(place_map, technique, settings=MatchSettings(), encoder=encoder, prior=prior)

    return make_walk


def make_scaling(is_live=False):
    return Levelling(LENS, is_live=is_live)


def is_recognised(event, place):
    return event.accepted and event.best.place.source_image == f"{place}"


DIFFICULT_POSE = {"heading_deg": 130.0, "pitch_deg": 20.0, "height_m": 45.0}


@pytest.mark.slow
def test_step_finds_the_place_from_another_height_heading_and_tilt(walk, ground):
    as_it_is = walk(None).step(frame(ground, 1, **DIFFICULT_POSE))
    event = walk(make_scaling()).step(frame(ground, 1, **DIFFICULT_POSE))
    assert is_recognised(event, 1)
    assert event.best.match.score > as_it_is.best.match.score
    assert event.view.up_deg == 0.0
    assert event.view.footprint_m == pytest.approx(FOOTPRINT_M)
    off_m = 45 * math.tan(math.radians(20))
    assert math.hypot(*event.view.nadir_offset) * FOOTPRINT_M == pytest.approx(off_m)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        {"roll_deg": math.nan, "pitch_deg": math.nan},
        *({"height_m": HEIGHT_M * factor} for factor in (-0.05, 0.5, 100.0)),
        {"heading_deg": math.inf},
        {"heading_deg": None, "roll_deg": None, "pitch_deg": None, "height_m": None},
    ],
)
def test_step_finds_a_level_image_whatever_attitude_is_reported(walk, ground, wrong):
    event = walk(make_scaling()).step(frame(ground, 2, told=LEVEL_POSE | wrong))
    assert not event.failed
    assert is_recognised(event, 2)


@pytest.mark.slow
@pytest.mark.parametrize("pitch_deg", [30.0, 45.0, 52.0, 60.0])
def test_step_locates_the_aircraft_from_a_steep_image_of_known_angles(walk, ground, pitch_deg):
    steep = frame(ground, 2, pitch_deg=pitch_deg)
    event = walk(make_scaling()).step(steep)
    assert is_recognised(event, 2)
    found = event.located.position
    assert math.hypot(*offset_m(steep.position.lat_deg, 8.0, found.lat_deg, found.lon_deg)) < 5.0


@pytest.mark.slow
def test_step_claims_half_of_a_strip_that_never_changes(walk, ground):
    asked, frames = walk(make_scaling()), [frame(ground, number % 4) for number in range(10)]
    events = [asked.step(replace(seen, image=np.pad(seen.image, ((0, 0), (0, 96), (0, 0))))) for seen in frames]
    true, located = frames[-1].position, events[-1].located
    error_m = math.hypot(*offset_m(true.lat_deg, true.lon_deg, located.position.lat_deg, located.position.lon_deg))
    assert error_m == pytest.approx(FOOTPRINT_M * 48 / 640, abs=2.0)
    assert min(located.accuracy_m, located.common_tilt_m) > 0.9 * error_m


@pytest.mark.slow
def test_prepare_warps_the_mask_with_the_image(walk, ground):
    seen = frame(ground, 1, heading_deg=180.0)
    image = seen.image.copy()
    image[:120, :160] = np.random.default_rng(1).integers(0, 256, (120, 160, 3))
    allowed = np.ones(image.shape[:2], bool)
    allowed[:124, :164] = False
    asked = walk(make_scaling(), mask=OverlayMask(allowed, ""))
    covered, clean = asked.step(replace(seen, image=image)), asked.step(seen)
    assert np.array_equal(covered.descriptor.fine, clean.descriptor.fine)
    assert is_recognised(covered, 1)


@pytest.mark.slow
def test_prepare_refuses_too_large_a_tilt_and_reports_it_once(walk, ground, caplog):
    asked = walk(make_scaling())
    steep = frame(ground, 1, told=LEVEL_POSE | {"roll_deg": 65.0})
    with caplog.at_level(logging.WARNING):
        events = [asked.step(steep) for _ in range(3)]
    reasons = [event.view.reason for event in events]
    assert [(event.accepted, event.reason.code) for event in events] == [(False, ReasonCode.TILTED)] * 3
    assert reasons[0].code is ReasonCode.TILTED
    assert reasons[0].parameters["tilt_deg"] == pytest.approx(65.0)
    assert [record.message.startswith(f"1: {reasons[0]} (") for record in caplog.records] == [True]


def test_centre_place_has_the_position_of_the_image_centre():
    at = Frame(image=np.zeros((8, 8), np.uint8), name="", t_mono_s=0.0, position=Position(50.0, 8.0, 300.0))
    # The aircraft is west of the middle.
    east = centre_place(at, View(up_deg=90.0, footprint_m=100.0, nadir_offset=(0.0, -0.3)))
    assert east.position.lon_deg == pytest.approx(8.0 + 30 / (M_PER_DEG * math.cos(math.radians(50))), abs=1e-7)
    assert east.position.lat_deg == pytest.approx(50.0, abs=1e-9)
    assert (east.position.alt_m, east.heading_deg) == (300.0, 90.0)
    assert (east.pose.up_deg, east.pose.footprint_m, east.pose.covariance_m2) == (90.0, 100.0, (25.0, 0.0, 25.0))
    untold = centre_place(at, View(up_deg=0.0, footprint_m=100.0))
    assert (untold.position, untold.pose.covariance_m2) == (at.position, (41.0, 0.0, 41.0)), "its tilt is unknown"


@pytest.mark.parametrize("view", [View(), View(up_deg=0.0), View(footprint_m=50.0, nadir_offset=(0.1, 0.1))])
def test_centre_place_has_no_pose_without_height_or_heading(view):
    at = Frame(image=np.zeros((8, 8), np.uint8), name="", t_mono_s=0.0, position=Position(50.0, 8.0), heading_deg=70.0)
    found = centre_place(at, view)
    assert (found.pose, found.position) == (None, at.position)
    assert found.heading_deg == (70.0 if view.up_deg is None else view.up_deg)


@pytest.mark.parametrize(
    ("camera", "settings", "kind"),
    [
        ("nadir", {"source.fov_deg": 66.0}, Levelling),
        ("nadir", {}, Levelling),
        ("nadir", {"source.gimbal": True}, Levelling),
        ("forward", {"source.fov_deg": 66.0}, type(None)),
    ],
)
def test_make_levelling_requires_a_downward_camera(camera, settings, kind, caplog):
    config = load_config(None, settings)
    with caplog.at_level(logging.INFO):
        made = make_levelling(config.source, create("cohog", {"camera": camera}))
    assert isinstance(made, kind)
    assert bool(caplog.text) == (camera == "nadir" and not settings.get("source.fov_deg"))


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 215.0])
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (20.0, 0.0), (0.0, -15.0), (-15.0, 10.0)])
def test_prepare_reports_the_tilt_of_an_image_without_a_lens(roll_deg, pitch_deg, heading_deg):
    how = {"heading_deg": heading_deg, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
    pose = CameraPose(east_m=0.0, north_m=0.0, height_m=80.0, **how)
    camera = Camera()
    to_pixel = ground_to_pixel(pose, camera)
    east, north, scale = np.linalg.solve(to_pixel, (camera.width / 2 - 0.5, camera.height / 2 - 0.5, 1.0))
    told = how | {"height_m": 80.0}
    vehicle = make_vehicle(50.0, 8.0, 5.0, **told)
    frame = Frame(image=np.zeros((48, 64), np.uint8), name="", t_mono_s=5.0)
    view = Levelling(None, is_live=True).prepare(frame, vehicle, None).view
    assert view.nadir_offset_m == pytest.approx((-east / scale, -north / scale), abs=0.15)
    assert Levelling(None, is_live=False).prepare(frame, vehicle, None).view == UNKNOWN_VIEW, "it is of another time"
    assert Levelling(None, is_live=True).prepare(replace(frame, t_mono_s=7.0), vehicle, None).view == UNKNOWN_VIEW
    assert Levelling(None, is_live=False).prepare(replace(frame, **told), None, None).view == view, "a recording's own"


def test_prepare_reports_too_large_a_tilt_and_no_view_without_a_heading():
    frame = Frame(image=np.zeros((48, 64), np.uint8), name="", t_mono_s=5.0, roll_deg=50.0, pitch_deg=0.0)
    assert Levelling(None, is_live=False).prepare(frame, None, None).view.reason.code is ReasonCode.TILTED
    assert Levelling(None, is_live=False).prepare(replace(frame, roll_deg=20.0), None, None).view == UNKNOWN_VIEW


def test_prepare_ignores_the_attitude_with_a_gimbal():
    frame = Frame(image=np.random.default_rng(1).integers(0, 255, (48, 64), np.uint8), name="", t_mono_s=5.0)
    told = {"heading_deg": 30.0, "height_m": 80.0}
    banked, level = (make_vehicle(50.0, 8.0, 5.0, roll_deg=roll, pitch_deg=5.0 * roll, **told) for roll in (9.0, 0.0))
    hung = Levelling(Lens(66.0), is_on_gimbal=True, is_live=True).prepare(frame, banked, None)
    fixed = Levelling(Lens(66.0), is_live=True).prepare(frame, level, None)
    assert hung.view == fixed.view
    assert np.array_equal(hung.image, fixed.image)


@pytest.mark.parametrize("lens", [LENS, None])
def test_prepare_knows_the_tilt_of_a_recorded_image_of_a_gimbal(lens):
    frame = Frame(image=np.zeros((48, 64), np.uint8), name="", t_mono_s=5.0)
    views = [
        Levelling(lens, is_on_gimbal=is_on_gimbal, is_live=False).prepare(each, None, None).view
        for is_on_gimbal in (True, False)
        for each in (frame, replace(frame, roll_deg=0.0, pitch_deg=40.0))
    ]
    straight, tilted, unknown, _ = views
    assert straight.nadir_offset == pytest.approx((0.0, 0.0), abs=1e-9)
    assert tilted.reason if lens is None else tilted.nadir_offset[1] < -0.3, "its own angles count"
    assert not unknown.is_tilt_known


@pytest.mark.parametrize("fov_deg", [LENS.fov_deg, None])
def test_prepare_applies_the_configured_mount_with_and_without_lens_or_gimbal(technique, fov_deg):
    """Of a camera that looks 9 degrees ahead, the point under it is 16 m behind what it shows."""
    said = {"source.fov_deg": fov_deg, "source.uri": "/dev/video0", "source.mount_ahead_deg": 9.0}
    for gimbal in (False, True):
        config = load_config(None, said | {"source.gimbal": gimbal}).source
        frame = Frame(image=np.zeros((480, 640), np.uint8), name="", t_mono_s=5.0)
        vehicle = make_vehicle(50.0, 8.0, 5.0, heading_deg=90.0, height_m=HEIGHT_M, roll_deg=0.0, pitch_deg=0.0)
        view = make_levelling(config, technique).prepare(frame, vehicle, None, layers=LAYER).view
        off_m = view.nadir_offset_m if fov_deg is None else FOOTPRINT_M * np.array(view.nadir_offset)
        assert off_m == pytest.approx((-HEIGHT_M * math.tan(math.radians(9)), 0.0), abs=1e-6)
        assert view.nadir_height_m == (HEIGHT_M if fov_deg is None else None), "an unknown lens does not confirm it"


@pytest.mark.slow
@pytest.mark.parametrize("heading_deg", [0.0, 130.0])
def test_step_locates_a_tilted_camera_correctly_only_with_its_mount(walk, ground, heading_deg):
    seen = frame(ground, 1, heading_deg=heading_deg, pitch_deg=9.0, told=LEVEL_POSE | {"heading_deg": heading_deg})
    ahead_m = HEIGHT_M * math.tan(math.radians(9))
    turn = math.radians(heading_deg)
    true_m = np.array([-ahead_m * math.sin(turn), NORTH_M[1] - ahead_m * math.cos(turn)])
    wrong_m = []
    recogniser = walk(Levelling(replace(LENS, mount=Mount(9.0)), is_live=False))
    for mount in (Mount(9.0), STRAIGHT_DOWN, Mount(9.0)):
        recogniser.change(mount=mount)
        event = recogniser.step(seen)
        assert is_recognised(event, 1)
        at = event.located.position
        wrong_m.append(math.dist(offset_m(50.0, 8.0, at.lat_deg, at.lon_deg), true_m))
    assert max(wrong_m[0], wrong_m[2]) < 2.5
    assert wrong_m[1] == pytest.approx(ahead_m, abs=2.5)


@pytest.mark.slow
@pytest.mark.parametrize(("pitch_deg", "reported_deg"), [(20.0, None), (60.0, None), (20.0, 0.0), (60.0, 0.0)])
def test_step_claims_an_unreported_tilt(walk, ground, pitch_deg, reported_deg):
    told = LEVEL_POSE | {"roll_deg": reported_deg, "pitch_deg": reported_deg}
    event = walk(make_scaling()).step(frame(ground, 1, pitch_deg=pitch_deg, told=told))
    ahead_m = HEIGHT_M * math.tan(math.radians(pitch_deg))
    assert event.accepted or pitch_deg > 12
    assert not event.accepted or event.accuracy_m > min(40.0, ahead_m / 2)


@pytest.mark.slow
def test_step_needs_no_attitude_for_a_level_image(walk, ground):
    event = walk(make_scaling()).step(frame(ground, 1, told=LEVEL_POSE | {"roll_deg": None, "pitch_deg": None}))
    assert is_recognised(event, 1)
    assert event.accuracy_m < 10


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.7, 1.3, 1.4])
def test_step_corrects_a_wrong_recorded_height_after_the_first_match(walk, ground, factor):
    prior = RecordedPrior(("height",))
    recogniser = walk(make_scaling(), prior)
    told = LEVEL_POSE | {"height_m": factor * HEIGHT_M}
    first, second = (recogniser.step(frame(ground, place, told=told)) for place in (3, 2))
    assert is_recognised(first, 3)
    assert is_recognised(second, 2)
    assert second.view.footprint_m == pytest.approx(FOOTPRINT_M, rel=0.05)
    assert prior.searches_heights, "until three matches agree"


@pytest.mark.parametrize("lens", [LENS, None])
def test_step_corrects_a_wrong_reported_height_after_the_first_match(walk, ground, technique, lens):
    follow = walk(Levelling(lens, is_live=False), Prior(None, technique.spec.heading_within_deg, is_live=False))
    told = LEVEL_POSE | {"height_m": 1.25 * HEIGHT_M}
    first, second = (
        follow.step(frame(ground, place, told=told, height_m=1.25 * HEIGHT_M if lens is None else HEIGHT_M))
        for place in (3, 2)
    )
    assert is_recognised(first, 3)
    assert is_recognised(second, 2)
    assert first.best.match.height_ratio == pytest.approx(1.25 if lens is None else 0.8, rel=0.04)
    assert second.best.match.height_ratio == pytest.approx(1.0 if lens else 1.42, rel=0.04)
    assert second.view.zoom == pytest.approx(1.0 if lens else 1.25 / 1.42, rel=0.04)
    if lens:
        assert second.view.footprint_m == pytest.approx(FOOTPRINT_M, rel=0.04)
        assert second.located.height_m == pytest.approx(HEIGHT_M, rel=0.05)


@pytest.mark.parametrize("zoom", [0.5, 2.0])
def test_enlarge_image_scales_around_the_centre(zoom):
    image = np.zeros((81, 121), np.uint8)
    image[40, 60] = image[40, 60 + 12] = 255
    picture = enlarge_image(LevelledImage(image, None, UNKNOWN_VIEW), zoom)
    assert picture.view.zoom == zoom
    assert picture.image[40, 60] == 255
    assert picture.image[40, 60 + round(12 * zoom)] > 100
    assert (picture.mask is None) == (zoom > 1)
    if zoom < 1:
        assert picture.mask.mean() == pytest.approx(zoom**2, rel=0.05)
        assert not picture.mask[0].any()


@pytest.mark.slow
def test_accuracy_in_the_world_contains_an_error_of_the_reported_tilt(walk, ground):
    event = walk(make_scaling()).step(frame(ground, 1, told=LEVEL_POSE))
    assert is_recognised(event, 1)
    assert event.accuracy_m == pytest.approx(math.hypot(event.located.accuracy_m, 0.01746 * HEIGHT_M), rel=0.05)
