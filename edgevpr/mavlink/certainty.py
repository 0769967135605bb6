"""The certainty of the autopilot's own position: while it has GPS, and for as long as it can reckon after that."""

import math

from edgevpr.mavlink.wire import Message, mavlink

GPS_SD_M = 5.0  # of a receiver that does not say how good it is
# An ArduPilot plane, simulated, drifts at 5 m/s in a wind of 6 m/s that came with the loss of GPS: in a gale it would
# be four times as much, or four standard deviations.
DRIFT_M_S = 5.0
_FRESH_S = 3.0  # of what the filter says, which is asked for twice a second
_GPS_UNKNOWN = (0, 2**32 - 1)  # of h_acc: not sent, and not known

# ArduPilot: EKF_STATUS_REPORT. PX4: ESTIMATOR_STATUS. The flags have the same values. An ArduPilot that reckons has a
# relative position only (NavEKF3 keeps the absolute one for what it measures), counted from where it was last known.
FILTER_REPORTS = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")
_HAS_POSITION = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_POS_HORIZ_REL


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
        if self._own and now_s - self._own[1] <= _FRESH_S:
            return self._own[0]
        return self._known and math.hypot(self._known[0], DRIFT_M_S * (now_s - self._known[1]))


def gps_sd_m(message: Message) -> float:
    """Return the standard deviation of a receiver's position, metres, from a GPS_RAW_INT or a GPS2_RAW."""
    return GPS_SD_M if message.h_acc in _GPS_UNKNOWN else message.h_acc / 1e3
