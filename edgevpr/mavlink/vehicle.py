"""Attitude, height and certainty of the vehicle, from what the autopilot says: at any moment of the last seconds."""

import math
from dataclasses import dataclass

from edgevpr.mavlink.wire import Message, mavlink

_KEPT_S = 3.0  # of attitudes: a frame is hardly ever older when it is recognised
_MOST_KEPT = 200
_NEAR_S = 0.3  # an attitude that is farther from a frame's time says nothing of the frame
_RANGE_FRESH_S = 1.0
_TERRAIN_FRESH_S = 2.5
_BAD_SIGNAL = 1  # of DISTANCE_SENSOR.signal_quality; 0 is unknown, 100 the best

GPS_SD_M = 5.0  # of a receiver that does not say how good it is
# An ArduPilot plane, simulated, drifts at 5 m/s in a wind of 6 m/s that came with the loss of GPS: in a gale it would
# be four times as much, or four standard deviations.
DRIFT_M_S = 5.0
_FILTER_FRESH_S = 3.0  # of what the filter says, which is asked for twice a second
_GPS_UNKNOWN = (0, 2**32 - 1)  # of h_acc: not sent, and not known

GPS_REPORTS = ("GPS_RAW_INT", "GPS2_RAW")
HEIGHT_REPORTS = ("DISTANCE_SENSOR", "TERRAIN_REPORT")
# ArduPilot: EKF_STATUS_REPORT. PX4: ESTIMATOR_STATUS. The flags have the same values. An ArduPilot that reckons has a
# relative position only (NavEKF3 keeps the absolute one for what it measures), counted from where it was last known.
FILTER_REPORTS = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")
_HAS_POSITION = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_POS_HORIZ_REL


@dataclass(frozen=True, slots=True)
class Attitude:
    """Roll (right wing down is positive), pitch (nose up) and yaw (clockwise from north), heard at `t_s`; degrees."""

    t_s: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


class Attitudes:
    """The attitudes of the last seconds. One thread adds to them, and any may ask."""

    def __init__(self) -> None:
        self._kept: tuple[Attitude, ...] = ()

    @property
    def t_heard_s(self) -> float:
        """Time of the newest, -inf where there is none."""
        return self._kept[-1].t_s if self._kept else -math.inf

    def hear(self, message: Message, now_s: float) -> None:
        """Take in an ATTITUDE; one that is not finite is left out."""
        radians = message.roll, message.pitch, message.yaw
        if all(map(math.isfinite, radians)):
            kept = [attitude for attitude in self._kept[1 - _MOST_KEPT :] if now_s - attitude.t_s <= _KEPT_S]
            self._kept = (*kept, Attitude(now_s, *map(math.degrees, radians)))

    def at(self, t_s: float) -> Attitude | None:
        """Return the attitude at a time, from those heard before and after it; None where neither is within 0.3 s."""
        near = [attitude for attitude in self._kept if abs(attitude.t_s - t_s) <= _NEAR_S]
        before = next((attitude for attitude in reversed(near) if attitude.t_s <= t_s), None)
        after = next((attitude for attitude in near if attitude.t_s > t_s), None)
        if before is None or after is None:
            return before or after
        share = (t_s - before.t_s) / (after.t_s - before.t_s)

        def between(one_deg: float, other_deg: float) -> float:
            return one_deg + share * ((other_deg - one_deg + 180) % 360 - 180)

        return Attitude(
            t_s,
            between(before.roll_deg, after.roll_deg),
            between(before.pitch_deg, after.pitch_deg),
            between(before.yaw_deg, after.yaw_deg),
        )


class Heights:
    """The height above the ground, from the best of what the autopilot says: a range finder that looks down, then its
    model of the terrain, then the height over the take-off point."""

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None  # metres, time
        self._terrain: tuple[float, float] | None = None

    def hear(self, message: Message, now_s: float, attitude: Attitude | None) -> None:
        """Take in one of the `HEIGHT_REPORTS`; `attitude` is that of now: a range finder looks along it."""
        if message.get_type() == "TERRAIN_REPORT":
            # A spacing of 0 says that the autopilot has no terrain of this place.
            self._terrain = (message.current_height, now_s) if message.spacing else None
        elif message.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270:
            in_range = message.min_distance < message.current_distance < message.max_distance
            is_good = in_range and message.signal_quality != _BAD_SIGNAL
            lean = 1.0
            if attitude:
                lean = math.cos(math.radians(attitude.roll_deg)) * math.cos(math.radians(attitude.pitch_deg))
            self._range = (message.current_distance / 100 * max(0.0, lean), now_s) if is_good else None

    def now(self, over_takeoff_m: float, now_s: float) -> float:
        """Return the height, metres; `over_takeoff_m` is that over the take-off point."""
        for measured, good_for_s in ((self._range, _RANGE_FRESH_S), (self._terrain, _TERRAIN_FRESH_S)):
            if measured and now_s - measured[1] <= good_for_s and math.isfinite(measured[0]):
                return measured[0]
        return over_takeoff_m


class Certainty:
    """The standard deviation of one axis of the autopilot's own position: of its filter where that says so (PX4), else
    that of when the position was last known, by GPS or by a fix of ours that it took, and its drift since."""

    def __init__(self) -> None:
        self._known: tuple[float, float] | None = None  # standard deviation, time
        self._own: tuple[float, float] | None = None  # the same, as the filter says it

    def hear(self, message: Message, now_s: float) -> None:
        """Take in one of the `FILTER_REPORTS`."""
        if message.flags & mavlink.EKF_CONST_POS_MODE or not message.flags & _HAS_POSITION:
            self._known = self._own = None  # it goes on to report a position, but an old one
        elif message.get_type() == "ESTIMATOR_STATUS":
            # That of both axes together: of one it is less, so this is careful. 0: PX4 has none.
            sd_m = message.pos_horiz_accuracy
            self._own = (sd_m, now_s) if 0 < sd_m < math.inf else None

    def note_known(self, sd_m: float, now_s: float) -> None:
        """Note that at this time the position is known with this standard deviation of one axis."""
        self._known = sd_m, now_s

    def now(self, now_s: float) -> float | None:
        """Return the standard deviation, metres; None where it is unknown, or there is no position."""
        if self._own and now_s - self._own[1] <= _FILTER_FRESH_S:
            return self._own[0]
        return math.hypot(self._known[0], DRIFT_M_S * (now_s - self._known[1])) if self._known else None


def gps_sd_m(message: Message) -> float:
    """Return the standard deviation of a receiver's position, metres, from one of the `GPS_REPORTS`."""
    return GPS_SD_M if message.h_acc in _GPS_UNKNOWN else float(message.h_acc / 1e3)
