"""Refines a map for a camera that looks straight down: matches its pictures with each other to correct the recorded
positions. `mapmaking.finishing` calls it.

Each place gets a pose: the direction and footprint of its picture, and a position with a covariance. Headings, lens and
mounting need not be known. A place tied (see `graph`) to too few others keeps its recorded position and gets no pose.

Only pairs that may overlap are compared: places recorded near each other, and, because a recorded position may be far
off, places mapped one after the other. After the pose graph is solved, pairs that overlap in the solution are compared
too. Landmarks (ORB points), the most accurate, are compared first. If too few of them agree and the pictures are
available, the technique compares their regions as in flight, which yields a rough relative pose ("vote"); landmarks are
then compared again near that pose.
"""

import cmath
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from edgevpr.core.arrays import Array, Bools, Complexes, Floats
from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.errors import EdgevprError, PlaceError
from edgevpr.core.geodesy import move_position, project_to_metres
from edgevpr.core.text import Progress, decode_name
from edgevpr.core.types import Place, Pose, Position
from edgevpr.frames.images import list_images, read_image
from edgevpr.mapmaking.graph import GraphSolution, Ties, solve_graph
from edgevpr.mapmaking.offset import find_common_offset, find_displaced_run
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import find_inconsistent_tags
from edgevpr.runtime.recognise.agreement import MIN_CONFIRMED_INLIERS, MIN_PROVEN_INLIERS, Overlay, measure_agreement
from edgevpr.runtime.recognise.landmarks import Landmarks, unpack_bytes

# Positions turned by half a turn (rows in reversed order, lost signs of both lat and lon) fit the pictures as well.
MAX_TURN_DEG = 135.0
_MIN_COMMON_TURN = 0.7  # length of the mean of unit vectors
_MIN_GROUP = 4  # places connected by ties; three cannot reveal an error in scale
_LOOSE_SD_M = 300.0  # of recorded positions that do not outweigh ties; with 1000, lines of 100 images bend by 30 m
_MAX_LOG_SD = 0.15  # maximum standard deviation of a log (see `graph`): 9 degrees, 15 % of the footprint
# If the misfit between recorded positions and ties exceeds this fraction of their spread, their mirror images are
# tried; one is right if its misfit is below this ratio of the original one. Correct sets have 0.01 to 0.36, and their
# mirror images at least 1.3 times as much, also with 20 m of noise. With lat and lon exchanged, sets have 0.18 to 1.0,
# and their mirror images at most 0.7 times as much.
_MIN_MISFIT = 0.15
_MAX_MIRRORED_RATIO = 0.75
_MAX_MIRROR_PLACES = 300  # places to which the mirror image is fitted
_NEAREST_PLACES = 8  # each place is compared with this many of the places recorded nearest to it
_PREVIOUS_PLACES = 2  # and with this many of the places mapped just before it
_MAX_OVERLAP_DISTANCE = 0.6  # between centres, in longest sides; closer pictures share at least a third
_MAX_OVERLAPPING = 12  # pairs per place after the graph is solved
# Chosen on aerial_caliterra and aerial_garfield28. Among their pairs without enough landmarks, and those of three other
# sets, no vote with 0.02 or more was wrong; among pairs with landmarks near the vote, none was.
_MIN_VOTE_SCORE = 0.025  # to use a vote without landmarks
_MIN_SCORE = 0.01  # to compare landmarks near the vote
# Standard deviations (step, turn) along one axis. Tilt and relief act on landmarks like rotation and scale. A vote has
# whole cells, rotations in steps of 15 degrees, and an uncertain scale if few regions agree.
_LANDMARK_SDS = (0.01, 0.05)
_VOTE_SDS = (0.016, 0.09)
_MAX_HYPOTHESES = 8  # hypotheses of rotation and height for a pair
_CACHED_LANDMARKS = 512  # places; neighbours are compared soon after each other
_CACHED_DESCRIPTORS = 4


class Tie(NamedTuple):
    """Relative pose of two pictures, `query` to `place`. `step`: complex offset from the centre of the place's picture
    to the centre of the query's (right + i up, in longest sides of the place's picture). `turn`: complex, log(scale) +
    i counter-clockwise rotation in radians. `step_sd`, `turn_sd`: standard deviations of both along one axis."""

    step: complex
    turn: complex
    step_sd: float
    turn_sd: float


Pair = tuple[int, int]  # the indices of query and place, the later one first
ComparePair = Callable[[int, int], Tie | None]  # compares a pair (query, place); None: no tie


@dataclass(frozen=True, slots=True, kw_only=True)
class Refinement:
    """Result of refining a map with `places` places. Of these, `without_position` have no position, `surveyed` were cut
    from an orthophoto and are not changed, and `refined` now have a pose; the others had too few ties. `ties`: number
    of ties that agree with the solution. `recorded_sd_m`: standard deviation of recorded positions along one axis.
    `moved_m`, `position_sd_m`, `footprint_m`: medians of the distances by which places moved, of the standard
    deviations of refined positions, and of footprints (None: no place).
    `contradictory`: places whose recorded position contradicts the pictures (see `find_inconsistent_tags`): (place id,
    image, metres between recorded and refined position).
    `is_mirrored`: the ties fit the mirror image of the recorded positions, so nothing was refined. Nor was it if
    `turned_deg`, the mean angle (clockwise) from recorded headings to those that the ties show, is large.
    `common_offset_m`: median of the distances from images to recorded positions due to an offset that all have in the
    same direction from the camera (see `offset`; None: none). `displaced`: first and last image of a run whose
    recorded positions are displaced together, and metres against the others. Both are part of the claimed accuracy."""

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
    is_mirrored: bool = False
    turned_deg: float = 0.0
    common_offset_m: float | None = None
    displaced: tuple[str, str, float] | None = None


def refine(
    place_map: PlaceMap, technique: Technique, progress: Progress, images: str | Path | None = None
) -> Refinement:
    """Refine a map that is open for writing, in one transaction. `progress` wraps the iteration over the pairs of
    places. `images` is the folder of the map's pictures (None: not available, so only the landmarks in the map are
    compared). Raises MapError if the map file cannot be read or written.
    """
    places = list(_read_places(place_map))
    located = [place for place in places if place.position]
    refinable = [place for place in located if not (place.pose and place.pose.is_surveyed)]
    result = Refinement(
        places=len(places), without_position=len(places) - len(located), surveyed=len(located) - len(refinable)
    )
    if not refinable:
        return result
    positions = [position for place in refinable if (position := place.recorded_position)]
    east_m, north_m = project_to_metres(*np.array([(position.lat_deg, position.lon_deg) for position in positions]).T)
    recorded = east_m + 1j * north_m
    compare_pair = _make_comparer(place_map, technique, refinable, images)
    pairs = _find_likely_pairs(recorded)
    ties = {pair: tie for pair in progress(pairs, len(pairs), "refining") if (tie := compare_pair(*pair))}
    run, displacement_m = find_displaced_run(recorded, solve_graph(recorded, _to_ties(ties), _LOOSE_SD_M))
    aligned = recorded - displacement_m * (np.isin(np.arange(len(recorded)), run) - len(run) / len(recorded))
    solution = solve_graph(aligned, _to_ties(ties))
    extra = sorted(set(_find_overlapping_pairs(solution.position, solution.log, _is_determined(solution))) - set(pairs))
    if extra:
        ties |= {pair: tie for pair in progress(extra, len(extra), "refining") if (tie := compare_pair(*pair))}
        solution = solve_graph(aligned, _to_ties(ties))
    is_mirrored = _is_mirrored(positions, recorded, aligned, _to_ties(ties), solution)
    refined = _is_determined(solution) & (not is_mirrored)
    turned_deg = _measure_turn(refinable, solution, refined)
    refined &= abs(turned_deg) <= MAX_TURN_DEG
    moved_m, footprint_m = abs(solution.position - recorded)[refined], np.exp(solution.log.real)
    members = np.flatnonzero(refined)
    offset = find_common_offset(recorded[refined], solution.position[refined], solution.log[refined])
    shift_m = abs(displacement_m) if len(members) and not offset else 0.0  # on two lines, both look the same
    # The offset has the same length in any direction, so each axis gets all of it.
    position_var_m2 = solution.position_var / 2 + (offset * footprint_m) ** 2 + shift_m**2
    _write_poses(place_map, refinable, positions, solution, position_var_m2, refined)
    return replace(
        result,
        refined=int(refined.sum()),
        ties=int(solution.ties_agree.sum()),
        recorded_sd_m=solution.recorded_sd_m,
        moved_m=_find_median(moved_m),
        position_sd_m=_find_median(np.sqrt(position_var_m2[refined])),
        footprint_m=_find_median(footprint_m[refined]),
        contradictory=tuple(
            (refinable[members[row]].place_id, refinable[members[row]].source_image, float(moved_m[row]))
            for row in np.flatnonzero(find_inconsistent_tags(moved_m))
        ),
        is_mirrored=is_mirrored,
        turned_deg=turned_deg,
        common_offset_m=float(np.median(offset * footprint_m[refined])) if offset else None,
        displaced=(refinable[run[0]].source_image, refinable[run[-1]].source_image, shift_m) if shift_m else None,
    )


def _is_determined(solution: GraphSolution) -> Bools:
    """Return bool (N,), True for places in a large enough group whose solution is accurate enough for a pose."""
    group_size = np.bincount(solution.component)[solution.component]
    return np.asarray((group_size >= _MIN_GROUP) & (solution.log_var / 2 <= _MAX_LOG_SD**2))


def _is_mirrored(
    positions: list[Position], recorded: Complexes, aligned: Complexes, ties: Ties, solution: GraphSolution
) -> bool:
    """Return True if the ties fit a mirror image of the recorded positions much better than the positions themselves,
    and about as well as `aligned`: lat and lon are exchanged or a sign is wrong. A straight line hides it."""
    sample = slice(_MAX_MIRROR_PLACES)
    misfit = _compute_misfit(recorded, solution, sample)
    if misfit < _MIN_MISFIT:
        return False
    in_sample = (ties.query < _MAX_MIRROR_PLACES) & (ties.place < _MAX_MIRROR_PLACES)
    sample_ties = Ties(**{field.name: getattr(ties, field.name)[in_sample] for field in fields(Ties)})
    lat_deg, lon_deg = np.array([(position.lat_deg, position.lon_deg) for position in positions[sample]]).T
    mirrored = [recorded[sample].conj()]
    if abs(lon_deg).max() < 90:  # exchanging lat and lon also changes the proportions of the track
        east_m, north_m = project_to_metres(lon_deg, lat_deg)
        mirrored.append(east_m + 1j * north_m)
    limit = min(_MAX_MIRRORED_RATIO * misfit, _compute_misfit(aligned, solution, sample) / _MAX_MIRRORED_RATIO)
    return any(_compute_misfit(image, solve_graph(image, sample_ties), sample) < limit for image in mirrored)


def _measure_turn(places: list[Place], solution: GraphSolution, refined: Bools) -> float:
    """Return the mean angle (degrees, clockwise) from recorded headings to those that the ties show, which follow from
    the positions; 0.0 if few headings are recorded or the angles differ."""
    recorded = [(index, place.pose.up_deg) for index, place in enumerate(places) if refined[index] and place.pose]
    if len(recorded) < _MIN_GROUP:
        return 0.0
    indices, ups_deg = np.array(recorded).T
    mean = np.exp(-1j * (solution.log.imag[indices.astype(int)] + np.radians(ups_deg))).mean()
    return math.degrees(cmath.phase(mean)) if abs(mean) > _MIN_COMMON_TURN else 0.0


def _compute_misfit(recorded: Complexes, solution: GraphSolution, sample: slice) -> float:
    """Return the median distance between recorded and solved positions in `sample`, divided by the spread of the
    recorded ones. Only large enough groups of places connected by ties are used; 0 if there is none."""
    component, position = solution.component[sample], recorded[sample]
    size = np.bincount(component)
    is_used = size[component] >= _MIN_GROUP
    if not is_used.any():
        return 0.0
    mean = (np.bincount(component, position.real) + 1j * np.bincount(component, position.imag)) / np.maximum(size, 1)
    error_m, spread_m = abs(solution.position[sample] - position)[is_used], abs(position - mean[component])[is_used]
    return float(np.median(error_m) / max(np.median(spread_m), 1e-9))


def _read_places(place_map: PlaceMap) -> Iterator[Place]:
    for place_id, *_ in place_map.read_outlines():
        with suppress(PlaceError):
            yield from place_map.read_places([place_id])


def _write_poses(
    place_map: PlaceMap,
    refinable: list[Place],
    positions: list[Position],
    solution: GraphSolution,
    position_var_m2: Floats,
    refined: Bools,
) -> None:
    """Write the solved positions, with their variances along one axis, and poses to the map for places where `refined`,
    bool (N,), is True. The others are reset to their recorded positions, without a pose."""
    origin = positions[0]
    with place_map.transaction():
        for index, place in enumerate(refinable):
            position, pose = positions[index], None
            if refined[index]:
                var_m2, offset_m = float(position_var_m2[index]), solution.position[index]
                position = move_position(origin, offset_m.real, offset_m.imag)
                pose = Pose(
                    up_deg=float(-np.degrees(solution.log[index].imag)) % 360,
                    footprint_m=float(np.exp(solution.log[index].real)),
                    covariance_m2=(var_m2, 0.0, var_m2),
                    recorded=positions[index],
                )
            if pose or place.pose is None or place.pose.recorded:
                place_map.move_place(place.place_id, position, pose)


def _find_median(values: Floats) -> float | None:
    return float(np.median(values)) if len(values) else None


def _find_likely_pairs(recorded: Complexes) -> list[Pair]:
    """Return the pairs of places that may overlap. `recorded`: positions, complex (N,) metres, in mapping order."""
    count = len(recorded)
    pairs = {(later, later - step) for step in range(1, _PREVIOUS_PLACES + 1) for later in range(step, count)}
    return sorted(pairs | {(later, earlier) for later, earlier, _ in _pair_nearest(recorded, _NEAREST_PLACES)})


def _find_overlapping_pairs(position: Complexes, log: Complexes, selected: Bools) -> list[Pair]:
    """Return the pairs of places that overlap in a solved graph. `position` and `log` are those of
    `graph.GraphSolution`; only places where `selected`, bool (N,), is True are considered."""
    members, footprint_m = np.flatnonzero(selected), np.exp(log.real[selected])
    return sorted(
        {
            (int(members[later]), int(members[earlier]))
            for later, earlier, distance_m in _pair_nearest(position[members], _MAX_OVERLAPPING)
            if distance_m <= _MAX_OVERLAP_DISTANCE * min(footprint_m[later], footprint_m[earlier])
        }
    )


def _pair_nearest(position: Complexes, count: int) -> Iterator[tuple[int, int, float]]:
    """Pair each of N places, at `position`, complex (N,) metres, with the `count` places nearest to it. Yields (index
    of the later place, index of the earlier place, metres between them) for each pair; some pairs occur twice."""
    if len(position) > 1:
        points = np.stack([position.real, position.imag], axis=1)
        distances_m, neighbours = cKDTree(points).query(points, k=min(count + 1, len(points)))
        for (place, rank), other in np.ndenumerate(neighbours):
            if other != place:
                yield max(place, int(other)), min(place, int(other)), float(distances_m[place, rank])


def _to_ties(ties_by_pair: dict[Pair, Tie]) -> Ties:
    """Convert ties to the arrays that `graph.solve_graph` expects."""
    query, place = np.array(list(ties_by_pair), np.intp).reshape(-1, 2).T
    step, turn, step_sd, turn_sd = np.array(list(ties_by_pair.values()), complex).reshape(-1, 4).T
    return Ties(query=query, place=place, step=step, turn=turn, step_sd=step_sd.real, turn_sd=turn_sd.real)


def _make_comparer(
    place_map: PlaceMap, technique: Technique, places: list[Place], images: str | Path | None
) -> ComparePair:
    """Return a function that compares two of `places`, passed by index, and returns their tie (None: no tie). `images`
    is the folder of their pictures (None: not available, so only landmarks are compared)."""
    paths = {decode_name(path.name): path for path in list_images(images)} if images else {}
    coarse = {place_id: part for place_id, *_, part in place_map.read_coarse_parts()}

    @lru_cache(_CACHED_LANDMARKS)
    def read_landmarks(index: int) -> Landmarks | None:
        try:
            blob = place_map.read_landmarks(places[index].place_id)
            return unpack_bytes(blob) if blob else None
        except (EdgevprError, ValueError):
            return None

    @lru_cache(_CACHED_DESCRIPTORS)
    def encode_picture(index: int) -> Descriptor | None:
        if (path := paths.get(places[index].source_image)) is None:
            return None
        try:
            descriptor = technique.encode(read_image(path, upright=False))
        except EdgevprError:
            return None
        return descriptor if place_map.has_descriptor(places[index].place_id, descriptor.coarse) else None

    def compare_landmarks(query: int, place: int, expected: Overlay | None, min_inliers: int) -> Tie | None:
        first, second = read_landmarks(query), read_landmarks(place)
        pose = None if first is None or second is None else measure_agreement(first, second, expected)
        if pose is None or pose.inliers < min_inliers or pose.shift_share is None or pose.rotation_deg is None:
            return None
        return Tie(*Overlay(pose.shift_share, pose.rotation_deg, pose.scale).relative_pose, *_LANDMARK_SDS)

    def compare_pair(query: int, place: int) -> Tie | None:
        if tie := compare_landmarks(query, place, None, MIN_PROVEN_INLIERS):
            return tie
        descriptor, part = encode_picture(query), coarse.get(places[place].place_id)
        if descriptor is None or part is None:
            return None
        try:
            fine, _ = place_map.read_fine_part(places[place].place_id)
        except EdgevprError:
            return None
        match = technique.match(descriptor, fine, _rank_hypotheses(technique, descriptor, part))
        if match.score < _MIN_SCORE:
            return None
        (dx, dy), cells = match.shift_cells or (0.0, 0.0), technique.spec.cells or 1
        vote = Overlay((dx / cells, dy / cells), match.rotation_deg or 0.0, match.height_ratio)
        tie = compare_landmarks(query, place, vote, MIN_CONFIRMED_INLIERS)
        return tie or (Tie(*vote.relative_pose, *_VOTE_SDS) if match.score >= _MIN_VOTE_SCORE else None)

    return compare_pair


def _rank_hypotheses(technique: Technique, query: Descriptor, coarse: Array) -> list[int]:
    """Return the numbers of the hypotheses of rotation and height that `Technique.match` should test for a query and a
    place: the eight that score best against the coarse part of the place, best first."""
    _, hypothesis_scores = technique.score_places(query, coarse[None], None)
    assert hypothesis_scores is not None  # set by techniques for a camera that looks down
    best = np.argsort(-hypothesis_scores[0], kind="stable")[:_MAX_HYPOTHESES]
    ranked: list[int] = best[np.isfinite(hypothesis_scores[0][best])].tolist()
    return ranked
