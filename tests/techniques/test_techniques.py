"""What every technique promises, and how it is chosen by name."""

import numpy as np
import pytest
from pictures import draw_texture

from edgevpr.core.errors import UsageError
from edgevpr.techniques import create, list_techniques


@pytest.mark.parametrize("name", list_techniques())
def test_score_places_is_highest_for_the_same_image(name):
    technique = create(name)
    descriptors = [technique.encode(draw_texture(seed)) for seed in range(4)]
    coarse = np.stack([d.coarse for d in descriptors])
    mean = coarse.astype(np.float32).mean(axis=0)
    rows = technique.pack(coarse, mean) if technique.spec.packed else coarse
    assert rows.shape[1:] == technique.spec.row.shape
    for at, query in enumerate(descriptors):
        scores, _ = technique.score_places(query, rows, mean)
        assert scores.argmax() == at
        assert (scores >= 0).all()
        assert (scores <= 1).all()
        if technique.spec.fine is not None:
            fine = [technique.match(query, other.fine).score for other in descriptors]
            assert int(np.argmax(fine)) == at
            assert 0 <= min(fine) <= max(fine) <= 1


def test_match_scores_zero_for_a_blank_image():
    technique = create("cohog")
    grey_wall = technique.encode(np.full((120, 160), 128, np.uint8))
    assert grey_wall.quality == 0
    assert technique.match(grey_wall, technique.encode(draw_texture(1)).fine).score == 0


@pytest.mark.parametrize(
    ("name", "parameters"), [*((name, {}) for name in list_techniques()), ("cohog", {"camera": "nadir"})]
)
def test_encode_leaves_out_masked_pixels(name, parameters):
    technique, image = create(name, parameters), draw_texture(5)
    mask = np.ones(image.shape, bool)
    mask[70:] = False
    changed = np.where(np.arange(120)[:, None] < 90, image, draw_texture(6))  # a pixel counts for those around it
    seen, painted = (technique.encode(each, mask) for each in (image, changed))
    assert seen.coarse.tobytes() == painted.coarse.tobytes() != technique.encode(image).coarse.tobytes()
    assert np.array_equal(seen.fine, painted.fine)
    if name == "cohog":
        side = int(len(seen.good) ** 0.5)
        assert seen.good.any()
        assert not seen.good.reshape(side, side)[side * 70 // 120 :].any()


@pytest.mark.parametrize(
    ("name", "parameters", "says"),
    [
        ("cohg", {}, "`cohg`"),
        ("cohog", {"gtt": 1}, "did you mean `gt`"),
        ("cohog", {"gt": "much"}, "must be a number"),
        ("cohog", {"gt": 7}, "largest entropy"),
        ("cohog", {"w2": 100}, "multiple of w2"),
        ("cohog", {"entropy": "renyi"}, "filled_bins or shannon"),
        ("cohog", {"matching": "magic"}, "displacement or thesis"),
        ("cohog", {"camera": "sideways"}, "forward or nadir"),
        ("cohog", {"camera": "nadir", "bins": 12}, "uses 8 bins"),
        ("hog", {"cell": 0}, "multiple of cell"),
    ],
)
def test_create_explains_wrong_names_and_parameters(name, parameters, says):
    with pytest.raises(UsageError, match=says):
        create(name, parameters)
