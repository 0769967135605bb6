"""Ground in little light or in fog is stretched until it says something; ordinary pictures and noise are not."""

import numpy as np
import pytest
from pictures import draw_texture

from edgevpr.techniques import create
from edgevpr.techniques.contrast import stretch_contrast
from edgevpr.techniques.gradients import make_grey_square

CAMERAS = ("forward", "nadir")
WORSE = {"dark": lambda picture: 0.15 * picture, "fog": lambda picture: 0.15 * picture + 170}
DOUBLED = (100, 200, 0.3)
PIXEL_PX = (512 / 640, 512 / 480)


def add_noise(picture, sigma, seed=1):
    """What a sensor makes of it: uint8."""
    noise = sigma * np.random.default_rng(seed).normal(size=np.shape(picture))
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def ramp(low, high):
    """A square picture of all grey levels between two, float32 (512, 512)."""
    return np.tile(np.linspace(low, high, 512, dtype=np.float32), (512, 1))


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("worse", WORSE)
def test_ground_in_little_light_and_in_fog_is_found(camera, worse):
    technique = create("cohog", {"camera": camera})
    places = [technique.encode(draw_texture(seed, 480, 640)).fine for seed in range(3)]
    query = technique.encode(add_noise(WORSE[worse](draw_texture(1, 480, 640)), 1.5))
    scores = [technique.match(query, place).score for place in places]
    assert query.quality >= 0.8
    assert scores[1] > max(technique.min_score, 2 * scores[0], 2 * scores[2])


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("size", [(480, 640), (120, 160)])
@pytest.mark.parametrize("level", [0, 10, 170])
def test_stretch_contrast_does_not_turn_sensor_noise_into_ground(camera, size, level):
    technique = create("cohog", {"camera": camera})
    for sigma in (0, 1, 3):
        assert technique.encode(add_noise(np.full(size, level), sigma)).quality < technique.min_quality


def test_stretch_contrast_stretches_low_contrast_more_and_continuously():
    plenty = ramp(50, 160)
    assert stretch_contrast(plenty, None, PIXEL_PX, *DOUBLED) is plenty
    inner = slice(8, -8)  # the ends of the range may be cut off
    nearly = ramp(50, 50 + 101)
    assert abs(stretch_contrast(nearly, None, PIXEL_PX, *DOUBLED) - nearly)[:, inner].max() < 3
    ramps = (ramp(20, 20 + levels) for levels in (95, 90, 80, 70, 15))
    ranges = [np.ptp(stretch_contrast(each, None, PIXEL_PX, *DOUBLED)) for each in ramps]
    assert ranges[:4] == sorted(ranges[:4])
    assert ranges[-1] == pytest.approx(200, abs=8), "never to more than what is wanted"


def test_make_grey_square_ignores_masked_pixels():
    dim = make_grey_square(add_noise(0.15 * draw_texture(1, 480, 640), 1), 512)
    allowed = np.ones((512, 512), bool)
    allowed[200:300, 100:400] = False
    changed = np.where(allowed, dim, np.float32(255))
    found, other = (stretch_contrast(each, allowed, PIXEL_PX, *DOUBLED) for each in (dim, changed))
    assert found is not dim
    np.testing.assert_array_equal(found[allowed], other[allowed])
    assert not np.array_equal(stretch_contrast(changed, None, PIXEL_PX, *DOUBLED)[allowed], found[allowed])
