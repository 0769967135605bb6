"""A path: velocities or accelerations summed up, at any time of the last seconds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgevpr.core.types import Position
from edgevpr.runtime.flight.path import HISTORY_S, Path, to_ground_acceleration

HOME = Position(47.0, 8.0)


def test_path_keeps_the_last_seconds_and_extrapolates_with_the_velocity():
    path = Path(HOME, 0.0, (1.0, 0.0))
    for step in range(1, 2001):
        path.add_velocity(step / 10, (1.0, 0.0))
    assert path.interpolate(200.0 - 2 * HISTORY_S - 0.2) is None
    assert np.allclose(path.interpolate(200.0 - HISTORY_S + 0.1).position_m, (200.0 - HISTORY_S + 0.1, 0))
    assert np.allclose(path.interpolate(200.9).position_m, (200.9, 0))
    assert path.interpolate(201.1) is None


def test_path_breaks_at_a_gap():
    path = Path(HOME, 0.0, (1.0, 0.0))
    path.add_velocity(0.9, (1.0, 0.0))
    assert not path.is_broken
    assert path.add_velocity(0.9, (1.0, 0.0)) == path.add_velocity(0.5, (1.0, 0.0)) == 0.0, "no time has passed"
    path.add_velocity(2.5, (1.0, 0.0))
    assert path.is_broken


@pytest.mark.parametrize("yaw_deg", [0.0, 77.0, -160.0])
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (30.0, 0.0), (0.0, -20.0), (-35.0, 12.0)])
def test_to_ground_acceleration_removes_gravity(roll_deg, pitch_deg, yaw_deg):
    earth_from_body = Rotation.from_euler("ZYX", (yaw_deg, pitch_deg, roll_deg), degrees=True)
    north, east, down = 1.2, -0.7, 0.3
    felt = earth_from_body.inv().apply((north, east, down - 9.81))
    assert np.allclose(to_ground_acceleration(tuple(felt), roll_deg, pitch_deg, yaw_deg), (east, north))
