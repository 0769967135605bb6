"""Changed pictures: other enough to be hard, and with the part that shows ground where it has gone."""

import numpy as np
import pytest
from pictures import textured

from edgevpr.mapmaking.changes import changed


@pytest.mark.parametrize("shape", [(120, 160), (160, 120), (120, 160, 3)])
@pytest.mark.parametrize("looks_down", [True, False])
def test_a_changed_picture_has_the_form_of_one(shape, looks_down):
    image = np.broadcast_to(textured(1, *shape[:2]).reshape(*shape[:2], *[1] * (len(shape) - 2)), shape).copy()
    seen, shown = changed(image, np.random.default_rng(3), looks_down)
    assert (seen.shape, seen.dtype, shown) == (shape[:2], np.uint8, None)
    assert seen.std() > 5


def test_the_same_seed_gives_the_same_picture_and_the_next_another():
    image, rng = textured(2), np.random.default_rng(5)
    first, second = (changed(image, rng, True)[0] for _ in range(2))
    assert np.array_equal(changed(image, np.random.default_rng(5), True)[0], first)
    assert (first != second).mean() > 0.5


def test_the_part_that_shows_ground_moves_with_the_picture():
    image = textured(4)
    shown = np.zeros(image.shape, bool)
    shown[:, 80:] = True
    image = np.where(shown, 40 + image // 4, 190 + image // 4)

    def apart(picture, part):
        return abs(float(picture[part].mean()) - float(picture[~part].mean()))

    followed, left = [], []
    for seed in range(12):
        seen, now = changed(image, np.random.default_rng(seed), True, shown)
        assert (now.shape, now.dtype) == (image.shape, bool)
        followed.append(apart(seen, now))
        left.append(apart(seen, shown))
    assert np.mean(followed) > 1.5 * np.mean(left)
