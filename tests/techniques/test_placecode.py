import cv2
import numpy as np
import pytest

from edgevpr.techniques import placecode
from edgevpr.techniques.gradients import normalised_blocks, oriented_cells
from edgevpr.techniques.patterns import waves

_HERE = np.zeros(1)
_CELL_PX = 512 / 12
_TURNS_DEG = np.arange(24) * 15.0


def _picture(seed: int, side_px: int = 1024) -> np.ndarray:
    """Ground of soft patches of several sizes."""
    rng = np.random.default_rng(seed)
    ground = sum(
        cv2.resize(rng.random((n, n), dtype=np.float32), (side_px, side_px), interpolation=cv2.INTER_CUBIC)
        for n in (6, 14, 40)
    )
    return cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def _blocks(image: np.ndarray) -> np.ndarray:
    return normalised_blocks(oriented_cells(np.ascontiguousarray(image), 16, 8, signed=True))


def _view(ground: np.ndarray, right_px: int = 0, down_px: int = 0, turned_deg: float = 0) -> np.ndarray:
    """512x512 of the ground, `right_px` and `down_px` from its middle, then turned counter-clockwise."""
    middle = ground.shape[0] / 2 - 0.5
    turn = cv2.getRotationMatrix2D((middle + right_px, middle + down_px), turned_deg, 1)
    turned = cv2.warpAffine(ground, turn, ground.shape[::-1])
    top, left = (int(middle + 0.5) - 256 + step for step in (down_px, right_px))
    return turned[top : top + 512, left : left + 512]


@pytest.fixture(scope="module")
def town() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Twelve grounds, the mean of their grids, and their codes."""
    grounds = [_picture(seed) for seed in range(12)]
    grids = np.stack([placecode.grid(_blocks(_view(ground))) for ground in grounds])
    mean = grids.mean(axis=0)
    return grounds, mean, placecode.pack(grids, mean)


def _ask(image: np.ndarray, mean: np.ndarray, rotations_deg: np.ndarray) -> np.ndarray:
    return placecode.hypotheses(*placecode.turned_grids(_blocks(image), rotations_deg), mean)


def _best_shift(asked: np.ndarray, code: np.ndarray) -> list[int]:
    """The shift (dx, dy) in cells under which one place agrees best with a query that is not turned."""
    return placecode.SHIFTS[np.argmax(asked[0] @ (np.unpackbits(code) * 2.0 - 1))].tolist()


def test_a_place_takes_144_bytes(town):
    assert town[2].shape == (12, 144)
    assert town[2].dtype == np.uint8


def test_the_same_picture_agrees_in_every_bit(town):
    grounds, mean, codes = town
    asked = _ask(_view(grounds[3]), mean, _HERE)
    scores = placecode.scan(asked, codes)[:, 0]
    assert scores.argmax() == 3
    assert scores[3] == pytest.approx(1)
    assert _best_shift(asked, codes[3]) == [0, 0]


@pytest.mark.parametrize(("right", "down"), [(2, 0), (0, -3), (-2, 1), (1, 3)])
def test_a_moved_camera_finds_the_place_and_how_far_it_moved(town, right, down):
    grounds, mean, codes = town
    asked = _ask(_view(grounds[5], round(_CELL_PX * right), round(_CELL_PX * down)), mean, _HERE)
    assert placecode.scan(asked, codes).argmax() == 5
    # A camera that moved right sees the place to its left: its picture moves right to lie on the place.
    assert _best_shift(asked, codes[5]) == [right, down]


@pytest.mark.parametrize("turned_deg", [30, 105, 240])
def test_a_turned_camera_finds_the_place_and_its_rotation(town, turned_deg):
    grounds, mean, codes = town
    asked = _ask(_view(grounds[7], turned_deg=turned_deg), mean, _TURNS_DEG)
    scores = placecode.scan(asked, codes)
    assert scores.max(axis=1).argmax() == 7
    assert (_TURNS_DEG[scores[7].argmax()] + turned_deg) % 360 == 0


def test_turning_the_grid_by_right_angles_is_turning_the_picture():
    image = _view(_picture(20))
    angles_deg = np.array([90.0, 180.0, 270.0])
    turned, seen = placecode.turned_grids(_blocks(image), angles_deg)
    assert seen.all()
    for quarter in range(3):
        expected = placecode.grid(_blocks(np.rot90(image, quarter + 1)))
        np.testing.assert_allclose(turned[quarter], expected, atol=0.05)


def test_corners_that_a_turned_picture_does_not_reach_are_not_seen():
    _, seen = placecode.turned_grids(_blocks(_view(_picture(21))), np.array([45.0]))
    assert not seen[0, 0, 0]
    assert not seen[0, -1, -1]
    assert seen[0, 2:-2, 2:-2].all()


def test_what_a_mask_hides_says_nothing(town):
    grounds, mean, codes = town
    image = _view(grounds[2]).copy()
    image[:, 256:] = 0  # part of the aircraft
    seen = np.zeros((31, 31), bool)
    seen[:, :15] = True
    grids, in_view = placecode.turned_grids(_blocks(image), _HERE, seen)
    asked = placecode.hypotheses(grids, in_view, mean)
    assert placecode.scan(asked, codes).argmax() == 2
    assert _best_shift(asked, codes[2]) == [0, 0]
    assert abs(asked).sum(axis=2).max() == 1152 / 2


def test_what_the_cells_around_have_in_common_is_left_out():
    rng = np.random.default_rng(3)
    grids, mean = rng.random((2, 12, 12, 8), dtype=np.float32), rng.random((12, 12, 8), dtype=np.float32)
    seen = rng.random((2, 12, 12)) > 0.2
    left = (grids - mean) @ waves(8).T
    np.testing.assert_array_equal(placecode.special(grids, mean, seen), left)
    apart = placecode.special(grids, mean, seen, locally=True)
    for n, y, x in [(0, 0, 0), (1, 3, 5), (1, 11, 11)]:
        near = [
            (v, u, np.exp(-((v - y) ** 2 + (u - x) ** 2) / 18)) for v in range(12) for u in range(12) if seen[n, v, u]
        ]
        common = sum(weight * left[n, v, u] for v, u, weight in near) / sum(weight for _, _, weight in near)
        np.testing.assert_allclose(apart[n, y, x], left[n, y, x] - common, atol=1e-5)


def test_an_even_light_from_one_side_changes_no_local_code():
    rng = np.random.default_rng(4)
    grids, light = rng.random((1, 12, 12, 8), dtype=np.float32), rng.random(8, dtype=np.float32)
    mean = np.zeros((12, 12, 8), np.float32)
    np.testing.assert_array_equal(
        placecode.pack(grids, mean, locally=True), placecode.pack(grids + light, mean, locally=True)
    )


def test_the_scan_is_the_product_spelt_out(town):
    _, mean, _ = town
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 256, (600, 144), dtype=np.uint8)  # a whole block of places and a part
    asked = _ask(_view(_picture(22)), mean, np.array([0.0, 120.0]))
    signs = np.unpackbits(codes, axis=1) * 2.0 - 1
    expected = np.stack([(signs @ asked[turn].T).max(axis=1) / 1152 for turn in range(2)], axis=1)
    np.testing.assert_allclose(placecode.scan(asked, codes), expected, atol=1e-6)


def test_a_known_heading_is_the_full_scan_of_three_rotations(town):
    _, mean, _ = town
    rng = np.random.default_rng(2)
    codes = rng.integers(0, 256, (700, 144), dtype=np.uint8)
    expected = rng.integers(-1, 24, 700)
    expected[:24] = np.arange(24)  # every rotation, and the first and the last that are neighbours
    asked = _ask(_view(_picture(23)), mean, _TURNS_DEG)
    full, near = placecode.scan(asked, codes), placecode.scan_near(asked, codes, expected)
    apart = abs((np.arange(24) - expected[:, None] + 12) % 24 - 12)
    scanned = (apart <= 1) | (expected[:, None] < 0)
    np.testing.assert_array_equal(near[scanned], full[scanned])
    assert np.isneginf(near[~scanned]).all()
    assert (scanned.sum(axis=1) == np.where(expected < 0, 24, 3)).all()


@pytest.mark.parametrize(("right", "down"), [(0, 0), (1, 0), (1, 1), (-3, 2), (-1, -3)])
def test_of_many_places_the_best_are_looked_at_under_every_shift(town, right, down):
    grounds, mean, codes = town
    many = np.concatenate([np.random.default_rng(3).integers(0, 256, (5000, 144), dtype=np.uint8), codes])
    asked = _ask(_view(grounds[5], round(_CELL_PX * right), round(_CELL_PX * down)), mean, _HERE)
    full, ahead = placecode.scan(asked, many), placecode.scan_ahead(asked, many)
    assert ahead.shape == full.shape
    assert ahead.argmax() == full.argmax() == 5005
    looked_closer = np.argsort(-ahead[:, 0])[:100]
    np.testing.assert_array_equal(ahead[looked_closer], full[looked_closer])
    assert (ahead <= full + 1e-6).all()
    assert (ahead < full).mean() > 0.5  # the rest were not
    np.testing.assert_array_equal(placecode.scan_ahead(asked, codes), placecode.scan(asked, codes))


def test_every_shift_leaves_at_least_the_least_overlap():
    overlap = np.prod(12 - abs(placecode.SHIFTS.astype(int)), axis=1) / 144
    assert overlap.min() >= 0.5
    assert len(np.unique(placecode.SHIFTS, axis=0)) == len(placecode.SHIFTS)
    assert [0, 0] in placecode.SHIFTS.tolist()


def test_an_even_picture_is_compared_without_a_warning(town):
    _, mean, codes = town
    asked = _ask(np.full((512, 512), 90, np.uint8), mean, _TURNS_DEG)
    assert np.isfinite(placecode.scan(asked, codes)).all()
