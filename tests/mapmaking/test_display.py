"""A display that is drawn over all pictures of a flight is noticed before a map is made of them."""

import cv2
import numpy as np
import pytest

from edgevpr.cli.main import main
from edgevpr.core.arrays import Image
from edgevpr.frames.mask import mask_of
from edgevpr.mapmaking.display import share_still

NOISE = cv2.GaussianBlur(np.random.default_rng(8).random((900, 1500), np.float32), (0, 0), 2)
GROUND = cv2.normalize(NOISE, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def bare(number: int) -> Image:
    return GROUND[20 * number :, 40 * number :][:240, :320].copy()


def drawn_over(number: int) -> Image:
    """A picture with a height, which changes, and a cross."""
    image = cv2.cvtColor(bare(number), cv2.COLOR_GRAY2BGR)
    cv2.drawMarker(image, (160, 120), (255, 255, 255), cv2.MARKER_CROSS, 30, 2)
    cv2.putText(image, f"ALT {100 + number}", (8, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
    return image


def test_only_what_is_drawn_stands_still():
    assert share_still(map(bare, range(20)), None) == 0
    assert 0.006 < share_still(map(drawn_over, range(20)), None) < 0.05


def test_a_mask_leaves_it_out(tmp_path):
    painted = np.full((240, 320), 255, np.uint8)
    painted[:45, :150] = painted[95:145, 135:185] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), painted)
    assert share_still(map(drawn_over, range(20)), mask_of(str(tmp_path / "mask.png"))) == 0


@pytest.mark.parametrize("numbers", [range(11), [3] * 20], ids=["few pictures", "an aircraft that stands"])
def test_what_cannot_be_told_is_not_told(numbers):
    assert share_still(map(drawn_over, numbers), None) is None


@pytest.mark.slow
@pytest.mark.parametrize("view", [bare, drawn_over])
def test_map_build_tells_what_to_do(tmp_path, caplog, view):
    for number in range(16):
        cv2.imwrite(str(tmp_path / f"{number:02d}.png"), view(number))
    flags = "--technique", "cohog", "--camera", "nadir", "--no-refine", "--no-calibrate"
    assert main(["map", "build", str(tmp_path / "m.gpkg"), "--images", str(tmp_path), *flags]) == 0
    assert ("of the picture stands still" in caplog.text) == (view is drawn_over)
    assert ("--mask PNG" in caplog.text) == (view is drawn_over)
