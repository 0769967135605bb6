"""The motion of a simulated vehicle: along a recorded track, or at an unknown place. Used by the simulated autopilots.
East and north are one complex number, east + 1j * north."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import moved, offset_m
from edgevpr.frames.positions import read_positions

_FASTEST_M_S = 327.0  # the largest that GLOBAL_POSITION_INT can hold


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueState:
    """The true state of the vehicle: position in degrees, `alt_m` above sea level, `height_m` above the ground,
    velocity over the ground (east + 1j * north) and climb rate upwards. Angles and height are NaN where unknown."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    height_m: float
    velocity_m_s: complex
    climb_m_s: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownTrack:
    """The path of the simulated vehicle, arrays (N,) float64: seconds from its start, degrees, metres above sea level.
    Heading, roll, pitch and height above the ground are NaN where unknown (None: everywhere)."""

    t_s: NDArray[np.float64]
    lat_deg: NDArray[np.float64]
    lon_deg: NDArray[np.float64]
    alt_m: NDArray[np.float64]
    heading_deg: NDArray[np.float64] | None = None
    roll_deg: NDArray[np.float64] | None = None
    pitch_deg: NDArray[np.float64] | None = None
    height_m: NDArray[np.float64] | None = None


class Motion:
    """A vehicle at an unknown place that obeys no command. `is_flying`: it is between take-off and landing; `is_known`:
    its position is known, and reported."""

    is_flying = True
    is_known = False

    def begin(self, now_s: float) -> None:
        """Note that at `now_s` a companion in flight was first heard."""

    def step(self, now_s: float, dt_s: float) -> TrueState:
        """Move for `dt_s` seconds, up to `now_s`, and return the state then."""
        return truth_at(_NOWHERE, 0.0)

    def land(self) -> None:
        """Land at the present place, if the vehicle obeys commands."""


class AlongTrack(Motion):
    """A vehicle that flies along a track once a companion in flight is heard, stays at its end, and obeys nothing."""

    is_known = True

    def __init__(self, track: FlownTrack) -> None:
        self._track = track
        self._start_s = math.inf

    def begin(self, now_s: float) -> None:
        self._start_s = now_s

    def step(self, now_s: float, dt_s: float) -> TrueState:
        return truth_at(self._track, max(0.0, now_s - self._start_s))


def read_track(csv_path: str | Path) -> FlownTrack:
    """Read the rows of a positions.csv with position and time, sorted by time. Raises UsageError if there are none."""
    rows = []
    for tag in read_positions(csv_path).values():
        if tag.position and tag.t_utc_s is not None:
            at = tag.position.lat_deg, tag.position.lon_deg, tag.position.alt_m or 0.0
            rows.append([tag.t_utc_s, *at, tag.heading_deg, tag.roll_deg, tag.pitch_deg, tag.height_m])
    if not rows:
        raise UsageError(f"{csv_path} has no row with lat, lon and time: a track needs them.")
    t_s, *columns = np.array(sorted(rows, key=lambda row: row[0] or 0.0), float).T
    names = ("lat_deg", "lon_deg", "alt_m", "heading_deg", "roll_deg", "pitch_deg", "height_m")
    return FlownTrack(t_s=t_s - t_s[0], **dict(zip(names, columns, strict=True)))


def truth_at(track: FlownTrack, t_s: float) -> TrueState:
    """Return the state on a track at `t_s` seconds from its start. Before and after the track the vehicle stands still.
    Height and angles are not interpolated: they are those of the point passed last."""
    leg = int(np.searchsorted(track.t_s, t_s, side="right"))  # number of the leg: it ends at the point of this index
    velocity = 0j
    if 0 < leg < len(track.t_s):
        ends = track.lat_deg[leg - 1], track.lon_deg[leg - 1], track.lat_deg[leg], track.lon_deg[leg]
        velocity = from_to(*map(float, ends)) / float(track.t_s[leg] - track.t_s[leg - 1])
        velocity = complex(*np.clip((velocity.real, velocity.imag), -_FASTEST_M_S, _FASTEST_M_S).tolist())

    def passed_last(values: NDArray[np.float64] | None) -> float:
        return math.nan if values is None else float(values[max(0, leg - 1)])

    return TrueState(
        lat_deg=float(np.interp(t_s, track.t_s, track.lat_deg)),
        lon_deg=float(np.interp(t_s, track.t_s, track.lon_deg)),
        alt_m=float(np.interp(t_s, track.t_s, track.alt_m)),
        height_m=passed_last(track.height_m),
        velocity_m_s=velocity,
        climb_m_s=0.0,
        roll_deg=passed_last(track.roll_deg),
        pitch_deg=passed_last(track.pitch_deg),
        heading_deg=passed_last(track.heading_deg),
    )


def from_to(lat_deg: float, lon_deg: float, other_lat_deg: float, other_lon_deg: float) -> complex:
    """Return the vector from one point to another, metres (east + 1j * north)."""
    east_m, north_m = offset_m(lat_deg, lon_deg, other_lat_deg, other_lon_deg)
    return complex(float(east_m), float(north_m))


def beside(lat_deg: float, lon_deg: float, step_m: complex) -> tuple[float, float]:
    """Return (latitude, longitude) at `step_m` metres (east + 1j * north) from a point: the inverse of `from_to`."""
    return moved(lat_deg, lon_deg, step_m.real, step_m.imag) if step_m else (lat_deg, lon_deg)


_NOWHERE = FlownTrack(t_s=np.zeros(1), lat_deg=np.zeros(1), lon_deg=np.zeros(1), alt_m=np.zeros(1))
