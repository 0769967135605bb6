import numpy as np
import pytest
from pictures_on_disk import write_pictures

from edgevpr.core.errors import ImageError
from edgevpr.frames.images import cv2
from edgevpr.lab.training.pictures import (
    TARGET_LENGTH,
    batch,
    read_pictures,
    small_grey,
    two_sights,
)


@pytest.fixture
def picture():
    coarse = np.random.default_rng(3).integers(0, 256, (12, 16), np.uint8)
    return cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC)


def test_a_batch_has_the_form_the_network_takes(picture):
    inputs, targets = batch([picture], 3, np.random.default_rng(1))
    assert inputs.shape == (3, 1, 120, 160)
    assert targets.shape == (3, TARGET_LENGTH)
    assert inputs.dtype == targets.dtype == np.float32
    assert inputs.min() >= 0
    assert inputs.max() == 1  # equalised: the brightest pixel is white
    assert targets.min() >= 0
    assert targets.max() <= 1


def test_both_sights_show_the_same_ground(picture):
    """The changed sight correlates with its own original, and much less with others."""
    rng = np.random.default_rng(5)
    pairs = [two_sights(picture, rng) for _ in range(24)]
    flat = [np.stack([cv2.equalizeHist(sight).ravel() for sight in sights]) for sights in zip(*pairs, strict=True)]
    correlation = np.corrcoef(*flat)[:24, 24:]
    own = np.diag(correlation)
    assert own.mean() > np.median(correlation) + 0.3
    assert (own < 0.9999).all()  # and is changed


def test_what_cannot_be_read_is_left_out_and_said(tmp_path, capsys):
    folder = write_pictures(tmp_path / "a", 3)
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing")
    unusable: list[ImageError] = []
    pictures = list(read_pictures([folder], "reading", unusable))
    assert len(pictures) == 3
    assert len(unusable) == 1
    assert "broken.jpg" in capsys.readouterr().err


def test_pictures_are_made_small_enough_to_keep(tmp_path):
    folder = tmp_path / "large"
    folder.mkdir()
    cv2.imwrite(str(folder / "1.png"), np.zeros((900, 1600, 3), np.uint8))
    (read,) = read_pictures([folder], "reading")
    assert read.shape == (360, 640, 3)
    assert small_grey(read).shape == (180, 320)
