"""What a continuous channel sends, and the watch that stops it: an autopilot that uses our positions follows
their errors."""

import math
from enum import Enum

from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Vehicle
from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.receivers import extrapolate

MATCH_PROOF_S = 5.0  # a match within this time proves our position
_MAX_INNOVATION_RATIO = 1.0  # innovation over the gate of the autopilot's filter
_MIN_REFUSED_S = 3.0
_MAX_ESTIMATE_ERROR_M = 15.0  # of the autopilot's estimate relative to a good receiver, or the next if larger
_MAX_ESTIMATE_ERROR_SD = 4.0
_MIN_DRIFT_OFF_S = 2.0
_MIN_STEADY_S = 3.0
INFLUENCE_S = 10.0  # our last position may affect the estimate of an autopilot with GPS for this long


class Output(Enum):
    """What is sent, with severity and text (41 bytes at most) for the ground station. RESERVE is a fallback: while GPS
    is in use, positions are sent with such a large error that the autopilot prefers its receiver."""

    STARTING = Severity.INFO, "position not known yet"
    SENDING = Severity.WARNING, "no GPS: positions are sent"
    BESIDE_GPS = Severity.INFO, "GPS in use: positions are sent too"
    RESERVE = Severity.INFO, "GPS in use: positions sent as fallback"
    GPS_BACK = Severity.INFO, "GPS is back: no positions"
    GPS_IN_USE = Severity.INFO, "GPS in use: no positions"
    UNKNOWN = Severity.WARNING, "position unknown: nothing is sent"
    CONTRADICTS_GPS = Severity.WARNING, "position contradicts GPS: nothing sent"
    LEADS_AWAY = Severity.WARNING, "autopilot drifts off GPS: nothing sent"
    REFUSED = Severity.WARNING, "autopilot refuses positions: not sent"
    NO_LENS = Severity.WARNING, "field of view unknown: nothing is sent"
    LINK_SHARED = Severity.WARNING, "two autopilots on link: nothing sent"
    PAUSED = Severity.INFO, "paused: no positions are sent"

    @property
    def is_sent(self) -> bool:
        return self in (Output.SENDING, Output.BESIDE_GPS, Output.RESERVE)

    @property
    def severity(self) -> Severity:
        return self.value[0]

    @property
    def text(self) -> str:
        return self.value[1]


class OutputWatch:
    """Stops our positions if the autopilot's filter rejects them, or if its estimate departs from a good receiver while
    they are sent, until a match or GPS proves them. `withdrawn` is the reason (None: positions may be sent)."""

    def __init__(self) -> None:
        self.withdrawn: Output | None = None
        self._withdrawn_s = -math.inf
        self._sent_s = -math.inf
        self._refused_since_s = self._drift_off_since_s = math.inf

    def record_sent(self, t_s: float) -> None:
        """Record that a position was sent at `t_s`."""
        self._sent_s = t_s

    def update(self, vehicle: Vehicle, match_s: float, has_gps: bool) -> None:
        """Process a report from the autopilot. `match_s`: time of the last fix; `has_gps`: there is a trusted one."""
        now_s = vehicle.t_received_s
        drifts_off = has_gps and _is_off_receiver(vehicle) and now_s - self._sent_s <= INFLUENCE_S
        is_over_gate = (vehicle.innovation_ratio or 0.0) > _MAX_INNOVATION_RATIO
        is_refused = is_over_gate and not has_gps and now_s - self._sent_s <= 1.0
        self._drift_off_since_s = min(self._drift_off_since_s, now_s) if drifts_off else math.inf
        self._refused_since_s = min(self._refused_since_s, now_s) if is_refused else math.inf
        is_proven = now_s - match_s <= MATCH_PROOF_S
        if now_s - self._drift_off_since_s >= _MIN_DRIFT_OFF_S and not is_proven:
            self.withdrawn, self._withdrawn_s = Output.LEADS_AWAY, now_s
        elif now_s - self._refused_since_s >= _MIN_REFUSED_S and not is_proven:
            self.withdrawn, self._withdrawn_s = Output.REFUSED, now_s
        elif match_s > self._withdrawn_s or (has_gps and not drifts_off and now_s - self._withdrawn_s > INFLUENCE_S):
            self.withdrawn = None


def _is_off_receiver(vehicle: Vehicle) -> bool:
    """Return True if the autopilot's estimate is farther from a steady receiver than the accuracy of both allows."""
    receiver = vehicle.gps
    if receiver is None or receiver.steady_for_s < _MIN_STEADY_S:
        return False
    receiver_deg = extrapolate(receiver, vehicle.t_received_s)
    error_m = float(distance_m(*receiver_deg, vehicle.lat_deg, vehicle.lon_deg))
    return error_m > max(_MAX_ESTIMATE_ERROR_M, _MAX_ESTIMATE_ERROR_SD * receiver.sd_m)
