"""The overlay mask: reading it, refusing one that cannot be meant, and scaling it to a frame."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.frames.mask import mask_of
from edgevpr.techniques import create


def written(path, allowed):
    cv2.imwrite(str(path), np.asarray(allowed, np.uint8) * 255)
    return path


def half(height=120, width=160):
    allowed = np.ones((height, width), bool)
    allowed[:, : width // 2] = False
    return allowed


def test_black_is_ignored_and_white_is_used(tmp_path):
    assert np.array_equal(mask_of(written(tmp_path / "m.png", half())).allowed, half())
    assert mask_of(None) is None


def test_a_mask_is_known_by_its_pixels(tmp_path):
    one = mask_of(written(tmp_path / "m.png", half()))
    coloured = cv2.cvtColor(half().astype(np.uint8) * 200, cv2.COLOR_GRAY2BGR)
    cv2.imwrite(str(tmp_path / "c.bmp"), coloured)
    assert mask_of(tmp_path / "c.bmp").sha256 == one.sha256
    assert mask_of(written(tmp_path / "o.png", half()[:, ::-1])).sha256 != one.sha256
    assert mask_of(written(tmp_path / "t.png", half(160, 120))).sha256 != one.sha256


@pytest.mark.parametrize("share", [0.61, 1.0])
def test_a_mask_that_leaves_too_little_is_refused(tmp_path, share):
    allowed = np.ones((100, 100), bool)
    allowed[: int(100 * share)] = False
    with pytest.raises(UsageError, match=f"masks {share:.0%} of the frame, and 60% is the most"):
        mask_of(written(tmp_path / "m.png", allowed))
    allowed[:] = True
    allowed[:60] = False
    assert mask_of(written(tmp_path / "m.png", allowed)).allowed.mean() == 0.4


@pytest.mark.parametrize("content", [None, b"", b"mask", b"\x89PNG\r\n\x1a\ncut"])
def test_what_is_no_image_is_refused_in_one_sentence(tmp_path, content):
    path = tmp_path / "m.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageError, match=r"m\.png"):
        mask_of(path)


@pytest.mark.parametrize("camera", ["forward", "nadir"])
def test_what_lies_under_the_mask_changes_nothing(tmp_path, camera):
    technique = create("cohog", {"w1": 208, "camera": camera})
    mask = mask_of(written(tmp_path / "m.png", half()))  # of another size than the picture
    picture = textured(1, 240, 320)
    covered = picture.copy()
    covered[:, :150] = np.random.default_rng(1).integers(0, picture.max(), (240, 150))  # ends before the mask
    one, other = (technique.encode(image, mask.fitted(image)) for image in (picture, covered))
    assert not one.good.all()
    assert one.good.any()
    assert np.array_equal(one.good, other.good)
    assert np.array_equal(one.fine, other.fine)
    without = technique.encode(picture)
    assert not np.array_equal(one.fine, without.fine)
