"""What else is known when a query is asked: about where the aircraft is, and which way its nose points.

Both narrow the search, and neither is ever the only way: a compass may be wrong and a satellite position false, so a
query that is not accepted with hints is followed by one without.
"""

from dataclasses import dataclass

import numpy as np

from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.types import Candidate, Position

AUTOPILOT_FRESH_S = 1.0
_FIX_GOOD_FOR_S = 60.0
_HEADING_WITHIN_DEG = 22.5  # the expected one of 24 rotations, and the two beside it


@dataclass(frozen=True, slots=True)
class Sighting:
    """A position, and when it was so on the clock of the frames."""

    position: Position
    t_mono_s: float


@dataclass(frozen=True, slots=True)
class Hints:
    """The aircraft is within `radius_m` metres of `position`, and its nose points to `heading_deg`; None: not known."""

    position: Position | None = None
    radius_m: float | None = None
    heading_deg: float | None = None

    def fields(self) -> dict[str, float | bool | None]:
        """What the flight log says of hints that were used."""
        radius_m = None if self.radius_m is None else round(self.radius_m, 1)
        return {"reach_m": radius_m, "heading": self.heading_deg is not None}


def hints_of(index: PlaceIndex, around: tuple[Position, float] | None, heading_deg: float | None) -> Hints | None:
    """Those of a position with its `reach`, and of a heading, that leave something out of the search; None: neither.

    Where no place is in reach, all are searched.
    """
    if around and not 0 < np.count_nonzero(index.within(*around)) < len(index):
        around = None
    if heading_deg is not None and np.isnan(index.heading_deg).all():
        heading_deg = None
    if around is None and heading_deg is None:
        return None
    position, radius_m = around or (None, None)
    return Hints(position, radius_m, heading_deg)


def reach(
    now_s: float, autopilot: Sighting | None, own_fix: Sighting | None, reach_m_s: float, margin_m: float
) -> tuple[Position, float] | None:
    """Where the aircraft must be at `now_s`: a position, and the metres around it that it may have flown since, by the
    autopilot where it is fresh, else by our own last fix of the last minute; None where neither is there."""
    for seen, good_for_s in ((autopilot, AUTOPILOT_FRESH_S), (own_fix, _FIX_GOOD_FOR_S)):
        if seen and now_s - seen.t_mono_s <= good_for_s:
            return seen.position, margin_m + reach_m_s * abs(now_s - seen.t_mono_s)
    return None


def allowed(hints: Hints | None, index: PlaceIndex) -> np.ndarray | None:
    """The places in reach, bool (N,); None: all."""
    return index.within(hints.position, hints.radius_m) if hints and hints.position else None


def turned_deg(hints: Hints | None, index: PlaceIndex) -> np.ndarray | None:
    """How far the aircraft has turned clockwise since each place was mapped, float64 (N,), NaN for a place without a
    heading; None: nobody knows of any."""
    if hints is None or hints.heading_deg is None:
        return None
    return (hints.heading_deg - index.heading_deg.astype(float)) % 360


def agree(hints: Hints, found: Candidate) -> bool:
    """Whether a place found is one that these hints would have led to."""
    place = found.place
    if hints.position and place.position:
        here, there = hints.position, place.position
        if distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg) > hints.radius_m:
            return False
    if None in (hints.heading_deg, place.heading_deg, found.match.rotation_deg):
        return True
    off_deg = (found.match.rotation_deg - (hints.heading_deg - place.heading_deg) + 180) % 360 - 180
    return abs(off_deg) <= _HEADING_WITHIN_DEG


def use_next(hints: Hints | None, used: bool, found: Candidate | None, accepted: bool) -> bool:
    """Whether the next query is to use what hints there are, after one that had `hints` and `used` them or not.

    With and without in turn until a match is accepted; then it says whether they can be believed.
    """
    if hints is None:
        return True
    return agree(hints, found) if accepted else not used
