"""Refinement of a map whose camera looks straight down: its pictures are matched with each other to correct the
recorded positions. `mapmaking.making` calls it.

Each place gets a pose: the direction and the footprint of its picture, and a position with a covariance. Headings, lens
and mounting of the camera need not be known. A place with ties (see `graph`) to too few others keeps its recorded
position and gets no pose.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Bools, Floats
from edgevpr.core.contract import Technique
from edgevpr.core.errors import PlaceError
from edgevpr.core.geodesy import metres, moved
from edgevpr.core.types import Place, Pose, Position
from edgevpr.mapmaking.graph import Solved, solve
from edgevpr.mapmaking.mapping import Watch
from edgevpr.mapmaking.tying import likely_pairs, looker, overlapping_pairs, tied, ties_of
from edgevpr.places.mapfile import PlaceMap

_LEAST_GROUP = 4  # places connected by ties: with three, an error of the scale does not show
_MOST_TURN = 0.15  # largest standard deviation of a log (see `graph`): 9 degrees, 15 % of the footprint
_AMISS = 4.0  # standard deviations of a recorded position from which on the pictures contradict it


@dataclass(frozen=True, slots=True, kw_only=True)
class Refined:
    """Result of refining a map of so many `places`. Of these, `without_position` have no position, `surveyed` were cut
    from an orthophoto and stay as they are, and `refined` have a pose now; for the others there were too few ties.
    `ties`: number of ties that agree with the solution. `recorded_sd_m`: standard deviation of recorded positions along
    one axis. `moved_m`, `position_sd_m`, `footprint_m`: medians of the places' moves, of the standard deviations of
    refined positions, and of footprints (None: no place).
    `contradictory`: places whose recorded position the pictures contradict: (number, image, metres between the two)."""

    places: int
    without_position: int
    surveyed: int
    refined: int = 0
    ties: int = 0
    recorded_sd_m: float | None = None
    moved_m: float | None = None
    position_sd_m: float | None = None
    footprint_m: float | None = None
    contradictory: tuple[tuple[int, str, float], ...] = ()


def refine(
    place_map: PlaceMap, technique: Technique, watch: Watch[tuple[int, int]], images: str | Path | None = None
) -> Refined:
    """Refine a map that is open for adding, in one transaction. `watch` wraps the iteration over the pairs of places,
    to show progress. `images` is the folder of the map's pictures (None: not at hand, so only the landmarks in the map
    are compared). Raises MapError if the file cannot be read or written.
    """
    places = list(_readable(place_map))
    with_position = [place for place in places if place.position]
    placed = [place for place in with_position if not (place.pose and place.pose.is_surveyed)]
    result = Refined(
        places=len(places),
        without_position=len(places) - len(with_position),
        surveyed=len(with_position) - len(placed),
    )
    if not placed:
        return result
    recorded_at = [_recorded(place) for place in placed]
    east_m, north_m = metres(*np.array([(position.lat_deg, position.lon_deg) for position in recorded_at]).T)
    recorded = east_m + 1j * north_m
    look = looker(place_map, technique, placed, images)
    pairs = likely_pairs(recorded)
    ties = tied(watch(pairs, len(pairs)), look)
    solved = solve(recorded, ties_of(ties))
    more = sorted(set(overlapping_pairs(solved.position, solved.log, _is_sure(solved))) - set(pairs))
    if more:
        ties |= tied(watch(more, len(more)), look)
        solved = solve(recorded, ties_of(ties))
    sure = _is_sure(solved)
    _write(place_map, placed, recorded_at, solved, sure)
    off_m = abs(solved.position - recorded)
    amiss = sure & ~solved.recorded_counts & (off_m > _AMISS * solved.recorded_sd_m)
    return replace(
        result,
        refined=int(sure.sum()),
        ties=int(solved.ties_count.sum()),
        recorded_sd_m=solved.recorded_sd_m,
        moved_m=_median(off_m[sure]),
        position_sd_m=_median(np.sqrt(solved.position_var[sure] / 2)),
        footprint_m=_median(np.exp(solved.log.real[sure])),
        contradictory=tuple(
            (placed[at].place_id, placed[at].source_image, float(off_m[at])) for at in np.flatnonzero(amiss).tolist()
        ),
    )


def _recorded(place: Place) -> Position:
    """Return the position of a place as it was before any refinement."""
    position = place.pose.recorded if place.pose and place.pose.recorded else place.position
    assert position is not None  # callers pass only places with a position
    return position


def _is_sure(solved: Solved) -> Bools:
    """Return bool (N,), True for places with enough ties and a sufficiently exact solution to get a pose."""
    members = np.bincount(solved.component)[solved.component]
    is_sure: Bools = (members >= _LEAST_GROUP) & (solved.log_var / 2 <= _MOST_TURN**2)
    return is_sure


def _readable(place_map: PlaceMap) -> Iterator[Place]:
    for place_id, *_ in place_map.outlines():
        with suppress(PlaceError):
            yield from place_map.places([place_id])


def _write(place_map: PlaceMap, placed: list[Place], recorded_at: list[Position], solved: Solved, sure: Bools) -> None:
    """Write the solved positions and poses to the map for the places where `sure`, bool (N,), is True. The others get
    their recorded positions again, and no pose."""
    origin = recorded_at[0]
    with place_map.transaction():
        for at, place in enumerate(placed):
            position, pose = recorded_at[at], None
            if sure[at]:
                var_m2, offset_m = float(solved.position_var[at]) / 2, solved.position[at]
                position = Position(*moved(origin.lat_deg, origin.lon_deg, offset_m.real, offset_m.imag))
                pose = Pose(
                    up_deg=float(-np.degrees(solved.log[at].imag)) % 360,
                    footprint_m=float(np.exp(solved.log[at].real)),
                    covariance_m2=(var_m2, 0.0, var_m2),
                    recorded=recorded_at[at],
                )
            if pose or place.pose is None or place.pose.recorded:
                place_map.lay(place.place_id, position, pose)


def _median(values: Floats) -> float | None:
    return float(np.median(values)) if len(values) else None
