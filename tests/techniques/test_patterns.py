"""The slow patterns of a block: what they are, and that comparing them is comparing the blocks."""

import numpy as np
import pytest

from edgevpr.techniques.gradients import slow_patterns, waves


@pytest.mark.parametrize("bins", [2, 3, 5, 8, 9, 64])
def test_waves_have_length_one_and_are_those_of_the_discrete_fourier_transform(bins):
    np.testing.assert_allclose(waves(bins) @ waves(bins).T, np.eye(bins), atol=1e-5)
    power = abs(np.fft.rfft(waves(bins), axis=1)) ** 2
    assert power.argmax(axis=1).tolist() == [(number + 1) // 2 for number in range(bins)]
    assert np.sort(power, axis=1)[:, :-1].max() < 1e-9 * bins


@pytest.mark.parametrize("bins", [2, 3, 5, 8, 9, 64])
def test_patterns_have_length_one_and_stand_at_right_angles(bins):
    patterns = slow_patterns(bins).astype(float)
    assert patterns.shape[0] == 4 * bins
    np.testing.assert_allclose(patterns.T @ patterns, np.eye(patterns.shape[1]), atol=1e-6)
