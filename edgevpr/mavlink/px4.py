"""Use of GPS and of our positions by a PX4, as its filter's report (ESTIMATOR_STATUS) tells it: it has a flag that is
set while the filter fuses GPS or our messages 296, and one that is set while it fuses our ODOMETRY, too. Neither
message is ever answered. Read in the sources of 1.18 (EKF2, `Ekf::get_ekf_soln_status`), and held beside a real
1.17.0 and 1.18-beta1."""

import math

from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import MotionState
from edgevpr.mavlink.wire import Message, mavlink

_FUSES_ABSOLUTE, _FUSES_ANY = mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS, mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
_OUR_MARK_S = 6.0  # so long after our last position the flag may still be about ours: PX4 waits for 5 s
_UNUSED_FOR_S = 2.0  # of a receiver with a fix: one that has just lost it, or got it, is judged by its reports


class Px4Use:
    """Keeps whether PX4 `uses_gps` while a receiver has a fix: with EKF2_GPS_CTRL=0, or when it rejects GPS, it does
    not. Of its reports while our positions are sent, `used` and `unused` count those that say that they are fused, or
    not."""

    def __init__(self) -> None:
        self.uses_gps = True
        self.used = self.unused = 0
        self._sent_s, self._ours = -math.inf, _FUSES_ABSOLUTE
        self._unused_since_s: float | None = None
        self._is_telling = False  # before 1.16 the flag is that of a position, of whatever source

    @property
    def used_share(self) -> float | None:
        """Share of the reports that say that our positions are used; None without one."""
        count = self.used + self.unused
        return self.used / count if count else None

    def told(
        self, state: MotionState | None, is_vision: bool, origin: tuple[float, float, float] | None, now_s: float
    ) -> Message | None:
        """Make the message that tells PX4 a state (None: unknown), by message 296 or, if it `is_vision`, by ODOMETRY,
        which needs the `origin` of its local frame: latitude, longitude in degrees, altitude in metres."""
        if state is None or (is_vision and origin is None):
            return None
        self._sent_s, self._ours = now_s, _FUSES_ANY if is_vision else _FUSES_ABSOLUTE
        return messages.vision_position(state, origin) if is_vision and origin else messages.position_sensor(state)

    def hear(self, report: Message, now_s: float, has_fix: bool) -> None:
        """Process an ESTIMATOR_STATUS. `has_fix`: a GPS receiver has one."""
        is_fusing = bool(report.flags & _FUSES_ABSOLUTE)
        self._is_telling |= is_fusing
        if now_s - self._sent_s < 1.0:
            # A ratio above 1 is beyond the filter's gate.
            is_used = bool(report.flags & self._ours) and not report.pos_horiz_ratio > 1
            self.used, self.unused = self.used + is_used, self.unused + (not is_used)
        if now_s - self._sent_s <= _OUR_MARK_S or not self._is_telling:
            return
        if is_fusing or not has_fix:
            self._unused_since_s, self.uses_gps = None, self.uses_gps or is_fusing
        elif self._unused_since_s is None:
            self._unused_since_s = now_s
        elif now_s - self._unused_since_s >= _UNUSED_FOR_S:
            self.uses_gps = False
