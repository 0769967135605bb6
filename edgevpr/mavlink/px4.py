"""Infers whether PX4 uses GPS and our positions, from its filter's report (ESTIMATOR_STATUS).

While PX4 uses our positions, it does not reset its position to a recovered GPS, however wrong ours are
(EKF2, `isGnssPosResetAllowed`). We must therefore stop sending before it can use GPS again, but only when PX4 shows
that it would: as soon as its checks of the receiver pass, it fuses the receiver's velocity, regardless of our
positions. Based on the sources of 1.18 (`Ekf::get_ekf_soln_status`, `getHorizontalVelocityInnovationTestRatio`), and
compared with the real 1.17.0 and 1.18-beta1."""

import math

from edgevpr.core.types import Receiver
from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import MotionState
from edgevpr.mavlink.wire import Message, mavlink

_FUSES_ABSOLUTE = mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
_FUSES_ANY = mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
_FUSION_FLAG_VERSION = (1, 16)  # before, the first flag means a position from any source
_SENSOR_TIMEOUT_S = 6.0  # after our last message 296, whose flag PX4 keeps set for 5 s
_VISION_TIMEOUT_S = 1.0  # ODOMETRY has its own flag, so only the end of our messages must be detected
_MIN_UNUSED_S = 2.0  # PX4 must not use a receiver with a fix for this long: the fix may be new or just lost
_SENDING_TIMEOUT_S = 1.0
# A recovered receiver must be steady for this long before we stop sending: it may be intermittent.
_MIN_STEADY_S = 1.5
_FIRST_PAUSE_S = 30.0  # after an attempt in which PX4 did not use GPS; doubled each time
_MAX_PAUSE_S = 240.0


class Px4Fusion:
    """Infers whether PX4 `uses_gps` while a receiver has a fix: it does not if EKF2_GPS_CTRL=0, or if it rejects GPS.
    `used` and `unused` count the reports, while our positions are sent, in which PX4 fuses them and does not."""

    def __init__(self) -> None:
        self.uses_gps = True
        self.used = self.unused = 0
        self._sent_s, self._is_vision = -math.inf, False
        self._unused_since_s: float | None = None
        self._reports_fusion = False  # by the flag
        self._fuses_velocity = False
        self._next_try_s, self._pause_s = -math.inf, _FIRST_PAUSE_S

    @property
    def used_share(self) -> float | None:
        """Fraction of reports in which our positions are used; None without reports."""
        count = self.used + self.unused
        return self.used / count if count else None

    def make_state_message(
        self, state: MotionState | None, origin: tuple[float, float, float] | None, system_id: int, now_s: float
    ) -> Message | None:
        """Make the message that sends a state (None: unknown) to PX4, which has this system id: ODOMETRY, relative to
        the `origin` of PX4's local frame (latitude, longitude in degrees, altitude in metres; None: message 296)."""
        if state is None:
            return None
        self._sent_s, self._is_vision = now_s, origin is not None
        if origin:
            return messages.make_vision_position(state, origin)
        return messages.make_position_sensor(state, system_id)

    def handle(
        self,
        report: Message,
        now_s: float,
        receiver: Receiver | None,
        *,
        is_trusted: bool = True,
        version: tuple[int, int] | None = None,
        is_armed: bool = False,
    ) -> None:
        """Process an ESTIMATOR_STATUS. `receiver`: the best GPS receiver with a fix (None: none has a fix).
        `is_trusted`: False while matches prove that receiver wrong. `version`: of PX4 (None: unknown). `is_armed`:
        False while PX4 may be starting, when it does not yet use its receiver."""
        is_fusing = bool(report.flags & _FUSES_ABSOLUTE)
        self._reports_fusion |= is_fusing or (is_armed and version is not None and version >= _FUSION_FLAG_VERSION)
        silent_s, timeout_s = now_s - self._sent_s, _VISION_TIMEOUT_S if self._is_vision else _SENSOR_TIMEOUT_S
        if silent_s < _SENDING_TIMEOUT_S:
            # A test ratio above 1 is outside the filter's gate.
            flag = _FUSES_ANY if self._is_vision else _FUSES_ABSOLUTE
            is_used = bool(report.flags & flag) and not report.pos_horiz_ratio > 1
            self.used, self.unused = self.used + is_used, self.unused + (not is_used)
        if not self._reports_fusion:
            return
        fused_velocity = self._fuses_velocity
        self._fuses_velocity = fuses_velocity = math.isfinite(report.vel_ratio) and report.vel_ratio > 0
        if fuses_velocity and not fused_velocity:
            self._next_try_s = -math.inf
        if receiver is None:
            self._unused_since_s = None
            self._next_try_s, self._pause_s = -math.inf, _FIRST_PAUSE_S
        elif silent_s > timeout_s or (self._is_vision and is_fusing):
            self._infer_gps_use(is_fusing, now_s)
        elif not self.uses_gps or silent_s < _SENDING_TIMEOUT_S:
            is_due = now_s >= self._next_try_s and receiver.steady_for_s >= _MIN_STEADY_S
            self._unused_since_s, self.uses_gps = None, fuses_velocity and is_due and is_trusted
        elif not fuses_velocity:
            self._infer_gps_use(False, now_s)  # PX4 does not use GPS although we stopped sending

    def _infer_gps_use(self, is_fusing: bool, now_s: float) -> None:
        """Infer whether PX4 uses GPS while it uses none of our positions: it does if it fuses a position."""
        if is_fusing:
            self._unused_since_s, self.uses_gps, self._pause_s = None, True, _FIRST_PAUSE_S
        elif self._unused_since_s is None:
            self._unused_since_s = now_s
        elif now_s - self._unused_since_s >= _MIN_UNUSED_S and self.uses_gps:
            self.uses_gps = False
            self._next_try_s = now_s + self._pause_s
            self._pause_s = min(2 * self._pause_s, _MAX_PAUSE_S)
