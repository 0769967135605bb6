"""The readiness of the autopilot to accept a fix: its state, as far as its messages tell it, and the likely reasons for
its answers. Used by `peer`, `fixes` and `conversation`.

The reasons were read in the source code of ArduPilot 4.7-dev (`setLatLng` of its NavEKF3) and PX4 1.17-alpha
(`EKF2.cpp`).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from edgevpr.mavlink.messages import POSITION_FIX
from edgevpr.mavlink.vehicle import FILTER_REPORTS, GPS_REPORTS
from edgevpr.mavlink.wire import Message, mavlink

# ArduPilot refuses fixes until its GPS has had no fix for one second, and a receiver reports twice a second or less
# often.
_GPS_COUNTS_S = 2.5
_FLAGS_FRESH_S = 3.0  # they are requested twice a second
_ORIGIN_WITHIN_S = 2.0  # of the request: an autopilot that has not answered by then has no origin
_ASK_AGAIN_S = 10.0


@dataclass(slots=True, kw_only=True)
class Readiness:
    """All that the autopilot's messages tell about its readiness to accept a fix; None: unknown. Fields that end in
    `_s` are the time at which something was last received (-inf: never). `answers_others`: it has answered another of
    our commands than a fix. `asked_s` is when its origin was last requested, `had_origin` the result of `has_origin`
    just before that."""

    is_px4: bool = False
    is_armed: bool | None = None
    answers_others: bool = False
    flags: int = 0  # of EKF_STATUS_REPORT or ESTIMATOR_STATUS
    flags_s: float = -math.inf
    gps_s: float = -math.inf  # when one of its receivers had a 3D fix
    origin_s: float = -math.inf
    asked_s: float = -math.inf
    had_origin: bool | None = None

    def hear(self, message: Message, now_s: float) -> None:
        """Process a message of the autopilot, of any kind."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self.is_px4 = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
            self.is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind in GPS_REPORTS and message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
            self.gps_s = now_s
        elif kind in FILTER_REPORTS:
            self.flags, self.flags_s = message.flags, now_s
        elif kind == "GPS_GLOBAL_ORIGIN":
            self.origin_s = now_s
        elif kind == "COMMAND_ACK" and message.command != POSITION_FIX:
            self.answers_others = True

    def has_gps(self, now_s: float) -> bool:
        """Return True if a GPS receiver of the autopilot has reported a 3D fix in the last 2.5 s."""
        return now_s - self.gps_s <= _GPS_COUNTS_S

    def has_origin(self, now_s: float) -> bool | None:
        """Return True if the autopilot has an origin, False if it did not answer a request for it within two seconds,
        None if that is unknown."""
        if self.origin_s > -math.inf and self.origin_s >= self.asked_s:
            return True
        is_asked = self.asked_s > -math.inf
        return False if is_asked and now_s - self.asked_s > _ORIGIN_WITHIN_S else self.had_origin

    def asks_origin(self, now_s: float) -> bool:
        """Return True if the origin is to be requested now, after a refused fix, and note the time. It is requested
        every ten seconds at most, and again and again: an autopilot that has restarted has lost its origin."""
        if self.has_gps(now_s) or now_s - self.asked_s < _ASK_AGAIN_S:
            return False
        self.had_origin, self.asked_s = self.has_origin(now_s), now_s
        return True

    def why(self, result: str, now_s: float) -> "Reason":
        """Return the likely reason for an answer to a fix; `result` is the name of a MAV_RESULT."""
        if result == "FAILED":
            return self._why_failed(now_s)
        if result == "TEMPORARILY_REJECTED":
            return GPS_IN_USE if self.has_gps(now_s) else OTHER_AID if self.is_px4 else UNKNOWN
        known = {"ACCEPTED": TAKEN, "DENIED": WRONG_FORM, "UNSUPPORTED": NO_COMMAND}
        return known.get(result) or Reason("see its log", f"it answers {result}")

    def why_silent(self) -> "Reason":
        """Return the likely reason why the autopilot does not answer fixes."""
        return FIXES_NOT_ANSWERED if self.answers_others else NO_COMMAND_ANSWERED

    def _why_failed(self, now_s: float) -> "Reason":
        """Return the likely reason for the answer FAILED: the first one in order that is known to apply."""
        has_gps, lacks_origin = self.has_gps(now_s), self.has_origin(now_s) is False
        # PX4 answers with TEMPORARILY_REJECTED while it has GPS, and uses this flag for glitches of it.
        if self.is_px4:
            return NO_ORIGIN if lacks_origin else NOT_PLAUSIBLE
        flags = self.flags if now_s - self.flags_s <= _FLAGS_FRESH_S else 0
        causes = {
            NO_ORIGIN: lacks_origin and not has_gps,
            NOT_STARTED: flags & mavlink.EKF_UNINITIALIZED,
            GPS_IN_USE: has_gps,
            NOT_ARMED: self.is_armed is False,
            NOT_RECKONING: flags & mavlink.EKF_CONST_POS_MODE,
        }
        return next((reason for reason, is_there in causes.items() if is_there), UNKNOWN)


class Reason(NamedTuple):
    """The reason for an autopilot's answer, or for its silence, in two forms: `brief` has at most 26 bytes, to fit a
    status text; `sentence` is a part of a sentence in which "it" is the autopilot."""

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
