"""Readiness of the autopilot to take a fix: its state, as far as it tells it, and the reasons for its answers.

The reasons are read off ArduPilot 4.7-dev (`setLatLng` of its NavEKF3) and PX4 1.17-alpha (`EKF2.cpp`).
"""

import math
from typing import NamedTuple

from edgevpr.mavlink.messages import POSITION_FIX
from edgevpr.mavlink.vehicle import FILTER_REPORTS, GPS_REPORTS
from edgevpr.mavlink.wire import Message, mavlink

# ArduPilot refuses fixes until its GPS has said nothing useful for one second, and a receiver reports twice a second or
# less often.
_GPS_COUNTS_S = 2.5
_FLAGS_FRESH_S = 3.0  # they are asked for twice a second
_ORIGIN_WITHIN_S = 2.0  # of asking for it: later there is none
_ASK_AGAIN_S = 10.0


class AutopilotState(NamedTuple):
    """Everything known of the autopilot that decides whether it takes a fix; None: unknown.

    `gps_age_s` is the time since one of its receivers had a 3D fix (None: none has had one), `filter_flags` those of
    EKF_STATUS_REPORT or ESTIMATOR_STATUS. `answers_others`: it has answered another command of ours.
    """

    is_px4: bool = False
    is_armed: bool | None = None
    gps_age_s: float | None = None
    has_origin: bool | None = None
    filter_flags: int | None = None
    answers_others: bool = False

    @property
    def has_gps(self) -> bool:
        """True where a receiver had a 3D fix a moment ago."""
        return self.gps_age_s is not None and self.gps_age_s <= _GPS_COUNTS_S


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

    def state(self, now_s: float) -> AutopilotState:
        """Return the state at this moment."""
        return AutopilotState(
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


class Reason(NamedTuple):
    """A reason in a few words, 26 bytes at most so that they fit a status text, and in a sentence's part."""

    brief: str
    sentence: str


TAKEN = Reason("", "it takes them")
GPS_IN_USE = Reason("GPS in use", "a GPS receiver of its has a fix, and while it has GPS it takes no other position")
NOT_STARTED = Reason("filter not started", "its position filter has not started: a plane starts it with GPS only")
NO_ORIGIN = Reason(
    "no origin",
    "it gives no origin when asked for it: it must have had GPS once, or be sent SET_GPS_GLOBAL_ORIGIN, before it can "
    "know any position",
)
NOT_ARMED = Reason("not armed", "it is not armed: on the ground it reckons no position that a fix could correct")
NOT_RECKONING = Reason(
    "nothing to reckon by",
    "it reckons no position that a fix could correct: it has neither GPS nor airspeed, optical flow or vision",
)
OTHER_AID = Reason("not dead reckoning", "it takes a fix only while it reckons its position without any aid")
NOT_PLAUSIBLE = Reason("fix not plausible", "it reckons its position, and the fix does not fit, or it has no origin")
UNKNOWN = Reason(
    "see its log", "its GPS was in use a moment ago, it has no origin, or it has nothing to reckon by: it does not say"
)
WRONG_FORM = Reason("wrong form", "it does not like their form")
NO_COMMAND = Reason(
    "43003 not known", "its firmware does not know command 43003, or was built without it, as for boards of 1 MB"
)
NO_COMMAND_ANSWERED = Reason(
    "signing? system id?",
    "it answers no command at all of this companion: does its port take signed messages only, does another vehicle "
    "have its system id, or does the line carry nothing towards it?",
)
FIXES_NOT_ANSWERED = Reason(
    "no command 43003?",
    "it answers other commands: is its firmware built without command 43003, or does another program have our "
    "component id?",
)


def why(result: str, state: AutopilotState) -> Reason:
    """Explain an answer to a fix, the name of a MAV_RESULT."""
    match result:
        case "ACCEPTED":
            return TAKEN
        case "FAILED":
            return _why_failed(state)
        case "TEMPORARILY_REJECTED":
            return GPS_IN_USE if state.has_gps else OTHER_AID if state.is_px4 else UNKNOWN
        case "DENIED":
            return WRONG_FORM
        case "UNSUPPORTED":
            return NO_COMMAND
    return Reason("see its log", f"it answers {result}")


def why_silent(state: AutopilotState) -> Reason:
    """Explain that no fix is answered."""
    return FIXES_NOT_ANSWERED if state.answers_others else NO_COMMAND_ANSWERED


def _why_failed(state: AutopilotState) -> Reason:
    """Explain the answer FAILED: the first cause that is known to be there."""
    flags = state.filter_flags or 0
    # PX4 answers with TEMPORARILY_REJECTED while it has GPS, and uses this flag for glitches of it.
    if state.is_px4:
        return NO_ORIGIN if state.has_origin is False else NOT_PLAUSIBLE
    causes = {
        NO_ORIGIN: state.has_origin is False and not state.has_gps,
        NOT_STARTED: bool(flags & mavlink.EKF_UNINITIALIZED),
        GPS_IN_USE: state.has_gps,
        NOT_ARMED: state.is_armed is False,
        NOT_RECKONING: bool(flags & mavlink.EKF_CONST_POS_MODE),
    }
    return next((reason for reason, is_there in causes.items() if is_there), UNKNOWN)
