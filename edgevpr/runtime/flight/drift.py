"""Estimates the errors of a path, such as the offset from the path to the aircraft, for `navigation`."""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.runtime.recognise.locate import mahalanobis
from edgevpr.runtime.recognise.odometry import OdometryStep

GRAVITY_M_S2 = 9.80665
# Time constant of the attitude error of an autopilot that dead-reckons. Only some pictures show this error:
# if its variance grew without limit, every fix would be attributed to it.
_ATTITUDE_ERROR_TIME_S = 20.0
# With poor gyros the attitude error drifts up to nine times as fast as with good ones: in PX4's simulator by 0.1 in
# eight seconds after GPS was lost. The gyros are rated by the mean square of the attitude errors in the last twenty
# pictures, divided by their variances: 0.2 in ArduPilot's simulator, 1.3 in PX4's.
_MAX_NOISE_FACTOR = 8.0
_ATTITUDE_ERROR_GAIN = 0.05
_CALM_ERROR = 0.3
_TYPICAL_ATTITUDE_ERROR_SD = 0.024
_ROUGH_ERROR = 0.8
# An autopilot that starts to dead-reckon mistakes a change of wind for a turn: its attitude error drifts this many
# times faster, for about this long. In simulation, an ArduPilot plane's was 4.5 degrees after ten seconds.
_GPS_LOSS_NOISE_FACTOR = 6.0
_GPS_LOSS_TIME_S = 10.0
_MAX_INNOVATION_SIGMA = 4.0  # odometry that differs by more is not used
# After so many such steps in a row, none is used until a fix or GPS: a less certain state would agree after 15 s.
_MAX_CONTRADICTIONS = 3
_ODOMETRY_SD = 0.05  # error of scale and direction of all odometry steps
_ODOMETRY_NOISE = 0.003  # random change of that error in one second
# Its heading then drifts too, so the direction of odometry changes this many times faster: by 6 degrees in 3 s on
# an ArduPilot plane. The rotation of a match measures it (radians: standard deviation, and the largest that is used).
_GPS_LOSS_TURN_FACTOR = 10.0
_ROTATION_SD_RAD = 0.035
_MAX_ROTATION_RAD = 0.4
_MAX_STEPPED_ROTATION_RAD = 0.6  # after a step of the heading
_HEADING_STEP_DECAY = 0.9  # with each GPS position, once a second: with GPS, an autopilot corrects its heading
_MAX_TURNED_M = 2.0  # after a larger one, odometry whose end the step would move by more is not used
_MAX_ROTATION_SIGMA = 3.0  # a larger change: the autopilot has corrected its heading

_C, _S, _B, _M, _F, _K = (slice(first, first + 2) for first in range(0, 12, 2))
_SIZE = 13
_EYE = np.eye(2)
_IDENTITY = np.eye(_SIZE)
_DIAGONAL = np.diag_indices(_SIZE)
_SCALE = 10
_TURN = 11
_HEADING = 12
_FRAME = np.zeros((2, _SIZE))  # measurement matrix of `f`
_FIX = np.zeros((2, _SIZE))  # measurement matrix of a frame's fix
_FRAME[:, _F] = _FIX[:, _F] = _FIX[:, _M] = _EYE


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Size of the errors of a path, as standard deviations of one axis. `velocity_sd` (m/s) and `acceleration_sd`
    (m/s2): errors of an uncorrected path; `position_noise` (m), `velocity_noise` (m/s) and `acceleration_noise` (m/s2):
    random change of the errors in one second."""

    velocity_sd: float
    acceleration_sd: float
    position_noise: float
    velocity_noise: float
    acceleration_noise: float
    is_inertial: bool  # the path is integrated from accelerations, so an attitude error causes an acceleration error
    heading_sd: float = 0.0  # radians, error of the heading by which accelerations are rotated
    # The autopilot follows our positions closely and mistakes their errors for motion, so its attitude is assumed to be
    # poor when GPS is lost, until pictures show that it is good.
    attitude_follows_positions: bool = False


# Dead reckoning by an autopilot: nearly all of the error is unknown wind. In simulation with a wind of 6 m/s, an
# ArduPilot plane's velocity was wrong by 5 m/s at 10 s after GPS was lost, and by up to 7.5 m/s later.
DEAD_RECKONING = Drift(
    velocity_sd=4.0, acceleration_sd=0.1, position_noise=0.3, velocity_noise=0.5, acceleration_noise=0.03,
    is_inertial=False,
)  # fmt: skip
# Accelerations, rotated into east and north by the autopilot's attitude: an error of half a degree is 0.09 m/s2.
INERTIAL = Drift(
    velocity_sd=0.5, acceleration_sd=0.1, position_noise=0.05, velocity_noise=0.1, acceleration_noise=0.02,
    is_inertial=True, heading_sd=0.05,
)  # fmt: skip
# In its simulator PX4's heading is up to 20 degrees wrong.
INERTIAL_PX4 = replace(INERTIAL, heading_sd=0.15, attitude_follows_positions=True)


class DriftFilter:
    """Kalman filter that estimates the errors of one path. `drift` is the size of these errors, `map_sd_m` the standard
    deviation, of one axis, of the error common to all fixes.

    The state has seven parts; all but the last are two numbers, mostly east and north:
    - `c` (m): the offset from the path to the aircraft
    - `s` (m/s): the aircraft's velocity minus the path's
    - `b` (m/s2): minus the acceleration error that an attitude error causes through gravity; ds/dt of an inertial path
    - `m` (m): the offset from GPS positions to fixes
    - `f` (m): the offset from the path to the position measured in the last frame's picture
    - `k`: the error of scale and direction (radians, clockwise) of all odometry
    - the error of the heading (radians, clockwise), by which accelerations and odometry are rotated

    A frame may have been taken seconds ago: it is compared with the path at that time. An attitude error shifts its
    `f`, and so its fix, by minus `b` times `attitude_gain_s2`: the height above ground divided by gravity (0: the
    picture does not depend on the attitude). Odometry propagates `f` to the next frame, with the errors of both.
    """

    def __init__(self, drift: Drift, map_sd_m: float) -> None:
        self._drift, self._map_sd_m = drift, map_sd_m
        self._x, self._p = np.zeros(_SIZE), np.zeros((_SIZE, _SIZE))
        self._frame = np.zeros((2, _SIZE)), 0.0  # its measurement matrix, and the variance of each axis
        self._gps_loss = 0.0  # 1 when GPS is lost, then decaying
        self._contradictions = 0  # steps of odometry in a row that contradicted the state, since the last fix or GPS
        self._is_rotated = False  # the image of the last fix, by more than odometry is corrected for
        self._heading_step = 0.0  # radians, without a turn; no match has shown since that the heading is nearly right
        # Mean square of the attitude errors in the last pictures, divided by their variances.
        self._attitude_error = _ROUGH_ERROR if drift.attitude_follows_positions else 0.0
        self._attitude_error_sd = _TYPICAL_ATTITUDE_ERROR_SD  # mean of the standard deviations of these errors

    def start(self, sd_m: float, velocity_sd_m_s: float) -> None:
        """Start with the aircraft on the path. `sd_m` and `velocity_sd_m_s` are the standard deviations, of one axis,
        of its offset and of the velocity error."""
        self._x, self._contradictions = np.zeros(_SIZE), 0
        sds = sd_m, velocity_sd_m_s, self._drift.acceleration_sd, self._map_sd_m, 0.0, _ODOMETRY_SD
        self._p = np.diag(np.square(np.append(np.repeat(sds, 2), self._drift.heading_sd)))

    @property
    def attitude_error_sd(self) -> float:
        """Standard deviation of the reported attitude, as a tangent, measured in images (0: within their errors)."""
        return self._attitude_error_sd * math.sqrt(max(0.0, self._attitude_error - _CALM_ERROR))

    def predict(self, step_s: float, acceleration_m_s2: Doubles) -> None:
        """Predict the state `step_s` seconds later; `acceleration_m_s2` (2,): the mean one of an inertial path."""
        move = _IDENTITY.copy()
        move[_C, _S] = step_s * _EYE
        if self._drift.is_inertial:
            move[_C, _B] = step_s**2 / 2 * _EYE
            move[_S, _B] = step_s * _EYE
            east_m_s2, north_m_s2 = acceleration_m_s2
            move[_S, _HEADING] = step_s * north_m_s2, -step_s * east_m_s2
        else:
            move[_B, _B] = math.exp(-step_s / _ATTITUDE_ERROR_TIME_S) * _EYE
        drift = self._drift
        # How poor the gyros are, from the attitude errors measured in pictures. Poor gyros also cause a poor heading.
        roughness = (self._attitude_error - _CALM_ERROR) / (_ROUGH_ERROR - _CALM_ERROR)
        factor = 1.0 + _MAX_NOISE_FACTOR * min(1.0, max(0.0, roughness)) * drift.is_inertial
        random_walk = drift.acceleration_noise * (factor + _GPS_LOSS_NOISE_FACTOR * self._gps_loss)
        scale_noise = _ODOMETRY_NOISE * factor
        turn_noise = scale_noise + _ODOMETRY_NOISE * _GPS_LOSS_TURN_FACTOR * self._gps_loss
        noise = np.zeros(_SIZE)
        noise[_C], noise[_S], noise[_B] = drift.position_noise, drift.velocity_noise, random_walk
        noise[_SCALE], noise[_HEADING if drift.is_inertial else _TURN] = scale_noise, turn_noise
        self._x = move @ self._x
        self._p = move @ self._p @ move.T
        self._p[_DIAGONAL] += step_s * noise**2
        self._gps_loss *= math.exp(-step_s / _GPS_LOSS_TIME_S)

    def lose_gps(self) -> None:
        """Process the loss of GPS: the velocity error becomes more uncertain, because nothing corrects it any more, and
        so does the attitude error of an autopilot that dead-reckons."""
        self._p[_S, _S] += self._drift.velocity_sd**2 * _EYE
        self._gps_loss = 0.0 if self._drift.is_inertial else 1.0
        if self._drift.attitude_follows_positions:
            self._attitude_error = max(self._attitude_error, _ROUGH_ERROR)

    def correct_by_gps(
        self, offset_m: Doubles, sd_m: float, error_m_s: Doubles | None, velocity_sd_m_s: float, age_s: float = 0.0
    ) -> None:
        """Correct the state by a GPS measurement `age_s` seconds old. `offset_m` (2,): from the path to the GPS
        position; `error_m_s` (2,): GPS velocity minus the path's (None: unknown). Standard deviations: of one axis."""
        matrix = self._make_motion_jacobian(age_s)
        errors = offset_m if error_m_s is None else np.concatenate([offset_m, error_m_s])
        variances = [sd_m**2] * 2 + [velocity_sd_m_s**2] * 2
        self._contradictions = 0
        self._heading_step *= _HEADING_STEP_DECAY
        self._correct(matrix[: errors.size], errors, np.diag(variances[: errors.size]))

    def add_frame(
        self,
        age_s: float,
        bend_m: Doubles,
        attitude_gain_s2: float,
        sd_m: float,
        step: OdometryStep | None,
        path_moved_m: Doubles,
    ) -> bool:
        """Process a frame taken `age_s` ago, when the path was `bend_m` (2,) off the line that it follows now; correct
        the state by the `step` of odometry since the previous frame (None: unknown), in which the path moved by
        `path_moved_m` (2,). `sd_m`: of the frame's position on each axis, without the effect of the attitude error.
        Returns True if the step agrees with the state and is used."""
        self._frame = position, variance_m2 = self._make_position_jacobian(age_s, attitude_gain_s2), sd_m**2
        position[:, _HEADING] = self._drift.is_inertial * np.array([bend_m[1], -bend_m[0]])
        is_doubted = self._is_rotated or self._contradictions == _MAX_CONTRADICTIONS
        turned_m = 0.0
        if step and self._heading_step > _MAX_STEPPED_ROTATION_RAD:  # too large for the linear model
            turned_m = 2 * math.sin(self._heading_step / 2) * float(np.hypot(*step.moved_m))
        if step is None or is_doubted or turned_m > _MAX_TURNED_M:
            self._begin_frame()
            return False
        ratio = math.exp(step.log_height)
        self._x[_SCALE] = ratio * (1.0 + self._x[_SCALE]) - 1.0
        self._p[_SCALE] *= ratio
        self._p[:, _SCALE] *= ratio
        self._p[_SCALE, _SCALE] += (ratio * step.log_height_sd) ** 2
        matrix, transition = position - _FRAME, _IDENTITY.copy()
        scale, turn = 1.0 + self._x[_SCALE], self._x[_TURN] + self._x[_HEADING]
        clockwise = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        moved_m = scale * clockwise @ step.moved_m
        # Scale and direction act on the true way. The noise of a measured one would seem to confirm them, and bias them
        # in slow flight, so it is combined with the predicted way, each by its variance.
        predicted_m, predicted_m2 = path_moved_m + matrix @ self._x, np.trace(matrix @ self._p @ matrix.T) / 2
        weight = predicted_m2 / (predicted_m2 + step.sd_m**2 + 2 * variance_m2)
        east_m, north_m = predicted_m + weight * (moved_m - predicted_m)
        transition[_F, _K] = [[east_m / scale, north_m], [north_m / scale, -east_m]]
        transition[_F, _HEADING] = transition[_F, _TURN]
        x, p = self._x.copy(), transition @ self._p @ transition.T
        x[_F] += moved_m - path_moved_m
        p[_F, _F] += (step.sd_m**2 + turned_m**2) * _EYE
        if mahalanobis(matrix @ x, matrix @ p @ matrix.T + variance_m2 * _EYE) > _MAX_INNOVATION_SIGMA:
            self._contradictions += 1
            self._begin_frame()
            return False
        self._x, self._p, self._contradictions = x, p, 0
        self._correct(matrix, np.zeros(2), variance_m2 * _EYE)
        return True

    def correct_by_rotation(self, rotation: float) -> None:
        """Correct the direction of odometry and the heading by a match whose picture is rotated by `rotation` (radians,
        clockwise) against the compass. After a large rotation, odometry is not used until a match shows a smaller one.
        The motion shows later whether the camera or the compass is rotated."""
        limit = _MAX_STEPPED_ROTATION_RAD if self._heading_step else _MAX_ROTATION_RAD
        self._is_rotated = abs(rotation) > limit
        self._heading_step *= abs(rotation) > _MAX_ROTATION_RAD
        if self._is_rotated:
            return
        matrix = np.zeros((1, _SIZE))
        matrix[0, _TURN] = matrix[0, _HEADING] = 1.0
        error, variance = np.array([rotation]), np.array([[_ROTATION_SD_RAD**2]])
        if mahalanobis(error - matrix @ self._x, matrix @ self._p @ matrix.T + variance) > _MAX_ROTATION_SIGMA:
            self._p[_HEADING, _HEADING] += self._drift.heading_sd**2
        self._correct(matrix, error, variance)

    def doubt_heading(self, step_rad: float) -> None:
        """Process a step of the reported heading that the gyros did not measure: before it or since then, heading and
        direction of odometry have been wrong by as much."""
        part = _HEADING if self._drift.is_inertial else _TURN
        self._p[part, part] += step_rad**2
        self._heading_step = min(math.pi, self._heading_step + step_rad)

    def restart_odometry_scale(self, error: float, tolerance: float) -> None:
        """Restart the scale error of odometry at `error`, if the estimate differs by more than `tolerance`."""
        if abs(self._x[_SCALE] - error) > tolerance:
            self._p[_SCALE] = self._p[:, _SCALE] = 0.0
            self._x[_SCALE], self._p[_SCALE, _SCALE] = error, _ODOMETRY_SD**2

    def correct_by_fix(self, offset_m: Doubles, covariance_m2: Doubles) -> None:
        """Correct the state by the fix of the last frame: its offset (2,) from the path and covariance (2, 2)."""
        self._contradictions = 0
        self._correct(_FIX, offset_m, covariance_m2)

    def correct_by_attitude_error(self, nadir_shift: Doubles, sd: float) -> None:
        """Correct the state by the attitude error measured in a picture (see `recognise.perspective`). If pictures show
        more than their own standard deviation, the gyros are poor and the error drifts faster."""
        normalized = float(np.mean(np.square(nadir_shift))) / sd**2
        self._attitude_error += _ATTITUDE_ERROR_GAIN * (normalized - self._attitude_error)
        self._attitude_error_sd += _ATTITUDE_ERROR_GAIN * (sd - self._attitude_error_sd)
        matrix = np.zeros((2, _SIZE))
        matrix[:, _B] = _EYE / GRAVITY_M_S2
        self._correct(matrix, nadir_shift, sd**2 * _EYE)

    def reset_to_fix(self, offset_m: Doubles, covariance_m2: Doubles) -> None:
        """Discard the position, then correct the state by a fix that contradicts it."""
        self._p[_C] = self._p[:, _C] = 0.0
        self._p[_C, _C] = 1e6 * _EYE
        self._p[_S, _S] += self._drift.velocity_sd**2 * _EYE
        self._begin_frame()
        self.correct_by_fix(offset_m, covariance_m2)

    def predict_fix(self) -> tuple[Doubles, Doubles]:
        """Predict the fix of the last frame. Returns its offset (2,) from the path, metres, and the covariance (2, 2)
        of the prediction, excluding that of the fix itself."""
        return _FIX @ self._x, _FIX @ self._p @ _FIX.T

    def estimate_errors(self, age_s: float) -> tuple[Doubles, Doubles, Doubles]:
        """Return the errors of the path `age_s` seconds ago (negative: in the future):
        - offset (2,) from the path to the aircraft, metres
        - velocity error (2,), m/s
        - covariance (4, 4) of both.
        """
        matrix = self._make_motion_jacobian(age_s)
        errors = matrix @ self._x
        return errors[:2], errors[2:], matrix @ self._p @ matrix.T

    def _make_motion_jacobian(self, age_s: float) -> Doubles:
        """Return the observation matrix (4, 13) for the offset and the velocity error of the path `age_s` ago."""
        matrix = np.zeros((4, _SIZE))
        matrix[:2] = self._make_position_jacobian(age_s, 0.0)
        matrix[2:, _S], matrix[2:, _B] = _EYE, -age_s * self._drift.is_inertial * _EYE
        return matrix

    def _begin_frame(self) -> None:
        """Set `f` to the aircraft's offset when the last frame was taken."""
        position, variance_m2 = self._frame
        transition = _IDENTITY.copy()
        transition[_F] = position
        self._x, self._p = transition @ self._x, transition @ self._p @ transition.T
        self._p[_F, _F] += variance_m2 * _EYE

    def _correct(self, matrix: Doubles, measured: Doubles, covariance: Doubles) -> None:
        """Do a Kalman update with the measurement matrix `matrix` (n, 13) and the values `measured` (n,)."""
        gain = np.linalg.solve(matrix @ self._p @ matrix.T + covariance, matrix @ self._p).T
        self._x = self._x + gain @ (measured - matrix @ self._x)
        ikh = _IDENTITY - gain @ matrix  # I - K H
        self._p = ikh @ self._p @ ikh.T + gain @ covariance @ gain.T  # Joseph form: keeps it positive semidefinite

    def _make_position_jacobian(self, age_s: float, attitude_gain_s2: float) -> Doubles:
        """Return the observation matrix (2, 13) of a position measured `age_s` seconds ago, as an offset from the
        path. `attitude_gain_s2`: how strongly an attitude error shifts the position measured in the picture."""
        matrix = np.zeros((2, _SIZE))
        matrix[:, _C], matrix[:, _S] = _EYE, -age_s * _EYE
        matrix[:, _B] = (age_s**2 / 2 * self._drift.is_inertial - attitude_gain_s2) * _EYE
        return matrix
