"""Attitude, height and position accuracy of the vehicle, from the autopilot's messages of the last seconds."""

import math
from dataclasses import dataclass

from edgevpr.mavlink.wire import Message, mavlink

_KEPT_S = 3.0  # of attitudes: a frame is hardly ever older when it is recognised
_MOST_KEPT = 200
_NEAR_S = 0.3  # an attitude that is farther from the time of a frame is not used for it
_RANGE_FRESH_S = 1.0
_TERRAIN_FRESH_S = 2.5
_BAD_SIGNAL = 1  # of DISTANCE_SENSOR.signal_quality; 0 is unknown, 100 the best

GPS_SD_M = 5.0  # of a receiver that does not say how good it is
# A simulated ArduPilot plane drifts at 5 m/s in a wind of 6 m/s that came up when GPS was lost. In a gale it would be
# four times as much, or four standard deviations.
DRIFT_M_S = 5.0
_FILTER_FRESH_S = 3.0  # of the filter's report, which is requested twice a second
_GPS_UNKNOWN = (0, 2**32 - 1)  # of h_acc: not sent, and not known

GPS_REPORTS = ("GPS_RAW_INT", "GPS2_RAW")
# ArduPilot: EKF_STATUS_REPORT. PX4: ESTIMATOR_STATUS. The flags have the same values. An ArduPilot that
# dead-reckons reports only a relative position, from where it was last known (NavEKF3: absolute means measured).
FILTER_REPORTS = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")
_HAS_POSITION = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_POS_HORIZ_REL


@dataclass(frozen=True, slots=True)
class Attitude:
    """Roll (right wing down is positive), pitch (nose up) and yaw (clockwise from north) in degrees; `t_s` is when the
    message arrived."""

    t_s: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


class Attitudes:
    """The attitudes of the last three seconds. One thread adds to them, and any thread may read them."""

    def __init__(self) -> None:
        self._kept: tuple[Attitude, ...] = ()

    @property
    def t_heard_s(self) -> float:
        """The time of the newest attitude; -inf if there is none."""
        return self._kept[-1].t_s if self._kept else -math.inf

    def hear(self, message: Message, now_s: float) -> None:
        """Add the attitude of an ATTITUDE message; one that is not finite is ignored."""
        radians = message.roll, message.pitch, message.yaw
        if all(map(math.isfinite, radians)):
            kept = [attitude for attitude in self._kept[1 - _MOST_KEPT :] if now_s - attitude.t_s <= _KEPT_S]
            self._kept = (*kept, Attitude(now_s, *map(math.degrees, radians)))

    def at(self, t_s: float) -> Attitude | None:
        """Return the attitude at `t_s`, interpolated between those received before and after. With only one of them
        within 0.3 s, return that one; None with neither."""
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
    """The height above the ground, from the best source that is recent: a range finder that looks down, else the
    autopilot's model of the terrain, else the height over the take-off point."""

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None  # metres, time
        self._terrain: tuple[float, float] | None = None

    def hear(self, message: Message, now_s: float, attitude: Attitude | None) -> None:
        """Process a DISTANCE_SENSOR or TERRAIN_REPORT. The slanted distance of a range finder becomes a height by the
        current `attitude` (None: unknown)."""
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
        """Return the height above the ground in metres, by the best recent source. Without one, return
        `over_takeoff_m`, the height over the take-off point."""
        for measured, good_for_s in ((self._range, _RANGE_FRESH_S), (self._terrain, _TERRAIN_FRESH_S)):
            if measured and now_s - measured[1] <= good_for_s and math.isfinite(measured[0]):
                return measured[0]
        return over_takeoff_m


class Certainty:
    """Estimates how accurate the autopilot's own position is, as the standard deviation of one axis: the value that its
    position filter reports (PX4) or, without one, that of the last known position (by GPS or an accepted fix of ours),
    which grows by DRIFT_M_S a second."""

    def __init__(self) -> None:
        self._known: tuple[float, float] | None = None  # standard deviation, time
        self._own: tuple[float, float] | None = None  # standard deviation that the filter reports, time

    def hear(self, message: Message, now_s: float) -> None:
        """Process a report of the autopilot's position filter, one of the `FILTER_REPORTS`."""
        if message.flags & mavlink.EKF_CONST_POS_MODE or not message.flags & _HAS_POSITION:
            self._known = self._own = None  # the position is still reported, but is an old one
        elif message.get_type() == "ESTIMATOR_STATUS":
            # PX4 reports that of both axes together, larger than that of one: a cautious value. 0: it has none.
            sd_m = message.pos_horiz_accuracy
            self._own = (sd_m, now_s) if 0 < sd_m < math.inf else None

    def note_known(self, sd_m: float, now_s: float) -> None:
        """Note that at `now_s` the position is known with this standard deviation of one axis."""
        self._known = sd_m, now_s

    def now(self, now_s: float) -> float | None:
        """Return the standard deviation in metres; None if it is unknown, or the autopilot has no position."""
        if self._own and now_s - self._own[1] <= _FILTER_FRESH_S:
            return self._own[0]
        return math.hypot(self._known[0], DRIFT_M_S * (now_s - self._known[1])) if self._known else None


def gps_sd_m(message: Message) -> float:
    """Return the standard deviation in metres of a GPS receiver's position, from one of the `GPS_REPORTS`."""
    return GPS_SD_M if message.h_acc in _GPS_UNKNOWN else float(message.h_acc / 1e3)
