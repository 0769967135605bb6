"""Reasons why an autopilot refuses a position fix, or says nothing to it, from what is known of it at that moment.

Read off ArduPilot 4.7-dev (`setLatLng` of its NavEKF3) and PX4 1.17-alpha (`EKF2.cpp`).
"""

from typing import NamedTuple

from edgevpr.mavlink.wire import mavlink

# ArduPilot refuses fixes until its GPS has said nothing useful for one second, and a receiver reports twice a second or
# less often.
_GPS_COUNTS_S = 2.5


class State(NamedTuple):
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


def why(result: str, state: State) -> Reason:
    """Explain an answer to a fix, the name of a MAV_RESULT."""
    match result:
        case "ACCEPTED":
            return TAKEN
        case "FAILED":
            return why_failed(state)
        case "TEMPORARILY_REJECTED":
            return GPS_IN_USE if state.has_gps else OTHER_AID if state.is_px4 else UNKNOWN
        case "DENIED":
            return WRONG_FORM
        case "UNSUPPORTED":
            return NO_COMMAND
    return Reason("see its log", f"it answers {result}")


def why_failed(state: State) -> Reason:
    """Explain the answer FAILED: the first cause that is known to be there."""
    flags = state.filter_flags or 0
    # PX4 answers with TEMPORARILY_REJECTED while it has GPS, and uses this flag for glitches of it.
    if state.is_px4:
        return NO_ORIGIN if state.has_origin is False else NOT_PLAUSIBLE
    if state.has_origin is False and not state.has_gps:
        return NO_ORIGIN
    if flags & mavlink.EKF_UNINITIALIZED:
        return NOT_STARTED
    if state.has_gps:
        return GPS_IN_USE
    if state.is_armed is False:
        return NOT_ARMED
    if flags & mavlink.EKF_CONST_POS_MODE:
        return NOT_RECKONING
    return UNKNOWN


def why_silent(state: State) -> Reason:
    """Explain that no fix is answered."""
    return FIXES_NOT_ANSWERED if state.answers_others else NO_COMMAND_ANSWERED
