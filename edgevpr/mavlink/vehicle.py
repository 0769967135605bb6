"""Attitude and position accuracy of the vehicle, from the autopilot's messages of the last seconds, and the autopilot's
readiness to accept a fix, with the likely reasons for its answers. The reasons are based on the sources of ArduPilot
4.7-dev (`setLatLng` of its NavEKF3) and PX4 1.17-alpha (`EKF2.cpp`)."""

import math
from bisect import bisect_left, bisect_right
from operator import attrgetter
from typing import NamedTuple

from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.wire import Message, mavlink

HISTORY_S = 6.0  # of reports: a frame is not used after 5 s
_MAX_ATTITUDES = 300
_RATE_S = 3.0  # over which the rate of attitudes is measured
_MAX_ATTITUDE_AGE_S = 0.3  # longest time between an attitude and the frame that uses it
# A heading that changes by more than its rate explains is not the aircraft's turn: the compass was disturbed, or the
# autopilot has corrected its estimate.
_MIN_HEADING_STEP_DEG = 5.0
_MAX_STEP_INTERVAL_S = 0.25
_MAX_STEP_PITCH_DEG = 60.0  # near the vertical, the heading turns over in a loop
# A simulated ArduPilot plane drifts at 5 m/s in a wind of 6 m/s that began when GPS was lost. In a gale it would drift
# four times as fast, which is four standard deviations.
DRIFT_M_S = 5.0
MAX_FILTER_REPORT_AGE_S = 3.0  # filter reports are requested twice a second

# EKF_STATUS_REPORT (ArduPilot) and ESTIMATOR_STATUS (PX4) have the same flags. While ArduPilot dead-reckons, it reports
# only a position relative to the last known one (NavEKF3: absolute means measured).
_HAS_POSITION = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_POS_HORIZ_REL

_get_time_s = attrgetter("t_s")


class Attitude(NamedTuple):
    """Roll (right wing down is positive), pitch (nose up) and yaw (clockwise from north) in degrees at time `t_s`, and
    the combined rate of roll and pitch (`tilt_rate_deg_s`)."""

    t_s: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    tilt_rate_deg_s: float = 0.0


class Attitudes:
    """The attitudes of the last six seconds. `heading_step_deg`: sum of the steps of the heading that its rate does not
    explain."""

    def __init__(self) -> None:
        self._history: tuple[Attitude, ...] = ()
        self._yaw_rate_deg_s, self.heading_step_deg = 0.0, 0.0

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of attitudes received in the last three seconds."""
        return sum(now_s - attitude.t_s <= _RATE_S for attitude in self._history) / _RATE_S

    def handle(self, message: Message, now_s: float) -> None:
        """Add the attitude of an ATTITUDE message; ignore one that is not finite."""
        radians = message.roll, message.pitch, message.yaw
        if all(map(math.isfinite, radians)):
            recent = self._history[1 - _MAX_ATTITUDES :]
            first = bisect_left(recent, now_s - HISTORY_S, key=_get_time_s)
            self._add_heading_step(message, now_s)
            self._history = (*recent[first:], Attitude(now_s, *map(math.degrees, radians)))

    def _add_heading_step(self, message: Message, now_s: float) -> None:
        turned_rad_s = message.pitchspeed * math.sin(message.roll) + message.yawspeed * math.cos(message.roll)
        old_deg_s, rate_deg_s = self._yaw_rate_deg_s, math.degrees(turned_rad_s / math.cos(message.pitch))
        self._yaw_rate_deg_s = rate_deg_s
        last = self._history[-1] if self._history else None
        if last is None or max(abs(math.degrees(message.pitch)), abs(last.pitch_deg)) > _MAX_STEP_PITCH_DEG:
            return
        if (step_s := now_s - last.t_s) <= _MAX_STEP_INTERVAL_S:
            turned_deg = step_s * (rate_deg_s + old_deg_s) / 2
            step_deg = abs(wrap_deg(math.degrees(message.yaw) - last.yaw_deg - turned_deg))
            if step_deg > _MIN_HEADING_STEP_DEG + step_s * abs(rate_deg_s - old_deg_s):
                self.heading_step_deg += step_deg

    def interpolate(self, t_s: float) -> Attitude | None:
        """Return the attitude at `t_s`, interpolated between neighbours within 0.3 s, or of the only one."""
        history = self._history  # read once, because another thread replaces it
        index = bisect_right(history, t_s, key=_get_time_s)
        nearest = history[max(0, index - 1) : index + 1]
        neighbours = [attitude for attitude in nearest if abs(attitude.t_s - t_s) <= _MAX_ATTITUDE_AGE_S]
        before = next((attitude for attitude in neighbours if attitude.t_s <= t_s), None)
        after = next((attitude for attitude in neighbours if attitude.t_s > t_s), None)
        if before is None or after is None:
            return before or after
        step_s = after.t_s - before.t_s
        change_deg = [wrap_deg(end - start) for start, end in zip(before[1:4], after[1:4], strict=True)]
        fraction = (t_s - before.t_s) / step_s
        roll, pitch, yaw = (start + fraction * change for start, change in zip(before[1:4], change_deg, strict=True))
        return Attitude(t_s, roll, pitch, yaw, math.hypot(*change_deg[:2]) / step_s)


class PositionAccuracy:
    """Estimates the standard deviation of one axis of the autopilot's own position: the value that its filter reports
    (PX4) or, without a report, the last known value with a drift of DRIFT_M_S added."""

    def __init__(self) -> None:
        self.has_position = True  # False: the filter has reported that it has none
        self._last_known: tuple[float, float] | None = None  # standard deviation, time
        self._reported: tuple[float, float] | None = None  # standard deviation that the filter reports, time
        self._ratio: tuple[float, float] | None = None  # position innovation divided by the filter's gate, time

    def handle(self, message: Message, now_s: float) -> None:
        """Process a report of the autopilot's position filter: EKF_STATUS_REPORT or ESTIMATOR_STATUS."""
        is_px4 = message.get_type() == "ESTIMATOR_STATUS"
        self._ratio = (message.pos_horiz_ratio if is_px4 else message.pos_horiz_variance), now_s
        # PX4 also sets this flag while the vehicle stands still with GPS.
        is_constant = message.flags & mavlink.EKF_CONST_POS_MODE and not is_px4
        self.has_position = bool(message.flags & _HAS_POSITION) and not is_constant
        if not self.has_position:
            self._last_known = self._reported = None  # a position is still reported, but it is outdated
        elif is_px4:
            # PX4 reports the combined value of both axes, which is a conservative value for one. 0: unknown.
            sd_m = message.pos_horiz_accuracy
            self._reported = (sd_m, now_s) if 0 < sd_m < math.inf else None

    def innovation_ratio(self, now_s: float) -> float | None:
        """Return the newest ratio of position innovation to the filter's gate; None if it is outdated."""
        return self._ratio[0] if self._ratio and now_s - self._ratio[1] <= MAX_FILTER_REPORT_AGE_S else None

    def record_accuracy(self, sd_m: float, now_s: float) -> None:
        """Record the accuracy of the position at `now_s`, from GPS or from a fix that was accepted."""
        self._last_known = sd_m, now_s

    def compute_sd_m(self, now_s: float) -> float | None:
        """Return the standard deviation in metres; None if it is unknown, or the autopilot has no position."""
        if self._reported and now_s - self._reported[1] <= MAX_FILTER_REPORT_AGE_S:
            return self._reported[0]
        return math.hypot(self._last_known[0], DRIFT_M_S * (now_s - self._last_known[1])) if self._last_known else None


class Readiness(NamedTuple):
    """An autopilot's readiness to accept a fix, as far as it is known. `has_gps`: a receiver recently had a 3D fix.
    `lacks_origin`: a request for its origin was not answered. `flags`: its filter's flags, 0 if they are outdated."""

    is_px4: bool = False
    is_armed: bool | None = None  # None: unknown
    has_gps: bool = False
    lacks_origin: bool = False
    flags: int = 0
    answers_commands: bool = False  # it answers our commands other than fixes

    @property
    def silence_reason(self) -> Reason:
        """The likely reason why the autopilot does not answer fixes."""
        return Reason(ReasonCode.FIXES_NOT_ANSWERED if self.answers_commands else ReasonCode.NO_COMMAND_ANSWERED)

    def explain(self, result: str) -> Reason:
        """Return the likely reason for an answer to a fix; `result` is the name of a MAV_RESULT."""
        rejected = ReasonCode.OTHER_AID if self.is_px4 else ReasonCode.NO_CAUSE
        codes = {
            "ACCEPTED": ReasonCode.FIX_ACCEPTED,
            "DENIED": ReasonCode.WRONG_FORM,
            "FAILED": self._explain_failure(),
            "TEMPORARILY_REJECTED": ReasonCode.GPS_IN_USE if self.has_gps else rejected,
            "UNSUPPORTED": ReasonCode.NO_COMMAND,
        }
        return Reason(codes[result]) if result in codes else Reason(ReasonCode.OTHER_ANSWER, {"result": result})

    def _explain_failure(self) -> ReasonCode:
        """Return the likely reason for the answer FAILED: the first cause that is known to apply."""
        # PX4 answers TEMPORARILY_REJECTED while it has GPS, and uses the bit of EKF_UNINITIALIZED for GPS glitches.
        if self.is_px4:
            return ReasonCode.NO_ORIGIN if self.lacks_origin else ReasonCode.NOT_PLAUSIBLE
        causes = {
            ReasonCode.NO_ORIGIN: self.lacks_origin and not self.has_gps,
            ReasonCode.NOT_STARTED: self.flags & mavlink.EKF_UNINITIALIZED,
            ReasonCode.GPS_IN_USE: self.has_gps,
            ReasonCode.NOT_ARMED: self.is_armed is False,
            ReasonCode.NO_ESTIMATE: self.flags & mavlink.EKF_CONST_POS_MODE,
        }
        return next((code for code, applies in causes.items() if applies), ReasonCode.NO_CAUSE)
