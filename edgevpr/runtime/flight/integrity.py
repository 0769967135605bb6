"""Check of GPS by the map: a receiver far from the positions of accepted matches is jammed, spoofed, or wrong for a
moment. `watching.GpsWatch` uses it."""

import math

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Receiver, Vehicle
from edgevpr.runtime.flight.navigation import PositionedMatch, positioned, worst_sd
from edgevpr.runtime.recognise.locate import in_sd
from edgevpr.runtime.recognise.recognition import Recognition

# In standard deviations of match and receiver together. Errors of map and receiver last for minutes, so that averaging
# does not reduce them: they are so large in one flight of 3000. With a standard deviation of 5 m for the map, the limit
# is 23 m for good matches and a good receiver.
_CONTRADICTS = 4.0
_LEAST_M = 15.0  # less is no danger, and may be a few bad seconds of the receiver
_IN_A_ROW = 3  # one match in a hundred may be wrong, and wrong ones hardly ever agree; at 1 a second it costs 3 s
_WITHIN_S = 30.0  # the matches in a row must be no older
_LED_AWAY_M_S = 10.0  # so fast the offset from GPS may change: a receiver may be led away
_TIME_SD_S = 0.1  # between a position of the receiver and a frame
_ATTITUDE_SD = math.tan(math.radians(1.0))


class Integrity:
    """Compares every accepted match with the GPS receiver. GPS `is_wrong` after three matches in a row that contradict
    it, of different places and with about the same offset from GPS; it is right again after three matches in a row that
    agree with it. `map_sd_m` is the standard deviation of the error that all matches share. `off_m` is the distance of
    the last match from GPS, metres (None: it could not be compared)."""

    def __init__(self, map_sd_m: float) -> None:
        self._map_sd_m = map_sd_m
        self._against: list[tuple[PositionedMatch, Doubles]] = []  # matches with their offset (2,) from GPS
        self._agreeing = 0
        self.is_wrong = False
        self.off_m: float | None = None

    def look(self, event: Recognition) -> str | None:
        """Compare an accepted match that has a position. Return a short text once when GPS becomes wrong or right
        again, else None."""
        seen, vehicle = positioned(event), event.vehicle
        if seen is None or vehicle is None or vehicle.gps is None or not vehicle.is_fresh_at(seen.t_s):
            self.off_m = None
            return None
        off_m, sd_m = _beside(seen, vehicle, vehicle.gps), self._sd_m(seen, vehicle, vehicle.gps)
        self.off_m = math.hypot(*off_m)
        if self.off_m <= _LEAST_M or in_sd(off_m, sd_m**2 * np.eye(2)) <= _CONTRADICTS:
            self._against.clear()
            self._agreeing += 1
            if self.is_wrong and self._agreeing >= _IN_A_ROW:
                self.is_wrong = False
                return "GPS agrees with the map again"
            return None
        self._agreeing = 0
        self._against = [
            (other, other_m)
            for other, other_m in self._against
            if seen.t_s - other.t_s <= _WITHIN_S
            and math.hypot(*(off_m - other_m)) <= 2 * math.hypot(2 * sd_m, _LED_AWAY_M_S * (seen.t_s - other.t_s))
            and not set(other.places) >= set(seen.places)
        ]
        self._against.append((seen, off_m))
        if not self.is_wrong and len(self._against) >= _IN_A_ROW:
            self.is_wrong = True
            return f"GPS is {self.off_m:.0f} m from the map's position"
        return None

    def _sd_m(self, seen: PositionedMatch, vehicle: Vehicle, gps: Receiver) -> float:
        speed_m_s = math.hypot(*vehicle.velocity_m_s) if vehicle.velocity_m_s else 0.0
        of_fix_m = worst_sd(seen.covariance_m2)
        tilt_m = _ATTITUDE_SD * (vehicle.height_m or 0.0)
        return math.hypot(of_fix_m, self._map_sd_m, gps.sd_m, tilt_m, _TIME_SD_S * speed_m_s)


def _beside(seen: PositionedMatch, vehicle: Vehicle, gps: Receiver) -> Doubles:
    """Return the offset (2,), metres east and north, from the receiver's position at the time of the frame to the
    match."""
    here = seen.position
    off_m = np.array(offset_m(gps.lat_deg, gps.lon_deg, here.lat_deg, here.lon_deg))
    flown_m: Doubles = (seen.t_s - gps.t_s) * np.array(vehicle.velocity_m_s or (0.0, 0.0))
    return off_m - flown_m
