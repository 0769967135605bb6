"""What every technique promises, and how it is chosen by name."""

import numpy as np
import pytest
from pictures import textured

from edgevpr.core.errors import UsageError
from edgevpr.techniques import create, names


@pytest.mark.parametrize("name", names())
def test_an_image_is_most_like_itself(name):
    technique = create(name)
    descriptors = [technique.encode(textured(seed)) for seed in range(4)]
    coarse = np.stack([d.coarse for d in descriptors])
    mean = coarse.astype(np.float32).mean(axis=0)
    rows = technique.pack(coarse, mean) if technique.spec.packed else coarse
    assert rows.shape[1:] == technique.spec.row.shape
    for at, query in enumerate(descriptors):
        scores, _ = technique.coarse_scores(query, rows, mean)
        assert scores.argmax() == at
        assert (scores >= 0).all()
        assert (scores <= 1).all()
        if technique.spec.fine is not None:
            fine = [technique.match(query, other.fine).score for other in descriptors]
            assert int(np.argmax(fine)) == at
            assert 0 <= min(fine) <= max(fine) <= 1


def test_a_picture_that_says_nothing_scores_nothing():
    technique = create("cohog")
    grey_wall = technique.encode(np.full((120, 160), 128, np.uint8))
    assert grey_wall.quality == 0
    assert technique.match(grey_wall, technique.encode(textured(1)).fine).score == 0


def test_masked_pixels_do_not_speak():
    technique = create("cohog")
    image = textured(3)
    mask = np.ones(image.shape, bool)
    mask[:, 80:] = False
    seen = technique.encode(image, mask)
    side = int(len(seen.good) ** 0.5)
    assert not seen.good.reshape(side, side)[:, side // 2 :].any()
    assert seen.good.any()
    changed = image.copy()
    changed[:, 100:] = 255 - changed[:, 100:]
    np.testing.assert_allclose(technique.encode(changed, mask).regions, seen.regions, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "parameters", "says"),
    [
        ("cohg", {}, "There is no technique `cohg`"),
        ("cohog", {"gtt": 1}, "did you mean `gt`"),
        ("cohog", {"gt": "much"}, "must be a number"),
        ("cohog", {"gt": 7}, "share of the largest entropy"),
        ("cohog", {"w2": 100}, "multiple of w2"),
        ("cohog", {"entropy": "renyi"}, "filled_bins or shannon"),
        ("cohog", {"matching": "magic"}, "displacement or thesis"),
        ("cohog", {"camera": "sideways"}, "forward or nadir"),
        ("cohog", {"camera": "nadir", "bins": 12}, "uses 8 bins"),
        ("hog", {"cell": 0}, "multiple of cell"),
    ],
)
def test_wrong_names_and_parameters_are_explained(name, parameters, says):
    with pytest.raises(UsageError, match=says):
        create(name, parameters)


def test_parameters_are_read_from_text():
    assert create("cohog", {"w1": "256", "gt": "0.45"}).spec.parameters["w1"] == 256
