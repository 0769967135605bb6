"""What else is known when a query is asked: about where the aircraft is, and which way its nose points.

Both narrow the search, and neither is ever the only way: a compass may be wrong and a satellite position false, so a
query that is not accepted with hints is followed by one without.
"""

from dataclasses import dataclass

from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.places.retrieve import Expected
from edgevpr.types import Candidate, Frame, Position, Vehicle

_FIX_GOOD_FOR_S = 60.0


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
        """Say what the flight log says of hints that were used."""
        radius_m = None if self.radius_m is None else round(self.radius_m, 1)
        return {"reach_m": radius_m, "heading": self.heading_deg is not None}


class NoPrior:
    """Nothing is known beforehand: what a `Prior` is where no query is to be narrowed."""

    def hints(self, frame: Frame, vehicle: Vehicle | None, index: PlaceIndex, margin_m: float) -> Hints | None:
        """Give nothing."""

    def learn(self, found: Candidate, accepted: bool, t_mono_s: float) -> None:
        """Learn nothing."""


class Prior:
    """What narrows the search for the next query, and whether it can be believed.

    `reach_m_s` is the speed that the aircraft can have (None: its position narrows nothing), `heading_within_deg` how
    far off a known heading may be (None: no heading narrows anything; see `TechniqueSpec`). `is_live` is whether the
    frames are of now: the autopilot knows nothing of frames that are a recording.
    """

    def __init__(self, reach_m_s: float | None, heading_within_deg: float | None, is_live: bool) -> None:
        self._reach_m_s, self._heading_within_deg, self._is_live = reach_m_s, heading_within_deg, is_live
        self._last_fix: Sighting | None = None
        self._known: Hints | None = None
        self._believed = True

    def hints(self, frame: Frame, vehicle: Vehicle | None, index: PlaceIndex, margin_m: float) -> Hints | None:
        """Give what narrows the search for a frame, None where nothing does or it is not believed at present.

        `vehicle` is what the autopilot says; `margin_m` is added to how far the aircraft can have flown.
        """
        if not self._is_live or (vehicle and not vehicle.is_fresh_at(frame.t_mono_s)):
            vehicle = None
        around = heading_deg = None
        if self._reach_m_s:
            around = reach(frame.t_mono_s, vehicle, self._last_fix, self._reach_m_s, margin_m)
        if self._heading_within_deg is not None:
            heading_deg = vehicle.heading_deg if frame.heading_deg is None and vehicle else frame.heading_deg
        self._known = hints_of(index, around, heading_deg)
        return self._known if self._believed else None

    def learn(self, found: Candidate, accepted: bool, t_mono_s: float) -> None:
        """Learn from what the query found, whether hints are to be used for the next."""
        self._believed = use_next(self._known, self._believed, found, accepted, self._heading_within_deg)
        if accepted and found.place.position:
            self._last_fix = Sighting(found.place.position, t_mono_s)


def hints_of(index: PlaceIndex, around: tuple[Position, float] | None, heading_deg: float | None) -> Hints | None:
    """Give those of a position with its `reach`, and of a heading, that leave something out of the search; None:
    neither.

    Where no place is in reach, all are searched.
    """
    if around and not 0 < index.within(*around).sum() < len(index):
        around = None
    if heading_deg is not None and not index.knows_headings:
        heading_deg = None
    if around is None and heading_deg is None:
        return None
    position, radius_m = around or (None, None)
    return Hints(position, radius_m, heading_deg)


def reach(
    now_s: float, vehicle: Vehicle | None, own_fix: Sighting | None, reach_m_s: float, margin_m: float
) -> tuple[Position, float] | None:
    """Say where the aircraft must be at `now_s`: a position, and the metres around it that it may have flown since, by
    an autopilot that has GPS and has just said so, else by our own last fix of the last minute; None where neither is
    there."""
    seen = None
    if own_fix and now_s - own_fix.t_mono_s <= _FIX_GOOD_FOR_S:
        seen = own_fix
    if vehicle and vehicle.has_gps and vehicle.is_fresh_at(now_s):  # without GPS it drifts, and our own fix says more
        seen = Sighting(Position(vehicle.lat_deg, vehicle.lon_deg), vehicle.t_heard_s)
    return seen and (seen.position, margin_m + reach_m_s * abs(now_s - seen.t_mono_s))


def expected_of(hints: Hints | None, index: PlaceIndex) -> Expected:
    """Say what hints mean for every place of the index."""
    if hints is None:
        return Expected()
    in_reach = index.within(hints.position, hints.radius_m) if hints.position else None
    turned_deg = None
    if hints.heading_deg is not None:
        turned_deg = (hints.heading_deg - index.heading_deg.astype(float)) % 360
    return Expected(in_reach, turned_deg)


def agree(hints: Hints, found: Candidate, heading_within_deg: float | None) -> bool:
    """Say whether a place found is one that these hints would have led to."""
    place = found.place
    if hints.position and place.position:
        here, there = hints.position, place.position
        if distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg) > hints.radius_m:
            return False
    if None in (hints.heading_deg, place.heading_deg, found.match.rotation_deg, heading_within_deg):
        return True
    off_deg = (found.match.rotation_deg - (hints.heading_deg - place.heading_deg) + 180) % 360 - 180
    return abs(off_deg) <= heading_within_deg


def use_next(
    hints: Hints | None, used: bool, found: Candidate | None, accepted: bool, heading_within_deg: float | None
) -> bool:
    """Say whether the next query is to use what hints there are, after one that had `hints` and `used` them or not.

    With and without in turn until a match is accepted; then it says whether they can be believed.
    """
    if hints is None:
        return True
    return agree(hints, found, heading_within_deg) if accepted else not used
