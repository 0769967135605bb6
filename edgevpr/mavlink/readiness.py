"""The state of the autopilot that decides whether it takes a fix, from what it says."""

import math

from edgevpr.mavlink.certainty import FILTER_REPORTS
from edgevpr.mavlink.messages import POSITION_FIX
from edgevpr.mavlink.reasons import State
from edgevpr.mavlink.wire import Message, mavlink

GPS_REPORTS = ("GPS_RAW_INT", "GPS2_RAW")
_FLAGS_FRESH_S = 3.0  # they are asked for twice a second
_ORIGIN_WITHIN_S = 2.0  # of asking for it: later there is none
_ASK_AGAIN_S = 10.0


class Readiness:
    """The state as far as the autopilot's messages tell it."""

    def __init__(self) -> None:
        self._is_px4 = self._answers_others = False
        self._is_armed: bool | None = None
        self._flags, self._flags_s = 0, -math.inf
        self._had_origin: bool | None = None  # when it was asked for last
        self._gps_s = self._origin_s = self._asked_s = -math.inf

    def hear(self, message: Message, now_s: float) -> None:
        """Take in a message of the autopilot, of any kind."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._is_px4 = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
            self._is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind in GPS_REPORTS and message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
            self._gps_s = now_s
        elif kind in FILTER_REPORTS:
            self._flags, self._flags_s = message.flags, now_s
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._origin_s = now_s
        elif kind == "COMMAND_ACK" and message.command != POSITION_FIX:
            self._answers_others = True

    def state(self, now_s: float) -> State:
        """Return the state at this moment."""
        return State(
            is_px4=self._is_px4,
            is_armed=self._is_armed,
            gps_age_s=None if self._gps_s == -math.inf else now_s - self._gps_s,
            has_origin=self._has_origin(now_s),
            filter_flags=self._flags if now_s - self._flags_s <= _FLAGS_FRESH_S else None,
            answers_others=self._answers_others,
        )

    def asks_origin(self, now_s: float) -> bool:
        """Tell whether to ask for the origin after a fix was refused, and take note that it is asked for then. It is
        asked for again from time to time: an autopilot that has restarted has lost it."""
        if self.state(now_s).has_gps or now_s - self._asked_s < _ASK_AGAIN_S:
            return False
        self._had_origin, self._asked_s = self._has_origin(now_s), now_s
        return True

    def _has_origin(self, now_s: float) -> bool | None:
        if self._origin_s > -math.inf and self._origin_s >= self._asked_s:
            return True
        is_asked = self._asked_s > -math.inf
        return False if is_asked and now_s - self._asked_s > _ORIGIN_WITHIN_S else self._had_origin
