"""Motion between two queries, from clocks and odometry that may be wrong."""

import numpy as np
import pytest

from edgevpr.runtime.recognise.belief import moved


def test_odometry_says_how_far_and_how_surely():
    motion = moved(2.0, 1.0, 30.0, (3.0, -4.0))
    np.testing.assert_allclose(motion.by, [6, -8])
    np.testing.assert_allclose(motion.covariance, 1.5**2 * np.eye(2))
    assert motion.reach == 60
    assert motion.elapsed_s == 2


@pytest.mark.parametrize("elapsed_s", [None, -1.0, 0.0, float("nan"), -float("inf")])
def test_a_time_that_makes_no_sense_is_the_usual_one_and_says_nothing_of_the_way(elapsed_s):
    motion = moved(elapsed_s, 0.5, 30.0, (3.0, 4.0))
    assert motion.by is None
    assert motion.reach == 15
    assert motion.elapsed_s == 0.5


@pytest.mark.parametrize("velocity", [None, (np.nan, 1.0), (np.inf, 0.0), (61.0, 0.0)])
def test_a_velocity_that_cannot_be_is_none(velocity):
    motion = moved(2.0, 1.0, 30.0, velocity)
    assert motion.by is None
    assert motion.reach == 60


def test_a_velocity_that_is_twice_the_highest_is_heard():
    assert moved(1.0, 1.0, 30.0, (60.0, 0.0)).by is not None
