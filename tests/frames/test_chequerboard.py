"""Calibration by a chequerboard: lenses that are known come out of rendered pictures of the board."""

import numpy as np
import pytest
from distorted_cameras import SIZE_PX, fisheye, wide

from edgevpr.core.errors import EdgevprError, ImageError
from edgevpr.core.types import Frame
from edgevpr.frames.chequerboard import MIN_VIEWS, BoardViews, calibrate, write_lens
from edgevpr.frames.lens import read_lens

BOARD = 9, 6


def views_in(images, board=BOARD):
    views = BoardViews(board)
    for number, image in enumerate(images):
        views.add(Frame(image=image, name=f"{number}.png", t_mono_s=0.0))
    return views


def off_px(lens, camera):
    """How far the lens is off in pixels, at most, over what nine tenths of the camera's picture show."""
    height, width = camera.rays.shape[:2]
    rows, columns = np.mgrid[height // 20 : height * 19 // 20 : 8, width // 20 : width * 19 // 20 : 8]
    found = lens.projected(camera.rays[rows, columns].reshape(-1, 2))
    return np.linalg.norm(found - np.column_stack([columns.ravel(), rows.ravel()]), axis=1).max()


@pytest.mark.slow
@pytest.mark.parametrize("camera", [wide(), fisheye()], ids=["wide", "fisheye"])
def test_calibrate_finds_a_lens_that_is_known(camera, tmp_path):
    found = calibrate(views_in(camera.photographs_of_board(30)), str(tmp_path / "lens.yaml"), camera.fisheye)
    assert found.lens.focal_px == pytest.approx([camera.matrix[0, 0]] * 2, rel=0.002)
    assert off_px(found.lens, camera) < 1.0
    assert found.error_px < 0.3
    write_lens(found)
    assert read_lens(found.lens.path) == found.lens


@pytest.fixture(scope="module")
def images():
    """Pictures of the board in the right half of the picture, all from straight before it."""
    places = [(x, y, away) for away in (9.0, 13.0) for x in (0.2, 0.35) for y in (-0.25, 0.0, 0.25)]
    return [wide().photograph_board((0, 0, 0.1), (x * away, y * away, away)) for x, y, away in places]


@pytest.mark.slow
def test_calibrate_names_the_cells_without_a_corner(images):
    views = views_in(images)
    assert not views.are_enough()
    found = calibrate(views, "lens.yaml", False)
    assert (found.corners[3], sum(found.corners)) == (0, 54 * len(views.found))
    assert any("the left" in sentence for sentence in found.advice)


def test_views_that_do_not_differ_are_one_and_too_few_are_refused(images):
    views = views_in(images[:1] * 3 + [images[0][::-1, ::-1].copy()] + images[1:2])
    assert 0 < len(views.found) < MIN_VIEWS
    with pytest.raises(EdgevprError, match=f"{len(views.found)} views that differ, and 8 are needed"):
        calibrate(views, "lens.yaml", False)
    with pytest.raises(ImageError, match="640x240"):
        views.add(Frame(image=images[1][:240], name="small.png", t_mono_s=0.0))
    assert (views.pictures, views.size_px) == (5, SIZE_PX)


@pytest.mark.parametrize("board", [(8, 7), BOARD])
def test_another_board_or_none_is_refused(images, board):
    shown = images[:2] if board != BOARD else [np.full(SIZE_PX[::-1], 90, np.uint8)]
    with pytest.raises(EdgevprError, match=r"No board with \dx\d inner corners .*10x7 squares have 9x6"):
        calibrate(views_in(shown, board), "lens.yaml", False)
