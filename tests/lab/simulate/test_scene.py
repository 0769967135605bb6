"""The generated landscape: repeatable, and lit from where the sun is."""

import numpy as np
import pytest

from edgevpr.lab.simulate.camera import Light, lit
from edgevpr.lab.simulate.landscape import Scene, make_scene

NOON = Light(sun_azimuth_deg=180, sun_elevation_deg=60)


def plain(width_m: float = 60, metres_per_pixel: float = 0.5) -> Scene:
    side = round(width_m / metres_per_pixel)
    return Scene(np.full((side, side, 3), 120, np.uint8), np.full((side, side), 300, np.uint16), metres_per_pixel)


def test_the_same_seed_gives_the_same_scene_and_another_seed_another_one():
    one, again, other = (make_scene(seed, 160, 120, metres_per_pixel=0.5) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.albedo, again.albedo)
    np.testing.assert_array_equal(one.height_cm, again.height_cm)
    assert np.mean(one.albedo != other.albedo) > 0.5
    assert (one.width_m, one.depth_m) == (160, 120)


def test_a_scene_has_texture_everywhere_and_things_that_stand_on_it():
    scene = make_scene(3, 240, 180, metres_per_pixel=0.4)
    grey = scene.albedo.mean(axis=2)
    blocks = grey[: 440 // 40 * 40, : 600 // 40 * 40].reshape(11, 40, 15, 40)
    assert blocks.std(axis=(1, 3)).min() > 2, "no patch of 16 m is of one colour"
    assert scene.height_cm.max() > 800, "trees"
    assert scene.height_cm.min() < 200, "a river bed"


@pytest.mark.parametrize(
    ("sun_azimuth_deg", "shaded", "sunny"),
    [
        (90, (60, 50), (60, 70)),  # sun in the east: the shadow lies west, at a lower column
        (270, (60, 70), (60, 50)),
        (0, (70, 60), (50, 60)),  # sun in the north: the shadow lies south, at a higher row
        (180, (50, 60), (70, 60)),
    ],
)
def test_a_mast_casts_its_shadow_away_from_the_sun(sun_azimuth_deg, shaded, sunny):
    scene = plain()
    scene.height_cm[59:62, 59:62] += 1000
    ground = lit(scene, Light(sun_azimuth_deg=sun_azimuth_deg, sun_elevation_deg=45), seed=0)
    assert ground[shaded].max() < 0.6 * ground[sunny].max()


def test_a_shadow_is_as_long_as_the_sun_is_low():
    scene = plain()
    scene.height_cm[59:62, 59:62] += 1000
    dark = lit(scene, Light(sun_azimuth_deg=90, sun_elevation_deg=45), seed=0)[60, :59, 0] < 70
    assert np.count_nonzero(dark) * scene.metres_per_pixel == pytest.approx(10, abs=1)


def test_flat_ground_in_full_sun_is_evenly_lit_and_clouds_take_their_share():
    clear = lit(plain(), NOON, seed=1)
    assert np.ptp(clear.reshape(-1, 3), axis=0).max() == 0
    cloudy = lit(plain(), Light(sun_azimuth_deg=180, sun_elevation_deg=60, cloud_frac=0.4), seed=1)
    assert np.mean(cloudy[..., 1] < 0.85 * clear[0, 0, 1]) == pytest.approx(0.4, abs=0.15)
