"""Moves a map to match GPS, by the offset and scale measured in a flight (see `runtime.flight.survey`, which writes
lines of kind "survey" to the flight log). The command `edgevpr map move` calls it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import read_identity
from edgevpr.runtime.flight.flightlog import select_last_flight


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMove:
    """A move of a map of `places` places. Its centre `middle` (latitude and longitude in degrees) moves by `east_m` and
    `north_m`, standard deviation `sd_m`. Distances from it are divided by 1 + `scale` (None: unchanged)."""

    places: int
    middle: tuple[float, float]
    east_m: float
    north_m: float
    sd_m: float
    scale: float | None

    def apply(self, position: Position) -> Position:
        """Return the moved position."""
        offsets_m = offset_m(*self.middle, position.lat_deg, position.lon_deg)
        east_m, north_m = (distance_m / (1 + (self.scale or 0.0)) for distance_m in map(float, offsets_m))
        lat_deg, lon_deg = offset_position(*self.middle, east_m + self.east_m, north_m + self.north_m)
        return replace(position, lat_deg=lat_deg, lon_deg=lon_deg)


def move_map(place_map: PlaceMap, log: str | Path) -> MapMove:
    """Move all places of a map that is open for writing, in one transaction, by the last survey result in a flight log.
    Raises UsageError if the log has no result, or is from another map or version, and MapError as `PlaceMap` does."""
    survey, identity = None, None
    for line in select_last_flight(log):
        if line["kind"] == "start":
            identity = line.get("map_identity")
        elif line["kind"] == "survey":
            survey = line
    if identity != read_identity(place_map):
        raise UsageError(
            f"{log} was not recorded with the current {place_map.path} (it is from another map, or this map has since "
            "been changed or moved). Pass the log of a flight with this map."
        )
    move = _read_move(survey or {}, len(place_map))
    if move is None:
        raise UsageError(
            f"{log} contains no measured map offset: fly for a few minutes with good GPS, accepted matches and "
            "changing headings."
        )
    with place_map.transaction():
        for place in list(place_map.read_places()):
            pose = place.pose
            if pose:  # the recorded position moves too, so that a later refinement does not undo the move
                recorded = pose.recorded and move.apply(pose.recorded)
                pose = replace(pose, footprint_m=pose.footprint_m / (1 + (move.scale or 0.0)), recorded=recorded)
            if place.position:
                place_map.move_place(place.place_id, move.apply(place.position), pose)
    return move


def _read_move(line: dict[str, Any], places: int) -> MapMove | None:
    """Return the move in a line of kind "survey"; None if the line has no measured offset."""
    match line:
        case {
            "off_m": [int() | float() as east_m, int() | float() as north_m],
            "off_sd": int() | float() as sd_m,
            "middle": {"lat_deg": float() as lat_deg, "lon_deg": float() as lon_deg},
            "scale": int() | float() | None as scale,
        }:
            middle = lat_deg, lon_deg
            return MapMove(places=places, middle=middle, east_m=-east_m, north_m=-north_m, sd_m=sd_m, scale=scale)
    return None
