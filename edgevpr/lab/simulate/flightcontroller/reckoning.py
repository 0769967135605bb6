"""The estimate of the position, as its error against the truth. East and north are one complex number."""

import math

from edgevpr.lab.simulate.flightcontroller.receivers import Measurement
from edgevpr.lab.simulate.flightcontroller.truth import Truth, beside, from_to

_TAKEN = 0.3  # of an innovation, by each measurement
_LEAST_SD_M = 0.3


class Reckoning:
    """Metres by which the estimate is off, how fast that grows, and the standard deviation that the estimator gives
    itself."""

    def __init__(self) -> None:
        self.error_m = 0j
        self.drift_m_s = 0j
        self.sd_m = _LEAST_SD_M

    def step(self, dt_s: float, sd_m_s: float) -> None:
        """Reckon on for a while, in which the standard deviation grows by so much a second."""
        self.error_m += self.drift_m_s * dt_s
        self.sd_m += sd_m_s * dt_s

    def place(self, truth: Truth) -> tuple[float, float]:
        """Return the estimated latitude and longitude, degrees."""
        return beside(truth.lat_deg, truth.lon_deg, self.error_m)

    def velocity_m_s(self, truth: Truth) -> complex:
        """Return the estimated velocity."""
        return truth.velocity_m_s + self.drift_m_s

    def innovation_m(self, truth: Truth, lat_deg: float, lon_deg: float) -> complex:
        """Return the step from the estimate to a point."""
        return from_to(truth.lat_deg, truth.lon_deg, lat_deg, lon_deg) - self.error_m

    def test_ratio(self, truth: Truth, measured: Measurement, gate_sd: float) -> float:
        """Return how far off a measurement is, as a share of what the gate lets pass."""
        away_m = abs(self.innovation_m(truth, measured.lat_deg, measured.lon_deg))
        return away_m / (gate_sd * math.hypot(self.sd_m, measured.sd_m))

    def fuse(self, truth: Truth, measured: Measurement) -> None:
        """Follow a measurement; velocities are right from then on."""
        self.error_m += _TAKEN * self.innovation_m(truth, measured.lat_deg, measured.lon_deg)
        self.drift_m_s = 0j
        self.sd_m = max(_LEAST_SD_M, min(self.sd_m, measured.sd_m))

    def reset_to(self, truth: Truth, lat_deg: float, lon_deg: float, sd_m: float) -> None:
        """Be at a point from now on."""
        self.error_m += self.innovation_m(truth, lat_deg, lon_deg)
        self.sd_m = max(_LEAST_SD_M, sd_m)
