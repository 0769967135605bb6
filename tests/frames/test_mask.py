"""The overlay mask: reading it, refusing one that cannot be meant, and scaling it to a frame."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.core.errors import ImageError, SourceError, UsageError
from edgevpr.frames.images import read_image
from edgevpr.frames.mask import (
    FEWEST_FRAMES,
    learn_overlay,
    mask_of,
    read_mask,
    require_png,
    write_mask,
)
from edgevpr.techniques import create


def written(path, allowed):
    cv2.imwrite(str(path), np.asarray(allowed, np.uint8) * 255)
    return path


def half(height=120, width=160):
    allowed = np.ones((height, width), bool)
    allowed[:, : width // 2] = False
    return allowed


def test_black_is_ignored_and_white_is_used(tmp_path):
    mask = read_mask(written(tmp_path / "m.png", half()))
    assert np.array_equal(mask.allowed, half())
    assert mask_of(None) is None
    assert mask_of(str(tmp_path / "m.png")).sha256 == mask.sha256


def test_a_mask_is_known_by_its_pixels(tmp_path):
    one = read_mask(written(tmp_path / "m.png", half()))
    coloured = cv2.cvtColor(half().astype(np.uint8) * 200, cv2.COLOR_GRAY2BGR)
    cv2.imwrite(str(tmp_path / "c.bmp"), coloured)
    assert read_mask(tmp_path / "c.bmp").sha256 == one.sha256
    assert read_mask(written(tmp_path / "o.png", half()[:, ::-1])).sha256 != one.sha256
    assert read_mask(written(tmp_path / "t.png", half(160, 120))).sha256 != one.sha256


@pytest.mark.parametrize("share", [0.61, 1.0])
def test_a_mask_that_leaves_too_little_is_refused(tmp_path, share):
    allowed = np.ones((100, 100), bool)
    allowed[: int(100 * share)] = False
    with pytest.raises(UsageError, match=f"masks {share:.0%} of the frame, and 60% is the most"):
        read_mask(written(tmp_path / "m.png", allowed))
    allowed[:] = True
    allowed[:60] = False
    assert read_mask(written(tmp_path / "m.png", allowed)).allowed.mean() == 0.4


@pytest.mark.parametrize("content", [None, b"", b"mask", b"\x89PNG\r\n\x1a\ncut"])
def test_what_is_no_image_is_refused_in_one_sentence(tmp_path, content):
    path = tmp_path / "m.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageError, match=r"m\.png"):
        read_mask(path)


@pytest.mark.parametrize("camera", ["forward", "nadir"])
def test_what_lies_under_the_mask_changes_nothing(tmp_path, camera):
    technique = create("cohog", {"w1": 208, "camera": camera})
    mask = read_mask(written(tmp_path / "m.png", half()))  # of another size than the picture
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


_NOISE = np.random.default_rng(1)
GROUND = sum(cv2.resize(_NOISE.random((side, 4 * side)), (1920, 480)) for side in (20, 40, 80))
GROUND = cv2.normalize(GROUND, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
# The layout of a display: a cross, a frame, and figures that change.
CROSS = slice(95, 145), slice(135, 185)
BOX = slice(12, 68), slice(190, 310)
FIGURES = slice(195, 236), slice(12, 110)


def view(number, display=True):
    """A picture of a flight over the ground, 240 x 320."""
    picture = GROUND[37 * number % 200 :, 39 * number :][:240, :320].copy()
    if display:
        cv2.drawMarker(picture, (160, 120), 255, cv2.MARKER_CROSS, 30, 2)
        cv2.rectangle(picture, (200, 22), (300, 58), 255, 2)
        cv2.putText(picture, f"A{number:03d}", (22, 226), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 0, 5)
        cv2.putText(picture, f"A{number:03d}", (22, 226), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2)
    return picture


def test_what_stands_still_is_masked_and_the_ground_is_not():
    allowed = learn_overlay(map(view, range(40)), "here")
    for spot in (CROSS, BOX, FIGURES):
        assert (~allowed[spot]).mean() > 0.2
    assert not allowed[120, 150:170].any()
    assert not allowed[22, 205:295].any()
    rest = allowed.copy()
    for spot in (CROSS, BOX, FIGURES):
        rest[spot] = True
    assert rest.mean() > 0.99


def test_a_flight_without_a_display_needs_no_mask():
    assert learn_overlay((view(number, display=False) for number in range(40)), "here").mean() > 0.995


@pytest.mark.parametrize(("noise", "contrast"), [(0, 1.0), (3, 1.0), (0, 0.0)])
def test_a_scene_that_stands_still_teaches_nothing(noise, contrast):
    rng = np.random.default_rng(1)
    still = contrast * view(3).astype(float)
    pictures = (np.clip(still + rng.normal(0, noise, still.shape), 0, 255).astype(np.uint8) for _ in range(40))
    with pytest.raises(SourceError, match=r"stands still"):
        learn_overlay(pictures, "video.mp4")


@pytest.mark.parametrize("count", [0, 1, FEWEST_FRAMES - 1])
def test_too_few_pictures_teach_nothing(count):
    with pytest.raises(SourceError, match=f"{count} pictures"):
        learn_overlay(map(view, range(count)), "here")


def test_large_pictures_are_learnt_from_at_the_size_of_a_mask():
    large = (cv2.resize(view(number), None, fx=4, fy=4) for number in range(FEWEST_FRAMES))
    assert learn_overlay(large, "here").shape == (480, 640)


def test_a_mask_is_written_as_it_is_read(tmp_path):
    allowed = learn_overlay(map(view, range(40)), "here")
    write_mask(tmp_path / "m.png", allowed)
    assert np.array_equal(read_mask(tmp_path / "m.png").allowed, allowed)
    assert set(np.unique(read_image(tmp_path / "m.png"))) == {0, 255}
    with pytest.raises(UsageError, match=r"\.png"):
        require_png(tmp_path / "m.jpg")
