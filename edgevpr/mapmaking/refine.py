"""Refinement of a map that looks straight down: its pictures, matched with each other, say where they really lie.

Each place gets a pose: the direction and the footprint of its picture, and a position with a covariance. A camera
mounted askew, a missing compass or a lens that nobody has measured are no obstacle: none of them is asked. A place that
is tied to too few others stays where it was recorded, without a pose.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Bools, Complexes, Floats
from edgevpr.core.contract import Technique
from edgevpr.core.errors import PlaceError
from edgevpr.core.geodesy import metres, moved
from edgevpr.core.types import Place, Pose, Position
from edgevpr.mapmaking.graph import Solved, solve
from edgevpr.mapmaking.mapping import Watch
from edgevpr.mapmaking.tying import likely_pairs, looker, overlapping_pairs, pictures, tied, ties_of
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sqlite import sentences

_LEAST_GROUP = 4  # places tied to each other: three positions fit any error of the scale too well
_MOST_TURN = 0.15  # standard deviation of a log: 9 degrees, 15 % of the footprint
_AMISS = 4.0  # standard deviations


@dataclass(frozen=True, slots=True, kw_only=True)
class Refined:
    """Result of refining a map. Of its `places`, `without_position` have none, `surveyed` needed no refining, and
    `refined` have a pose now; the others could not be tied. `ties` pairs of pictures agree, `ties_refused` do not.
    `recorded_sd_m` is how much recorded positions scatter in one axis, `moved_m` the median of how far places were
    moved, `position_sd_m` the median standard deviation of a refined position, and `footprint_m` the median footprint
    (None: nothing was refined). `contradictory` are places whose recorded position the pictures contradict: number,
    image and metres.
    """

    places: int
    without_position: int
    surveyed: int
    refined: int
    ties: int
    ties_refused: int
    recorded_sd_m: float | None = None
    moved_m: float | None = None
    position_sd_m: float | None = None
    footprint_m: float | None = None
    contradictory: tuple[tuple[int, str, float], ...] = ()

    @property
    def not_tied(self) -> int:
        """Number of places with a position that could not be tied to others."""
        return self.places - self.without_position - self.surveyed - self.refined


def refine(
    place_map: PlaceMap, technique: Technique, watch: Watch[tuple[int, int]], images: str | Path | None = None
) -> Refined:
    """Refine a map that is open for adding: all of it, or nothing is changed. `watch` passes pairs through and shows
    progress. `images` is the folder of the pictures that the map was made of, where they are at hand. Raises MapError
    where the file cannot be read or written.
    """
    places = list(_readable(place_map))
    placed = [place for place in places if place.position]
    surveyed = np.array([bool(place.pose and place.pose.is_surveyed) for place in placed], bool)
    result = Refined(
        places=len(places), without_position=len(places) - len(placed), surveyed=int(surveyed.sum()), refined=0, ties=0,
        ties_refused=0,
    )  # fmt: skip
    if not placed or surveyed.all():
        return result
    recorded_at = [_recorded(place) for place in placed]
    recorded = complex_metres(recorded_at)
    poses = [place.pose if place.pose and place.pose.is_surveyed else None for place in placed]
    known_sd_m = np.array([np.nan if pose is None else _sd_m(pose) for pose in poses])
    known_log = np.array([np.nan if pose is None else log_of(pose) for pose in poses])
    look = looker(place_map, technique, placed, pictures(images, technique) if images else None)
    pairs = likely_pairs(recorded)
    ties = tied(watch(pairs, len(pairs)), look)
    solved = solve(recorded, known_sd_m, ties_of(ties), known_log)
    more = sorted(set(overlapping_pairs(solved.position, solved.log, _is_sure(solved))) - set(pairs))
    if more:
        ties |= tied(watch(more, len(more)), look)
        solved = solve(recorded, known_sd_m, ties_of(ties), known_log)
    sure = _is_sure(solved) & ~surveyed
    # A place that is not tied goes back to where it was recorded, but for one whose pose is not by refining.
    by_refining = np.array([place.pose is None or place.pose.recorded is not None for place in placed], bool)
    _write(place_map, placed, recorded_at, solved, sure, sure | by_refining)
    off_m = abs(solved.position - recorded)
    amiss = sure & ~solved.recorded_counts & (off_m > _AMISS * solved.recorded_sd_m)
    return replace(
        result,
        refined=int(sure.sum()),
        ties=int(solved.ties_count.sum()),
        ties_refused=int((~solved.ties_count).sum()),
        recorded_sd_m=solved.recorded_sd_m,
        moved_m=_median(off_m[sure]),
        position_sd_m=_median(np.sqrt(solved.position_var[sure] / 2)),
        footprint_m=_median(np.exp(solved.log.real[sure])),
        contradictory=tuple(
            (placed[at].place_id, placed[at].source_image, float(off_m[at])) for at in np.flatnonzero(amiss).tolist()
        ),
    )


def complex_metres(positions: Sequence[Position]) -> Complexes:
    """Return positions as complex (N,), east + i north in metres from the first of them."""
    lat_deg, lon_deg = np.array([(position.lat_deg, position.lon_deg) for position in positions]).T
    east_m, north_m = metres(lat_deg, lon_deg)
    return east_m + 1j * north_m


def log_of(pose: Pose) -> complex:
    """Return the log of a pose (see `graph`)."""
    return complex(np.log(pose.footprint_m) - 1j * np.radians(pose.up_deg))


def _recorded(place: Place) -> Position:
    """Return the position of a place as it was before any refining."""
    position = place.pose.recorded if place.pose and place.pose.recorded else place.position
    assert position is not None  # of a place that has one
    return position


def _is_sure(solved: Solved) -> Bools:
    """Tell which places are tied to enough others, and lie as exactly as a pose should, bool (N,)."""
    members = np.bincount(solved.component)[solved.component]
    is_sure: Bools = (members >= _LEAST_GROUP) & (solved.log_var / 2 <= _MOST_TURN**2)
    return is_sure


def _sd_m(pose: Pose) -> float:
    var_east, _, var_north = pose.covariance_m2
    return float(np.sqrt((var_east + var_north) / 2))


def _readable(place_map: PlaceMap) -> Iterator[Place]:
    for place_id, *_ in place_map.outlines():
        with suppress(PlaceError):
            yield from place_map.places([place_id])


def _write(
    place_map: PlaceMap,
    placed: list[Place],
    recorded_at: list[Position],
    solved: Solved,
    sure: Bools,
    may_change: Bools,
) -> None:
    """Write the solution: a pose for each place that is `sure`, none for the others that `may_change`."""
    origin = recorded_at[0]
    with sentences(place_map.path), place_map.transaction():
        for at in np.flatnonzero(may_change).tolist():
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
            place_map.lay(placed[at].place_id, position, pose)


def _median(values: Floats) -> float | None:
    return float(np.median(values)) if len(values) else None
