"""The errors of a simulated autopilot's position estimator. Used by `firmware`. Vectors are east + 1j * north.

NavEKF3 and EKF2 estimate position, velocity and attitude together: a position or velocity that contradicts the inertial
sensors is explained by a tilt too. This is the same Kalman filter for a level vehicle: of each axis the position, the
velocity and the tilt, with the process noise of NavEKF3 (AP_NavEKF3.cpp). It has no states for the biases of gyros and
accelerometers, for yaw and for height. Its time constants are 2.5 s by a receiver good to half a metre, and longer by a
poorer one."""

import math

import numpy as np

from simulated.motion import GRAVITY_M_S2

MIN_SD_M = 0.3
_LOOP_S = 0.01  # EKF_TARGET_DT: noise is given as a standard deviation for one step of this length
_ACCELERATION_NOISE_M_S2 = 0.35  # EK3_ACC_P_NSE
_GYRO_NOISE_RAD_S = 0.015  # EK3_GYRO_P_NSE
_POSITION_NOISE_M = 0.05  # in one second
_MAX_TILT = math.tan(math.radians(5.0))
_NOISE = np.diag([_POSITION_NOISE_M**2, _LOOP_S * _ACCELERATION_NOISE_M_S2**2, _LOOP_S * _GYRO_NOISE_RAD_S**2])


class Estimator:
    """The estimate minus the truth: `error_m` of the position, `velocity_error_m_s`, and `tilt`, the share of gravity
    that the error of the attitude takes for an acceleration. `gyro_error_rad_s` is how fast the tilt goes wrong by
    itself, in each axis. `sd_m` and `speed_sd_m_s` are the standard deviations that the filter assumes, of one axis."""

    def __init__(self, gyro_error_rad_s: float) -> None:
        self._state = np.zeros(3, complex)
        self._covariance = np.diag([MIN_SD_M**2, 0.1**2, math.radians(0.3) ** 2])
        self._gyro_error_rad_s = gyro_error_rad_s * (1 + 1j) / math.sqrt(2)

    @property
    def error_m(self) -> complex:
        return complex(self._state[0])

    @error_m.setter
    def error_m(self, value: complex) -> None:
        self._state[0] = value

    @property
    def velocity_error_m_s(self) -> complex:
        return complex(self._state[1])

    @velocity_error_m_s.setter
    def velocity_error_m_s(self, value: complex) -> None:
        self._state[1] = value

    @property
    def tilt(self) -> complex:
        return complex(self._state[2])

    @property
    def sd_m(self) -> float:
        return math.sqrt(self._covariance[0, 0])

    @property
    def speed_sd_m_s(self) -> float:
        return math.sqrt(self._covariance[1, 1])

    def predict(self, step_s: float) -> None:
        """Advance by `step_s` seconds without a measurement."""
        acceleration = GRAVITY_M_S2 * step_s
        move = np.array([[1.0, step_s, acceleration * step_s / 2], [0.0, 1.0, acceleration], [0.0, 0.0, 1.0]])
        self._state = move @ self._state
        self._state[2] += self._gyro_error_rad_s * step_s
        self._covariance = move @ self._covariance @ move.T + step_s * _NOISE

    def disturb(self, tilt: complex) -> None:
        """Let the attitude be wrong by this much more, as by the noise of gyros."""
        self._state[2] += tilt

    def expect_drift(self, sd_m_s: float) -> None:
        """Let the filter know that its velocity may be wrong by this standard deviation: it dead-reckons."""
        self._covariance[1, 1] = max(self._covariance[1, 1], sd_m_s**2)

    def correct(self, index: int, innovation: complex, sd: float) -> None:
        """Correct by a measurement of the position (`index` 0, metres) or velocity (1, m/s). `innovation` is the
        measurement minus the estimate, and `sd` its standard deviation, one axis."""
        gain = self._covariance[:, index] / (self._covariance[index, index] + sd**2)
        self._state = self._state + gain * innovation
        self._state[2] *= min(1.0, _MAX_TILT / max(abs(self._state[2]), 1e-9))
        self._covariance = self._covariance - np.outer(gain, self._covariance[index])

    def reset_position(self, error_m: complex, sd_m: float) -> None:
        """Set the error of the position, and its standard deviation."""
        self._state[0] = error_m
        self._covariance[0, :] = self._covariance[:, 0] = 0.0
        self._covariance[0, 0] = max(MIN_SD_M, sd_m) ** 2
