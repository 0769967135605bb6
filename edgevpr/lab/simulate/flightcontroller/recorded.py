"""A vehicle that flies along a recorded track, and one of which nobody knows where it flies."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate.flightcontroller.truth import Truth, from_to

_FASTEST_M_S = 327.0  # that the message can say


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """Path of the simulated vehicle: seconds from its start on, degrees, metres above sea level, each (N,) float64;
    heading, roll, pitch and height above the ground are NaN where unknown (None: everywhere)."""

    t_s: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    alt_m: np.ndarray
    heading_deg: np.ndarray
    roll_deg: np.ndarray | None = None
    pitch_deg: np.ndarray | None = None
    height_m: np.ndarray | None = None


def read_track(csv_path: str | Path) -> Track:
    """Read the rows of a positions.csv that have a position and a time, in the order of time. Raises UsageError where
    there are none."""
    tags = [tag for tag in read_positions(csv_path).values() if tag.position and tag.t_utc_s is not None]
    if not tags:
        raise UsageError(f"{csv_path} has no row with lat, lon and time: a track needs them.")
    tags.sort(key=lambda tag: tag.t_utc_s)
    start_s = tags[0].t_utc_s
    columns = {
        "t_s": [tag.t_utc_s - start_s for tag in tags],
        "lat_deg": [tag.position.lat_deg for tag in tags],
        "lon_deg": [tag.position.lon_deg for tag in tags],
        "alt_m": [tag.position.alt_m or 0.0 for tag in tags],
        **{name: [getattr(tag, name) for tag in tags] for name in ("heading_deg", "roll_deg", "pitch_deg", "height_m")},
    }
    return Track(**{name: np.array(column, float) for name, column in columns.items()})


class AlongTrack:
    """Flies along a track from the moment a flight is first heard, stays where it ends, and obeys nobody."""

    is_flying = is_known = True

    def __init__(self, track: Track) -> None:
        self._track = track
        self._start_s: float | None = None

    def begin(self, now_s: float) -> None:
        """Start the flight along the track."""
        self._start_s = now_s

    def step(self, now_s: float, dt_s: float) -> Truth:
        """Return the point of the track that belongs to `now_s`."""
        return truth_at(self._track, 0.0 if self._start_s is None else now_s - self._start_s)

    def take_off(self, height_m: float) -> None:
        """Do nothing."""

    def fly(self, velocity_m_s: complex, now_s: float) -> None:
        """Do nothing."""

    def land(self) -> None:
        """Do nothing."""


class Nowhere(AlongTrack):
    """Flies at a place that is never told."""

    is_known = False

    def __init__(self) -> None:
        unknown = np.array([math.nan])
        at = np.array([0.0])
        super().__init__(Track(t_s=at, lat_deg=at, lon_deg=at, alt_m=at, heading_deg=unknown))


def truth_at(track: Track, t_s: float) -> Truth:
    """Return the point of a track at a time, seconds from its start on. Outside the track the vehicle stands."""
    lat_deg, lon_deg, alt_m = (
        float(np.interp(t_s, track.t_s, each)) for each in (track.lat_deg, track.lon_deg, track.alt_m)
    )
    return Truth(
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_m=alt_m,
        height_m=_last(track, track.height_m, t_s),
        velocity_m_s=_velocity_m_s(track, t_s),
        climb_m_s=0.0,
        roll_deg=_last(track, track.roll_deg, t_s),
        pitch_deg=_last(track, track.pitch_deg, t_s),
        heading_deg=_last(track, track.heading_deg, t_s),
    )


def _velocity_m_s(track: Track, t_s: float) -> complex:
    """Return the velocity on the leg that is being flown."""
    leg = int(np.searchsorted(track.t_s, t_s, side="right"))
    if not 0 < leg < len(track.t_s):
        return 0j
    (lat_deg, to_lat_deg), (lon_deg, to_lon_deg) = track.lat_deg[leg - 1 : leg + 1], track.lon_deg[leg - 1 : leg + 1]
    velocity = from_to(lat_deg, lon_deg, to_lat_deg, to_lon_deg) / float(track.t_s[leg] - track.t_s[leg - 1])
    east_m_s, north_m_s = np.clip((velocity.real, velocity.imag), -_FASTEST_M_S, _FASTEST_M_S).tolist()
    return complex(east_m_s, north_m_s)


def _last(track: Track, values: np.ndarray | None, t_s: float) -> float:
    """Return the value at the point of the track that was passed last, NaN where it is unknown."""
    if values is None:
        return math.nan
    return float(values[max(0, np.searchsorted(track.t_s, t_s, side="right") - 1)])
