"""The overlay mask: reading it, refusing one that cannot be meant, and scaling it to a frame."""

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.frames.mask import load_mask


def write_mask(path, allowed):
    cv2.imwrite(str(path), np.asarray(allowed, np.uint8) * 255)
    return path


def make_mask(share, height=120, width=160):
    """A mask of which the left is black."""
    allowed = np.ones((height, width), bool)
    allowed[:, : round(width * share)] = False
    return allowed


def test_mask_is_known_by_its_pixels(tmp_path):
    one = load_mask(write_mask(tmp_path / "m.png", make_mask(0.5)))
    assert np.array_equal(one.allowed, make_mask(0.5))
    cv2.imwrite(str(tmp_path / "c.bmp"), cv2.cvtColor(make_mask(0.5).astype(np.uint8) * 200, cv2.COLOR_GRAY2BGR))
    assert load_mask(tmp_path / "c.bmp").sha256 == one.sha256
    assert load_mask(write_mask(tmp_path / "o.png", make_mask(0.5)[:, ::-1])).sha256 != one.sha256
    assert load_mask(write_mask(tmp_path / "t.png", make_mask(0.5, 160, 120))).sha256 != one.sha256
    assert load_mask(None) is None


@pytest.mark.parametrize("share", [0.61, 1.0])
def test_load_mask_refuses_a_mask_that_covers_too_much(tmp_path, share):
    with pytest.raises(UsageError, match=f" {share:.0%} .* 60% "):
        load_mask(write_mask(tmp_path / "m.png", make_mask(share, 100, 100)))
    assert load_mask(write_mask(tmp_path / "m.png", make_mask(0.6, 100, 100))).allowed.mean() == 0.4


def test_load_mask_refuses_a_file_that_is_not_an_image(tmp_path):
    (tmp_path / "m.png").write_bytes(b"\x89PNG\r\n\x1a\ncut")
    for path in (tmp_path / "m.png", tmp_path / "missing.png"):
        with pytest.raises(ImageError, match=rf"source\.mask.*{path.name}"):
            load_mask(path)


def test_mask_is_fitted_to_a_picture_of_another_size(tmp_path):
    fitted = load_mask(write_mask(tmp_path / "m.png", make_mask(0.5))).fit_to(np.zeros((240, 320), np.uint8))
    assert np.array_equal(fitted, make_mask(0.5, 240, 320))
