"""Compares GPS with the matches. A wrong GPS is not used for navigation."""

import math

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_m
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.receivers import extrapolate
from edgevpr.runtime.flight.autopilot import AutopilotOutput
from edgevpr.runtime.flight.measurements import PositionedMatch, measure_for_gps
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.recognise.locate import compute_worst_sd
from edgevpr.runtime.recognise.recognition import Recognition

# In combined standard deviations of match and receiver: correct ones differ by more in one flight of 3000. Map and
# receiver errors last for minutes, so averaging does not reduce them. With a standard deviation of 5 m for the map,
# the limit is 23 m for good matches and a good receiver.
_MAX_GPS_SIGMA = 4.0
_MIN_GPS_ERROR_M = 15.0  # a smaller error is harmless, and may last only a few seconds
# Deviation from the mean offset between matches and GPS, which cancels lasting errors of map and receiver.
_MAX_MOVE_SIGMA = 3.5
_MIN_MOVE_M = 7.0
_MIN_MEAN_MATCHES = 10
_MAX_MEAN_MATCHES = 60
_MIN_MATCHES_IN_A_ROW = 3  # one match in a hundred may be wrong, and wrong ones hardly ever agree; 3 s at 1 Hz
_MAX_MATCH_AGE_S = 30.0  # of the matches in a row
_MIN_RECENT_OPPOSING = 5  # contradicting matches, with or without agreeing ones between them
_RECENT_OPPOSING_S = 20.0
_MAX_DRIFT_M_S = 10.0  # largest rate of the offset from GPS while a spoofer leads the receiver away
_REPORT_FACTOR = 2.0  # increase of the distance after which it is reported again


class GpsWatch:
    """Compares GPS with the matches. It reports when they contradict each other, whenever the distance has doubled, and
    when they agree again. Every comparison is sent to the autopilot, and navigation does not use a GPS that is wrong.

    GPS `is_wrong` after three matches in a row contradict it, at different places and with about the same offset from
    GPS; it is correct again after three matches in a row agree with it. A match contradicts GPS if its offset from GPS
    is large, or differs from the mean of earlier matches. While the aircraft hovers, the same place counts again if it
    agreed with GPS before. Intermittent jamming is detected by five contradicting matches within twenty seconds, and
    GPS stays wrong until there are fewer. `map_sd_m` is the standard deviation of the error common to all matches."""

    def __init__(self, map_sd_m: float, notifier: Notifier, autopilot: AutopilotOutput | None) -> None:
        self._map_sd_m, self._notifier, self._autopilot = map_sd_m, notifier, autopilot
        self._opposing: list[tuple[PositionedMatch, Doubles]] = []  # contradicting matches, with offsets (2,) from GPS
        self._recent_opposing: list[PositionedMatch] = []  # contradicting matches of the last seconds
        self._agreements = 0
        self._mean_error_m, self._mean_count = np.zeros(2), 0  # of the matches that agreed, and their number
        self._agreed_places: set[int] = set()  # places of the last match that agreed
        self._reported_m = math.inf  # the distance last reported
        self._have_agreed = False  # GPS and map have agreed in this flight
        self.is_wrong = False

    def reset(self) -> None:
        """Discard the offsets from GPS so far, because later matches have different errors."""
        self._opposing.clear()
        self._recent_opposing.clear()
        self._mean_error_m, self._mean_count = np.zeros(2), 0

    def update(self, event: Recognition) -> None:
        """Compare GPS with the match of an event, if that has a position."""
        vehicle = event.vehicle
        if event.view.reason or vehicle is None or vehicle.gps is None:
            return
        match = measure_for_gps(event, vehicle)
        if match is None or not vehicle.is_fresh(match.t_s):
            return
        gps_deg = extrapolate(vehicle.gps, match.t_s, vehicle.velocity_m_s or (0.0, 0.0))
        error_m = np.array(offset_m(*gps_deg, match.position.lat_deg, match.position.lon_deg))
        was_wrong, tilt_error_m = self.is_wrong, (vehicle.height_m or 0.0) * _compute_attitude_error(match)
        sd_m = math.hypot(compute_worst_sd(match.covariance_m2), vehicle.gps.sd_m, match.frame.sd_m, tilt_error_m)
        self._judge(match, error_m, sd_m)
        distance_m = math.hypot(*error_m)
        if self._autopilot:
            self._autopilot.compare_gps(distance_m, self.is_wrong, self._have_agreed)
        has_grown = self.is_wrong and distance_m > _REPORT_FACTOR * self._reported_m
        if self.is_wrong != was_wrong or has_grown:
            self._reported_m = distance_m
            severity = Severity.WARNING if self.is_wrong else Severity.INFO
            note = Reason(ReasonCode.GPS_AGREES)
            if self.is_wrong:
                note = Reason(ReasonCode.GPS_DIFFERS, {"distance_m": distance_m})
            self._notifier.report("gps", severity, note, distance_m=round(distance_m, 1), is_wrong=self.is_wrong)

    def _judge(self, match: PositionedMatch, error_m: Doubles, sd_m: float) -> None:
        """Update the verdict on GPS with a match at `error_m` (2,) metres from it. `sd_m` is the standard deviation
        of this offset, without the error common to all matches."""
        is_far = _is_beyond(error_m, _MIN_GPS_ERROR_M, _MAX_GPS_SIGMA * math.hypot(sd_m, self._map_sd_m))
        is_mean_known = self._mean_count >= _MIN_MEAN_MATCHES
        has_moved = is_mean_known and _is_beyond(error_m - self._mean_error_m, _MIN_MOVE_M, _MAX_MOVE_SIGMA * sd_m)
        self._recent_opposing = [past for past in self._recent_opposing if match.t_s - past.t_s <= _RECENT_OPPOSING_S]
        if not is_far and not has_moved:
            self._opposing.clear()
            self._agreements += 1
            self._mean_count = min(self._mean_count + 1, _MAX_MEAN_MATCHES)
            self._mean_error_m = self._mean_error_m + (error_m - self._mean_error_m) / self._mean_count
            self._agreed_places = set(match.places)
            if self._agreements >= _MIN_MATCHES_IN_A_ROW and len(self._recent_opposing) < _MIN_RECENT_OPPOSING:
                self.is_wrong, self._have_agreed = False, True
            return
        places, has_agreed = set(match.places), bool(self._agreed_places & set(match.places))

        def is_independent_of(other: PositionedMatch) -> bool:
            return has_agreed or not set(other.places) >= places

        if all(map(is_independent_of, self._recent_opposing)):
            self._recent_opposing.append(match)
        self._agreements = 0
        self._opposing = [
            (other, other_m)
            for other, other_m in self._opposing
            if match.t_s - other.t_s <= _MAX_MATCH_AGE_S
            and math.hypot(*(error_m - other_m)) <= 2 * math.hypot(2 * sd_m, _MAX_DRIFT_M_S * (match.t_s - other.t_s))
            and is_independent_of(other)
        ]
        self._opposing.append((match, error_m))
        is_proven = len(self._opposing) >= _MIN_MATCHES_IN_A_ROW or len(self._recent_opposing) >= _MIN_RECENT_OPPOSING
        self.is_wrong = self.is_wrong or is_proven


def _compute_attitude_error(match: PositionedMatch) -> float:
    """Return the tangent of the smallest attitude error that the picture of a match shows. It shifts the match from GPS
    by this fraction of the height."""
    error = match.attitude_error
    return max(0.0, math.hypot(*error.nadir_shift) - error.sd) if error else 0.0


def _is_beyond(error_m: Doubles, *limits_m: float) -> bool:
    return math.hypot(*error_m) > max(limits_m)
