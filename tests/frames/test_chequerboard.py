"""Calibration by a chequerboard: lenses that are known come out of rendered pictures of the board."""

import numpy as np
import pytest
from distorted_cameras import SIZE_PX, fisheye, wide

from edgevpr.core.errors import EdgevprError, ImageError
from edgevpr.core.types import Frame
from edgevpr.frames.chequerboard import LEAST_VIEWS, BoardViews, calibrated, write_lens
from edgevpr.frames.lens import read_lens

BOARD = 9, 6


def looked(images, board=BOARD):
    views = BoardViews(board)
    for number, image in enumerate(images):
        views.look(Frame(image=image, name=f"{number}.png", t_mono_s=0.0))
    return views


def off_px(lens, camera):
    """How far the lens is off in pixels, at most, over what nine tenths of the camera's picture show."""
    height, width = camera.rays.shape[:2]
    rows, columns = np.mgrid[height // 20 : height * 19 // 20 : 8, width // 20 : width * 19 // 20 : 8]
    found = lens.projected(camera.rays[rows, columns].reshape(-1, 2))
    return np.linalg.norm(found - np.column_stack([columns.ravel(), rows.ravel()]), axis=1).max()


@pytest.mark.slow
@pytest.mark.parametrize("camera", [wide(), fisheye()], ids=["wide", "fisheye"])
def test_a_lens_that_is_known_comes_out(camera, tmp_path):
    views = looked(camera.photographs_of_board(30))
    found = calibrated(views, str(tmp_path / "lens.yaml"), camera.fisheye)
    assert found.lens.focal_px == pytest.approx([camera.matrix[0, 0]] * 2, rel=0.002)
    assert off_px(found.lens, camera) < 1.0
    assert found.error_px < 0.3
    assert sum(found.corners) == 54 * len(views.found)
    write_lens(found)
    assert read_lens(found.lens.path) == found.lens


@pytest.fixture(scope="module")
def images():
    """Pictures of the board in the right half of the picture, all from straight before it."""
    places = [(x, y, away) for away in (9.0, 13.0) for x in (0.2, 0.35) for y in (-0.25, 0.0, 0.25)]
    return [wide().photograph_board((0, 0, 0.1), (x * away, y * away, away)) for x, y, away in places]


@pytest.mark.slow
def test_what_would_make_it_better_is_said(images):
    views = looked(images)
    assert "left" in views.empty_cells()
    assert not views.are_enough()
    advice = " ".join(calibrated(views, "lens.yaml", False).advice)
    assert "the left" in advice
    assert "tilt the board" in advice


def test_views_that_do_not_differ_are_one_and_too_few_are_refused(images):
    views = looked(images[:1] * 3 + [images[0][::-1, ::-1].copy()] + images[1:2])
    assert 0 < len(views.found) < LEAST_VIEWS
    with pytest.raises(EdgevprError, match=f"{len(views.found)} views that differ, and 8 are needed"):
        calibrated(views, "lens.yaml", False)


@pytest.mark.parametrize("board", [(8, 7), BOARD])
def test_another_board_or_none_is_said(images, board):
    shown = images[:2] if board != BOARD else [np.full(SIZE_PX[::-1], 90, np.uint8)]
    with pytest.raises(EdgevprError, match=r"No board with \dx\d inner corners .*10x7 squares have 9x6"):
        calibrated(looked(shown, board), "lens.yaml", False)


def test_pictures_of_another_size_are_left_out(images):
    views = looked(images[:1])
    with pytest.raises(ImageError, match="640x240"):
        views.look(Frame(image=images[1][:240], name="small.png", t_mono_s=0.0))
    assert (views.pictures, views.size_px) == (1, SIZE_PX)
