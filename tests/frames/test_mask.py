"""The overlay mask: reading it, refusing one that cannot be meant, and scaling it to a frame."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.frames.mask import load_mask
from edgevpr.techniques import create


def written(path, allowed):
    cv2.imwrite(str(path), np.asarray(allowed, np.uint8) * 255)
    return path


def masked(share, height=120, width=160):
    """A mask of which the left is black."""
    allowed = np.ones((height, width), bool)
    allowed[:, : round(width * share)] = False
    return allowed


def test_mask_is_known_by_its_pixels(tmp_path):
    one = load_mask(written(tmp_path / "m.png", masked(0.5)))
    assert np.array_equal(one.allowed, masked(0.5))
    cv2.imwrite(str(tmp_path / "c.bmp"), cv2.cvtColor(masked(0.5).astype(np.uint8) * 200, cv2.COLOR_GRAY2BGR))
    assert load_mask(tmp_path / "c.bmp").sha256 == one.sha256
    assert load_mask(written(tmp_path / "o.png", masked(0.5)[:, ::-1])).sha256 != one.sha256
    assert load_mask(written(tmp_path / "t.png", masked(0.5, 160, 120))).sha256 != one.sha256
    assert load_mask(None) is None


@pytest.mark.parametrize("share", [0.61, 1.0])
def test_mask_that_leaves_too_little_is_refused(tmp_path, share):
    with pytest.raises(UsageError, match=f"masks {share:.0%} of the frame, and 60% is the most"):
        load_mask(written(tmp_path / "m.png", masked(share, 100, 100)))
    assert load_mask(written(tmp_path / "m.png", masked(0.6, 100, 100))).allowed.mean() == 0.4


def test_mask_that_is_no_image_is_refused(tmp_path):
    (tmp_path / "m.png").write_bytes(b"\x89PNG\r\n\x1a\ncut")
    for path in (tmp_path / "m.png", tmp_path / "missing.png"):
        with pytest.raises(ImageError, match=rf"source\.mask.*{path.name}"):
            load_mask(path)


@pytest.mark.parametrize("camera", ["forward", "nadir"])
def test_what_lies_under_the_mask_changes_nothing(tmp_path, camera):
    technique = create("cohog", {"w1": 208, "camera": camera})
    mask = load_mask(written(tmp_path / "m.png", masked(0.5)))  # of another size than the picture
    picture = textured(1, 240, 320)
    covered = picture.copy()
    covered[:, :150] = np.random.default_rng(1).integers(0, picture.max(), (240, 150))  # ends before the mask
    one, other = (technique.encode(image, mask.fitted(image)) for image in (picture, covered))
    assert one.good.any()
    assert not one.good.all()
    assert np.array_equal(one.good, other.good)
    assert np.array_equal(one.fine, other.fine)
    assert not np.array_equal(one.fine, technique.encode(picture).fine)
