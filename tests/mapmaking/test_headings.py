"""Headings of a tilted camera, by the motion from image to image."""

from dataclasses import replace

import numpy as np
import pytest
from pictures import draw_rough_ground

from edgevpr.core.geodesy import offset_position
from edgevpr.core.types import Frame, Position
from edgevpr.frames.level import Lens
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, photograph
from edgevpr.mapmaking.headings import find_headings

CAMERA = Camera(width=320, height=240, focal_px=246.5, noise_sigma=0)
LENS = Lens(66.0)
LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=90)


@pytest.fixture(scope="module")
def frames():
    """Frames of a camera that looks 45 degrees ahead and turns as it goes aside, with their true headings."""
    ground = np.repeat(draw_rough_ground(1200)[..., None], 3, axis=2)
    made, rng = [], np.random.default_rng(1)
    for number in range(5):
        heading_deg, east_m, north_m = 20.0 + 6 * number, 130.0 + 4 * number, 60.0 + 6 * number
        pose = CameraPose(east_m=east_m, north_m=north_m, height_m=50, heading_deg=heading_deg, pitch_deg=45)
        image = photograph(ground, 0.25, pose, CAMERA, LIGHT, rng)
        position = Position(*offset_position(50.0, 8.0, east_m, north_m))
        frame = Frame(image=image, name=f"{number}", t_mono_s=float(number), position=position, height_m=50.0)
        made.append((replace(frame, roll_deg=0.0, pitch_deg=45.0), heading_deg))
    return made


def test_find_headings_finds_those_of_a_turning_camera(frames):
    found = [frame.heading_deg for frame in find_headings([frame for frame, _ in frames], LENS)]
    assert found == pytest.approx([heading_deg for _, heading_deg in frames], abs=3)


def test_find_headings_skips_level_frames_known_headings_and_hovers(frames):
    first = frames[0][0]
    level = [replace(frame, pitch_deg=5.0) for frame, _ in frames]
    known = [replace(frame, heading_deg=7.0) for frame, _ in frames]
    still = [replace(frame, position=first.position) for frame, _ in frames]
    for unchanged in (level, known, still, [first], []):
        before = [frame.heading_deg for frame in unchanged]
        assert [frame.heading_deg for frame in find_headings(unchanged, LENS)] == before
