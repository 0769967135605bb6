import numpy as np
import pytest
from pictures import draw_texture, render_view

from edgevpr.techniques import placecode
from edgevpr.techniques.gradients import compute_histograms, normalise_blocks

_CELL_PX = 512 / 12
ALL = np.ones((31, 31), bool)


def _blocks(image: np.ndarray) -> np.ndarray:
    return normalise_blocks(compute_histograms(np.ascontiguousarray(image), 16, 8, signed=True))


@pytest.fixture(scope="module")
def town() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Twelve grounds, the mean of their grids, and their codes."""
    grounds = [draw_texture(seed, 1024, 1024) for seed in range(12)]
    grids = np.stack([placecode.make_grid(_blocks(render_view(ground, 512)), ALL, ALL)[0] for ground in grounds])
    mean = grids.mean(axis=0)
    return grounds, mean, placecode.pack_grids(grids, mean)


def _encode(image: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return placecode.make_hypotheses(*placecode.make_grid(_blocks(image), ALL, ALL), mean)


def _best_shift(asked: np.ndarray, code: np.ndarray) -> list[int]:
    """The shift (dx, dy) in cells under which one place agrees best with a query."""
    return placecode.SHIFTS[np.argmax(asked @ (np.unpackbits(code) * 2.0 - 1))].tolist()


@pytest.mark.parametrize(("right", "down"), [(0, 0), (2, 0), (0, -3), (-2, 1), (1, 3)])
def test_scan_codes_finds_the_place_of_a_moved_camera_and_how_far_it_moved(town, right, down):
    grounds, mean, codes = town
    asked = _encode(render_view(grounds[5], 512, 0.0, round(_CELL_PX * right), round(_CELL_PX * down)), mean)
    assert placecode.scan_codes(asked, codes).argmax() == 5
    # A camera that moved right sees the place to its left: its picture moves right to lie on the place.
    assert _best_shift(asked, codes[5]) == [right, down]


def test_make_grid_ignores_masked_blocks(town):
    grounds, mean, codes = town
    image = render_view(grounds[2], 512)
    image[:, 256:] = 0  # part of the aircraft
    seen = np.zeros((31, 31), bool)
    seen[:, :15] = True
    grid, in_view = placecode.make_grid(_blocks(image), ALL, seen)
    asked = placecode.make_hypotheses(grid, in_view, mean)
    assert placecode.scan_codes(asked, codes).argmax() == 2
    assert _best_shift(asked, codes[2]) == [0, 0]
    assert abs(asked).sum(axis=1).max() == 1152 / 2


def test_scan_codes_equals_the_literal_product(town):
    _, mean, _ = town
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 256, (600, 144), dtype=np.uint8)  # a whole block of places and a part
    asked = _encode(render_view(draw_texture(22, 1024, 1024), 512), mean)
    signs = np.unpackbits(codes, axis=1) * 2.0 - 1
    np.testing.assert_allclose(placecode.scan_codes(asked, codes), (signs @ asked.T).max(axis=1) / 1152, atol=1e-6)


@pytest.mark.parametrize(("right", "down"), [(0, 0), (1, 0), (1, 1), (-3, 2), (-1, -3)])
def test_score_places_scans_the_best_of_many_places_under_every_shift(town, right, down):
    grounds, mean, codes = town
    many = np.concatenate([np.random.default_rng(3).integers(0, 256, (5000, 144), dtype=np.uint8), codes])
    asked = _encode(render_view(grounds[5], 512, 0.0, round(_CELL_PX * right), round(_CELL_PX * down)), mean)
    full, ahead = placecode.scan_codes(asked, many), placecode.scan_in_two_steps(asked, many)
    assert ahead.shape == full.shape
    assert ahead.argmax() == full.argmax() == 5005
    looked_closer = np.argsort(-ahead)[:100]
    np.testing.assert_array_equal(ahead[looked_closer], full[looked_closer])
    assert (ahead <= full + 1e-6).all()
    assert (ahead < full).mean() > 0.5  # the rest were not
    np.testing.assert_array_equal(placecode.scan_in_two_steps(asked, codes), placecode.scan_codes(asked, codes))
