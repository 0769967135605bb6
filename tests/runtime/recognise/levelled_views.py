"""Levelled pictures of generated ground, from any pose."""

import math

import numpy as np

from edgevpr.core.types import Frame
from edgevpr.frames.level import Lens, LevelledImage, level_image
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, light_scene, photograph
from edgevpr.lab.simulate.landscape import make_scene

FOOTPRINT_M = 130.0
_METRES_PER_PIXEL = 0.25
_LENS = Lens(math.degrees(2 * math.atan(Camera().width / 2 / Camera().focal_px)))
_LIGHT = Light(sun_azimuth_deg=50, sun_elevation_deg=50)


def draw_ground(east_m: float, north_m: float) -> np.ndarray:
    """Ground of this size, in the light of a day."""
    return light_scene(make_scene(5, east_m, north_m, _METRES_PER_PIXEL), _LIGHT, 5)


def take_level_view(ground: np.ndarray, pose: CameraPose, told: CameraPose | None = None, scale=1.0) -> LevelledImage:
    """The levelled picture from a pose; `told` is the pose that the autopilot reports, `scale` corrects its height."""
    image = photograph(ground, _METRES_PER_PIXEL, pose, Camera(), _LIGHT, np.random.default_rng(1))
    said = {name: getattr(told or pose, name) for name in ("heading_deg", "roll_deg", "pitch_deg", "height_m")}
    return level_image(Frame(image=image, name="", t_mono_s=0.0, **said), None, _LENS, FOOTPRINT_M, scale=scale)
