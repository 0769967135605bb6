"""Hints narrow the search of the map for a query: where the aircraft can be, its heading, and its height.

In flight, finding a place never depends on hints alone: a compass may be wrong, and GPS may be spoofed. So a query that
is not accepted with hints is followed by one without (`Prior`). Recorded queries are evaluated one by one, each with
its own known data (`RecordedPrior`)."""

import math
import statistics
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from edgevpr.core.contract import find_nearest_height
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m, wrap_deg
from edgevpr.core.types import Candidate, Frame, Place, Position, Vehicle
from edgevpr.frames.positions import GeoTag
from edgevpr.places.index import PlaceIndex
from edgevpr.places.layers import Layers
from edgevpr.places.retrieve import Expectation
from edgevpr.runtime.recognise.hypotheses import DEFAULT_MAX_SPEED_M_S
from edgevpr.runtime.recognise.locate import Located

KNOWN_FIELDS = ("heading", "height", "reach")  # data that a recorded query may have
RECORDED_REACH_M = 300.0  # distance that an aircraft flies in 15 s at 20 m/s
_MAX_FIX_AGE_S = 60.0
_TRUST_ALL = (True, True)
_SCALE_ERROR = 1.08  # two heights whose ratio is larger differ by more than the error of a match
_MIN_SCALE = 0.5
_MIN_HEIGHTS = 3  # matches needed to confirm a small error of the recorded heights
_MAX_HEIGHTS = 5  # number of newest matches whose heights are compared with the recorded ones
# The place filter narrows the search if its position has at least this probability. The area is large enough to contain
# rivals of the best place: its radius is at least that of recorded queries, and at least this many search margins.
_MIN_MASS = 0.99
_AREA_SD = 4.0
_AREA_MARGINS = 5.0
# Tag field and positions.csv columns required by each known field. If no height is recorded, the map's is used.
_REQUIRED_FIELDS = {"heading": ("heading_deg", "yaw_deg"), "reach": ("position", "lat and lon")}


@dataclass(frozen=True, slots=True)
class Reach:
    """Area that contains the aircraft: within `radius_m` metres of `position`."""

    position: Position
    radius_m: float


@dataclass(frozen=True, slots=True)
class Hints:
    """Hints for one query: the area that contains the aircraft, and its heading in degrees. None: unknown."""

    reach: Reach | None = None
    heading_deg: float | None = None

    def fields(self) -> dict[str, float | bool | None]:
        """Return the fields of the flight log: radius of the area (None: unknown), and whether a heading is known."""
        radius_m = round(self.reach.radius_m, 1) if self.reach else None
        return {"reach_m": radius_m, "heading": self.heading_deg is not None}

    def agree_with(self, match: Candidate, heading_within_deg: float | None) -> tuple[bool, bool]:
        """Return whether a match agrees with the area and whether it agrees with the heading; True if either is
        unknown. `heading_within_deg` is the largest heading error (None: headings are not compared)."""
        place, rotation_deg = match.place, match.match.rotation_deg
        in_reach = heading_agrees = True
        if self.reach and place.position:
            centre, position = self.reach.position, place.position
            error_m = distance_m(centre.lat_deg, centre.lon_deg, position.lat_deg, position.lon_deg)
            in_reach = bool(error_m <= self.reach.radius_m)
        if self.heading_deg is not None and place.heading_deg is not None and rotation_deg is not None:
            error_deg = wrap_deg(rotation_deg - (self.heading_deg - place.heading_deg))
            heading_agrees = heading_within_deg is None or abs(error_deg) <= heading_within_deg
        return in_reach, heading_agrees

    def select(self, trusts_reach: bool, trusts_heading: bool) -> "Hints | None":
        """Return only the trusted hints; None if there are none."""
        reach, heading_deg = self.reach if trusts_reach else None, self.heading_deg if trusts_heading else None
        return None if reach is None and heading_deg is None else Hints(reach, heading_deg)


class RecordedPrior:
    """Makes the hints for each recorded query from its own frame. `known`: the members of `KNOWN_FIELDS` to use if a
    frame has them. For the other attributes see `Prior`. `map_height_m` is the height from which the map was made
    (None: it or the height of the queries is unknown; `height` then means the map's).

    Earlier queries only correct heights: all recorded heights may be wrong by the same factor, because of a
    barometer over sloping ground or a wrong field of view. Until matches have confirmed them, all heights are searched.
    """

    def __init__(
        self, known: Collection[str] = (), heading_within_deg: float | None = None, map_height_m: float | None = None
    ) -> None:
        self._known, self._heading_within_deg, self._map_height_m = known, heading_within_deg, map_height_m
        self._expects_height = False
        self._height_errors: deque[float] = deque(maxlen=_MAX_HEIGHTS)
        self.footprint_m: float | None = None
        self.height_ratio = 1.0
        self.searches_heights = True

    def make_hints(self, frame: Frame, vehicle: Vehicle | None, index: PlaceIndex, margin_m: float) -> Hints | None:
        """Return the hints for a frame; `vehicle` and `margin_m` are used only in a flight (`Prior`)."""
        ratio: float | None = self._height_error
        if self._map_height_m is not None:
            recorded_m = frame.height_m if frame.height_m and frame.height_m > 0 else None
            ratio = recorded_m and self._height_error * recorded_m / self._map_height_m
        self._expects_height = "height" in self._known and ratio is not None
        self.searches_heights = not (self._expects_height and len(self._height_errors) >= _MIN_HEIGHTS)
        self.height_ratio = ratio if self._expects_height and ratio else self.scale(())
        uses_heading = "heading" in self._known and self._heading_within_deg is not None
        reach = Reach(frame.position, RECORDED_REACH_M) if "reach" in self._known and frame.position else None
        return _drop_useless(reach, frame.heading_deg if uses_heading else None, index)

    @property
    def _height_error(self) -> float:
        """Median ratio of the heights of the last matches to the recorded ones; 1.0 if they are about equal."""
        error = statistics.median(self._height_errors) if self._height_errors else 1.0
        # The height of one match may be wrong by 8 %, so a few matches correct only a clear error.
        tolerance = _SCALE_ERROR if len(self._height_errors) >= _MIN_HEIGHTS else _SCALE_ERROR**2
        return error if abs(math.log(error)) > math.log(tolerance) else 1.0

    def scale(self, height_ratios: Sequence[float]) -> float:
        """Return the ratio of the ground that a picture shows to the ground expected at its recorded height."""
        return self._height_error if self._map_height_m is None else 1.0

    def update(
        self,
        match: Candidate,
        accepted: bool,
        t_mono_s: float,
        scale: float = 1.0,
        footprint_m: float | None = None,
        layers: Layers | None = None,
    ) -> None:
        """Store the error of the recorded height, from an accepted match. For the arguments see `Prior.update`."""
        ratio, pose = match.match.height_ratio, match.place.pose
        if not (accepted and ratio):
            return
        if footprint_m:
            self._height_errors.append(scale * ratio * (pose.footprint_m / footprint_m if pose else 1.0))
        elif self._expects_height and self._map_height_m is not None:
            self._height_errors.append(self._height_error * ratio / self.height_ratio)

    def update_area(self, estimate: Located | None, mass: float, t_mono_s: float) -> None:
        """Do nothing: recorded queries are independent of each other."""


class Prior(RecordedPrior):
    """Makes the hints for each query of a flight, and decides whether to trust them.

    `height_ratio` is the height of the camera relative to that of the map's pictures, from the last accepted match; if
    pictures are scaled by known heights, it is the error of these heights. `footprint_m` is the footprint of the layer
    of the last match (None: unknown, or computed from its height); the height ratio is relative to it.
    `searches_heights`: also search at other heights if a query is not accepted. `max_speed_m_s` is that of the aircraft
    (None: positions are not hints), `heading_within_deg` the largest error of a known heading (None: nor are headings).
    `is_live` is False for recorded frames, for which the autopilot's reports do not apply."""

    def __init__(self, max_speed_m_s: float | None, heading_within_deg: float | None, is_live: bool) -> None:
        super().__init__((), heading_within_deg)
        self._max_speed_m_s, self._is_live = max_speed_m_s, is_live
        self._uses_hints = True
        self._trusted = _TRUST_ALL  # area and heading, according to the last accepted match
        self._last_fix: tuple[Position, float] | None = None  # with its time
        self._estimate: tuple[Reach, float] | None = None  # of the place filter, with its time
        self._all_hints: Hints | None = None

    def make_hints(self, frame: Frame, vehicle: Vehicle | None, index: PlaceIndex, margin_m: float) -> Hints | None:
        """Return the hints for a frame; None if there are none, or if hints are not trusted now.

        `vehicle` is the autopilot's last report. The radius of the area (`reach`) is the farthest that the aircraft can
        have flown plus `margin_m`. Its centre is the autopilot's position if that has GPS (without GPS it drifts, and
        our own fix is better), or else our last fix if at most a minute old. If no maximum speed is set, the area is
        around the position from the place filter, if that is certain."""
        if not self._is_live or (vehicle and not vehicle.is_fresh(frame.t_mono_s)):
            vehicle = None
        start, reach = self._last_fix, None
        if vehicle and vehicle.has_gps:
            start = Position(vehicle.lat_deg, vehicle.lon_deg), vehicle.t_received_s
        elif start and frame.t_mono_s - start[1] > _MAX_FIX_AGE_S:
            start = None
        if start and self._max_speed_m_s:
            reach = Reach(start[0], margin_m + self._max_speed_m_s * abs(frame.t_mono_s - start[1]))
        if self._estimate and self._max_speed_m_s is None:
            area, t_s = self._estimate
            if (age_s := abs(frame.t_mono_s - t_s)) <= _MAX_FIX_AGE_S:
                min_radius_m = max(RECORDED_REACH_M, _AREA_MARGINS * margin_m)
                reach = Reach(area.position, min_radius_m + area.radius_m + DEFAULT_MAX_SPEED_M_S * age_s)
        heading_deg = vehicle.heading_deg if frame.heading_deg is None and vehicle else frame.heading_deg
        self._all_hints = _drop_useless(reach, None if self._heading_within_deg is None else heading_deg, index)
        return self._all_hints.select(*self._trusted) if self._all_hints and self._uses_hints else None

    def scale(self, height_ratios: Sequence[float]) -> float:
        """Return the factor that scales the next picture as if it were taken at one of the `height_ratios`, because
        fewer matches are found between them. A picture from higher up is scaled to the nearest, to keep its edges."""
        ratio = self.height_ratio
        if not height_ratios or abs(math.log(ratio)) <= math.log(_SCALE_ERROR):
            return 1.0
        return max(ratio, _MIN_SCALE) if ratio < 1 else ratio / find_nearest_height(height_ratios, ratio)

    def update(
        self,
        match: Candidate,
        accepted: bool,
        t_mono_s: float,
        scale: float = 1.0,
        footprint_m: float | None = None,
        layers: Layers | None = None,
    ) -> None:
        """Store position and height of an accepted match; the next query uses the hints that agree with it. Until
        there is one, queries with and without hints alternate. The query's picture was enlarged by `scale`, so at its
        height it shows `footprint_m` of ground (None: the height is unknown). `layers` are those of the map (None: it
        has one)."""
        # Outside the map, only every second query is searched at all heights, because this takes twice as long.
        self.searches_heights = accepted or not self.searches_heights
        if self._all_hints is None:
            self._uses_hints, self._trusted = True, _TRUST_ALL
        elif accepted:
            self._trusted = self._all_hints.agree_with(match, self._heading_within_deg)
            self._uses_hints = any(self._trusted)
        else:
            self._uses_hints = not self._uses_hints
            self._trusted = self._trusted if any(self._trusted) else _TRUST_ALL
        if not accepted:
            return
        if match.match.height_ratio:
            height_ratio, layer_m = scale * match.match.height_ratio, self.footprint_m
            if layers and len(layers.footprints_m) > 1 and match.place.pose:
                matched_m = height_ratio * match.place.pose.footprint_m
                layer_m = footprint_m or layers.choose_footprint(matched_m)
                height_ratio = matched_m / (layer_m or matched_m)
            if layer_m != self.footprint_m or abs(math.log(height_ratio / self.height_ratio)) > math.log(_SCALE_ERROR):
                self.footprint_m, self.height_ratio = layer_m, height_ratio
        if match.place.position:
            self._last_fix = match.place.position, t_mono_s

    def update_area(self, estimate: Located | None, mass: float, t_mono_s: float) -> None:
        """Store the position from the place filter (None: unknown), with the probability `mass` that the aircraft is
        near it. It is used until the next probable position, or for a minute."""
        if estimate and mass >= _MIN_MASS:
            east_m2, _, north_m2 = estimate.covariance_m2
            self._estimate = Reach(estimate.position, _AREA_SD * math.sqrt(east_m2 + north_m2)), t_mono_s


def parse_known_fields(text: str | None) -> tuple[str, ...]:
    """Parse a list such as "height,heading" into members of `KNOWN_FIELDS`, in their order (None: no members). Raises
    UsageError for any other text."""
    names = [] if text is None else [name.strip() for name in text.split(",")]
    if unknown := [name for name in names if name not in KNOWN_FIELDS]:
        raise UsageError(f"`known` contains `{unknown[0]}`, but must be a list of {', '.join(KNOWN_FIELDS)}.")
    return tuple(name for name in KNOWN_FIELDS if name in names)


def explain_why_unusable(
    known: Collection[str], queries: Collection[GeoTag], places: Collection[GeoTag] | Collection[Place], sequence: int
) -> str | None:
    """Return a sentence that explains why no query can use the hints in `known` (see `RecordedPrior`), else None.
    `sequence` is the number of queries that are matched together."""
    if known and sequence > 1:
        return f"{sequence} queries are matched together, but `known` applies to single queries: omit one of them."
    for part, (field, columns) in _REQUIRED_FIELDS.items():
        for name, tags in (("query", queries), ("place", places)):
            if part in known and all(getattr(tag, field) is None for tag in tags):
                return f"`{part}` needs {columns}, but no {name} has it: add it to positions.csv."
    return None


def _drop_useless(reach: Reach | None, heading_deg: float | None, index: PlaceIndex) -> Hints | None:
    """Return the hints that narrow a search of the index (None: no hints). An area with all places or none does not."""
    if reach and not 0 < index.find_within(reach.position, reach.radius_m).sum() < len(index):
        reach = None
    if np.isnan(index.heading_deg).all():
        heading_deg = None
    return Hints(reach, heading_deg).select(*_TRUST_ALL)


def to_expectation(hints: Hints | None, height_ratio: float, index: PlaceIndex) -> Expectation:
    """Convert hints and height to an `Expectation` of the places of the index."""
    in_reach = rotation_deg = None
    if hints and hints.reach:
        in_reach = index.find_within(hints.reach.position, hints.reach.radius_m)
    if hints and hints.heading_deg is not None:
        rotation_deg = (hints.heading_deg - index.heading_deg.astype(float)) % 360
    return Expectation(in_reach, rotation_deg, height_ratio)
