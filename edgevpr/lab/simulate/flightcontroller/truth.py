"""The true state of the simulated vehicle. East and north are one complex number: east + 1j * north."""

from dataclasses import dataclass
from typing import Protocol

from edgevpr.core.geodesy import moved, offset_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """The vehicle as it truly is: degrees, metres above sea level and above the ground, m/s over the ground (east + 1j
    * north) and upwards. Angles are NaN where nobody knows them."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    height_m: float
    velocity_m_s: complex
    climb_m_s: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float


class Motion(Protocol):
    """The interface of what moves the vehicle. A recorded track obeys nobody."""

    @property
    def is_flying(self) -> bool:
        """True from take-off to landing."""
        ...

    @property
    def is_known(self) -> bool:
        """False where nobody knows where it flies: then no position is reported."""
        ...

    def begin(self, now_s: float) -> None:
        """Note that a flight is heard for the first time."""
        ...

    def step(self, now_s: float, dt_s: float) -> Truth:
        """Move on to `now_s`, and return where that is."""
        ...

    def take_off(self, height_m: float) -> None: ...

    def fly(self, velocity_m_s: complex, now_s: float) -> None:
        """Fly so for the next seconds, as far as the vehicle can."""
        ...

    def land(self) -> None: ...


def from_to(lat_deg: float, lon_deg: float, other_lat_deg: float, other_lon_deg: float) -> complex:
    """Return the metres from one point to another, east + 1j * north."""
    east_m, north_m = offset_m(lat_deg, lon_deg, other_lat_deg, other_lon_deg)
    return complex(float(east_m), float(north_m))


def beside(lat_deg: float, lon_deg: float, step_m: complex) -> tuple[float, float]:
    """Return the point so many metres (east + 1j * north) from a point: the reverse of `from_to`."""
    return moved(lat_deg, lon_deg, step_m.real, step_m.imag) if step_m else (lat_deg, lon_deg)
