"""A Kalman filter of how wrong a path is, and with it of where the aircraft is.

The state has four parts, each east and north: `c`, by how many metres the aircraft is beside its path; `s`, by how many
m/s it is faster; `b`, how fast that changes; and `m`, by how many metres fixes lie beside the positions of GPS, which
the map shares with every fix. Three kinds of news correct it: positions and velocities of an autopilot that has GPS,
and fixes. A fix may be seconds old: the path knows where it was then, so the state of now explains it.
"""

from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles

_C, _S, _B, _M = (slice(first, first + 2) for first in (0, 2, 4, 6))
_EYE = np.eye(2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Knowledge of a path's errors. `velocity_sd` (m/s) and `acceleration_sd` (m/s2) are those to expect of a path that
    nothing corrects; `position_noise`, `velocity_noise` and `acceleration_noise` are by how much they change in a
    second (standard deviations of one axis)."""

    velocity_sd: float
    acceleration_sd: float
    position_noise: float
    velocity_noise: float
    acceleration_noise: float


# Dead reckoning by an autopilot: nearly all of the error is wind that it does not know. In simulation, an ArduPilot
# plane in a wind of 6 m/s was 5 m/s wrong 10 s after the loss of GPS, and up to 7.5 m/s later.
RECKONED = Drift(
    velocity_sd=4.0, acceleration_sd=0.0, position_noise=0.3, velocity_noise=0.5, acceleration_noise=0.0
)  # fmt: skip
# Accelerations turned by the autopilot's attitude: half a degree of tilt is 0.09 m/s2.
INERTIAL = Drift(
    velocity_sd=0.5, acceleration_sd=0.1, position_noise=0.05, velocity_noise=0.1, acceleration_noise=0.02
)  # fmt: skip


class DriftFilter:
    """The errors of one path. `map_sd_m` is the standard deviation of one axis of what all fixes have in common."""

    def __init__(self, drift: Drift, map_sd_m: float) -> None:
        self._drift, self._map_sd_m = drift, map_sd_m
        self._x, self._p = np.zeros(8), np.zeros((8, 8))

    def start(self, offset_m: Doubles, sd_m: float, velocity_sd_m_s: float) -> None:
        """Begin `offset_m` (2,) beside the path, with standard deviations of one axis of that and of the velocity."""
        self._x = np.zeros(8)
        self._x[_C] = offset_m
        of_parts = sd_m, velocity_sd_m_s, self._drift.acceleration_sd, self._map_sd_m
        self._p = np.diag(np.repeat(np.square(of_parts), 2))

    def go_on(self, step_s: float) -> None:
        """Let some seconds pass."""
        move = np.eye(8)
        move[_C, _S] = step_s * _EYE
        move[_C, _B] = step_s**2 / 2 * _EYE
        move[_S, _B] = step_s * _EYE
        drift = self._drift
        noise = drift.position_noise, drift.velocity_noise, drift.acceleration_noise, 0.0
        self._x = move @ self._x
        self._p = move @ self._p @ move.T + step_s * np.diag(np.repeat(np.square(noise), 2))

    def lose_gps(self) -> None:
        """Note that from now on nothing holds the velocity of the path any more."""
        self._p[_S, _S] += self._drift.velocity_sd**2 * _EYE

    def hear_gps(self, off_m: Doubles, sd_m: float, off_m_s: Doubles, velocity_sd_m_s: float) -> None:
        """Take in that GPS lies `off_m` (2,) beside the path and is `off_m_s` (2,) faster than it."""
        look = np.zeros((4, 8))
        look[:2, _C] = look[2:, _S] = _EYE
        self._correct(look, np.concatenate([off_m, off_m_s]), np.diag([sd_m**2] * 2 + [velocity_sd_m_s**2] * 2))

    def hear_fix(self, off_m: Doubles, covariance_m2: Doubles, age_s: float) -> None:
        """Take in a fix that lay `off_m` (2,) beside the path `age_s` seconds ago, with a covariance (2, 2)."""
        self._correct(_seen(age_s), off_m, covariance_m2)

    def trust_fix(self, off_m: Doubles, covariance_m2: Doubles, age_s: float) -> None:
        """Take in a fix that is believed although it contradicts: what was known of the position is forgotten."""
        self._p[_C] = self._p[:, _C] = 0.0
        self._p[_C, _C] = 1e6 * _EYE
        self._p[_S, _S] += self._drift.velocity_sd**2 * _EYE
        self.hear_fix(off_m, covariance_m2, age_s)

    def expected_fix(self, age_s: float) -> tuple[Doubles, Doubles]:
        """Return by how much a fix of so many seconds ago is expected to lie beside the path (2,), and the covariance
        (2, 2) of that, without the fix's own."""
        look = _seen(age_s)
        return look @ self._x, look @ self._p @ look.T

    def errors(self, age_s: float) -> tuple[Doubles, Doubles, Doubles]:
        """Return the errors of the path so many seconds ago (negative: in so many): metres (2,), m/s (2,), and the
        covariance (4, 4) of both."""
        look = np.zeros((4, 8))
        look[:2] = _seen(age_s)
        look[:2, _M] = 0.0
        look[2:, _S], look[2:, _B] = _EYE, -age_s * _EYE
        off = look @ self._x
        return off[:2], off[2:], look @ self._p @ look.T

    def _correct(self, look: Doubles, seen: Doubles, covariance: Doubles) -> None:
        gain = np.linalg.solve(look @ self._p @ look.T + covariance, look @ self._p).T
        self._x = self._x + gain @ (seen - look @ self._x)
        kept = np.eye(8) - gain @ look
        self._p = kept @ self._p @ kept.T + gain @ covariance @ gain.T  # Joseph's form: it stays a covariance


def _seen(age_s: float) -> Doubles:
    """Return what a fix of so many seconds ago sees of the state (2, 8)."""
    return np.hstack([_EYE, -age_s * _EYE, age_s**2 / 2 * _EYE, _EYE])
