"""Refinement of a map whose camera looks straight down: its pictures are matched with each other to correct the
recorded positions. `mapmaking.finishing` calls it.

Each place gets a pose: the direction and the footprint of its picture, and a position with a covariance. Headings, lens
and mounting of the camera need not be known. A place with ties (see `graph`) to too few others keeps its recorded
position and gets no pose.

Only pairs that may overlap are compared: places recorded near each other, and places mapped one after the other, since
a recorded position may be far off. After the pose graph is solved, pairs that overlap by it follow. Landmarks (ORB
points) are compared first, as they are most exact. If too few of them agree, and the pictures are found, the technique
compares their regions as in flight, which gives a rough relative pose ("vote"). Landmarks are then compared again near
that pose.
"""

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
from edgevpr.core.geodesy import offset_position, project_to_metres
from edgevpr.core.text import Progress, decode_name
from edgevpr.core.types import Place, Pose, Position
from edgevpr.frames.images import list_images, read_image
from edgevpr.mapmaking.graph import GraphSolution, Ties, solve_graph
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.agreement import MIN_CONFIRMED_INLIERS, MIN_PROVEN_INLIERS, Overlay, measure_agreement
from edgevpr.runtime.recognise.landmarks import Landmarks, unpack_bytes

_MIN_GROUP = 4  # places connected by ties: with three, an error of the scale does not show
_MAX_LOG_SD = 0.15  # largest standard deviation of a log (see `graph`): 9 degrees, 15 % of the footprint
# Positions that miss the shape of the ties by more than this share of their spread are held against mirror images, and
# one that misses by so much less is the right one. As recorded, sets miss by .01 to .36, and their mirror images by 1.3
# times as much or more, also with 20 m of noise; with lat and lon exchanged, by .18 to 1.0, and mirrored by .7 or less.
_MIN_MISFIT = 0.15
_MAX_MIRRORED_RATIO = 0.75
_MAX_MIRROR_PLACES = 300  # places that the mirror image is fitted to
_INCONSISTENT_SDS = 4.0  # standard deviations of a recorded position from which on the pictures contradict it
_NEAREST_PLACES = 8  # each place is compared with so many places recorded nearest
_PREVIOUS_PLACES = 2  # and with so many places mapped just before
_MAX_OVERLAP_DISTANCE = 0.6  # of the longest side: pictures with nearer middles share a third of their ground or more
_MAX_OVERLAPPING = 12  # pairs of one place, after the graph is solved
# Chosen on aerial_caliterra and aerial_garfield28: of their pairs without enough landmarks, and of those of three other
# sets, no vote with .02 or more was wrong, and of those with landmarks near the vote none at all.
_MIN_VOTE_SCORE = 0.025  # from which a vote is used without landmarks
_MIN_SCORE = 0.01  # from which landmarks near the vote are compared
# Standard deviations (step, turn) along one axis: of landmarks, in which tilt and relief look like turns and scalings;
# and of a vote, which has whole cells, turns of 15 degrees, and an uncertain scale if few regions agree.
_LANDMARK_SDS = (0.01, 0.05)
_VOTE_SDS = (0.016, 0.09)
_MAX_HYPOTHESES = 8  # hypotheses of rotation and height for a pair
_CACHED_LANDMARKS = 512  # places whose landmarks are cached: neighbours are compared soon after each other
_CACHED_DESCRIPTORS = 4  # descriptors that are cached


class Tie(NamedTuple):
    """Relative pose of two pictures, `query` to `place`. `step`: complex offset from the middle of the place's picture
    to that of the query's (right + i up, in shares of the longest side of the place's picture). `turn`: complex,
    natural logarithm of the scale + i counter-clockwise rotation in radians. `step_sd`, `turn_sd`: standard deviations
    of the two along one axis."""

    step: complex
    turn: complex
    step_sd: float
    turn_sd: float


Pair = tuple[int, int]  # the numbers of query and place, the later one first
ComparePair = Callable[[int, int], Tie | None]  # compares a pair (query, place); None: no tie found


@dataclass(frozen=True, slots=True, kw_only=True)
class Refinement:
    """Result of refining a map of so many `places`. Of these, `without_position` have no position, `surveyed` were cut
    from an orthophoto and stay as they are, and `refined` have a pose now; for the others there were too few ties.
    `ties`: number of ties that agree with the solution. `recorded_sd_m`: standard deviation of recorded positions along
    one axis. `moved_m`, `position_sd_m`, `footprint_m`: medians of the places' moves, of the standard deviations of
    refined positions, and of footprints (None: no place).
    `contradictory`: places whose recorded position the pictures contradict: (number, image, metres between the two).
    `is_mirrored`: the ties fit the mirror image of the recorded positions and not these; then nothing is refined."""

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


def refine(
    place_map: PlaceMap,
    technique: Technique,
    progress: Progress,
    images: str | Path | None = None,
) -> Refinement:
    """Refine a map that is open for adding, in one transaction. `progress` wraps the iteration over the pairs of
    places. `images` is the folder of the map's pictures (None: not at hand, so only the landmarks in the map
    are compared). Raises MapError if the file cannot be read or written.
    """
    places = list(_read_places(place_map))
    with_position = [place for place in places if place.position]
    placed = [place for place in with_position if not (place.pose and place.pose.is_surveyed)]
    result = Refinement(
        places=len(places),
        without_position=len(places) - len(with_position),
        surveyed=len(with_position) - len(placed),
    )
    if not placed:
        return result
    recorded_at = [_recorded_position(place) for place in placed]
    east_m, north_m = project_to_metres(*np.array([(position.lat_deg, position.lon_deg) for position in recorded_at]).T)
    recorded = east_m + 1j * north_m
    compare_pair = _make_comparer(place_map, technique, placed, images)
    pairs = _find_likely_pairs(recorded)
    ties = {pair: tie for pair in progress(pairs, len(pairs), "refining") if (tie := compare_pair(*pair))}
    solved = solve_graph(recorded, _to_ties(ties))
    more = sorted(set(_find_overlapping_pairs(solved.position, solved.log, _is_determined(solved))) - set(pairs))
    if more:
        ties |= {pair: tie for pair in progress(more, len(more), "refining") if (tie := compare_pair(*pair))}
        solved = solve_graph(recorded, _to_ties(ties))
    is_mirrored = _is_mirrored(recorded_at, recorded, _to_ties(ties), solved)
    sure = _is_determined(solved) & (not is_mirrored)
    _write_poses(place_map, placed, recorded_at, solved, sure)
    off_m = abs(solved.position - recorded)
    inconsistent = sure & ~solved.recorded_agree & (off_m > _INCONSISTENT_SDS * solved.recorded_sd_m)
    return replace(
        result,
        refined=int(sure.sum()),
        ties=int(solved.ties_agree.sum()),
        recorded_sd_m=solved.recorded_sd_m,
        moved_m=_find_median(off_m[sure]),
        position_sd_m=_find_median(np.sqrt(solved.position_var[sure] / 2)),
        footprint_m=_find_median(np.exp(solved.log.real[sure])),
        contradictory=tuple(
            (place.place_id, place.source_image, float(off_m[at]))
            for at, place in enumerate(placed)
            if inconsistent[at]
        ),
        is_mirrored=is_mirrored,
    )


def _recorded_position(place: Place) -> Position:
    """Return the position of a place as it was before any refinement."""
    position = place.pose.recorded if place.pose and place.pose.recorded else place.position
    assert position is not None  # callers pass only places with a position
    return position


def _is_determined(solved: GraphSolution) -> Bools:
    """Return bool (N,), True for places with enough ties and a sufficiently exact solution to get a pose."""
    members = np.bincount(solved.component)[solved.component]
    is_sure: Bools = (members >= _MIN_GROUP) & (solved.log_var / 2 <= _MAX_LOG_SD**2)
    return is_sure


def _is_mirrored(recorded_at: list[Position], recorded: Complexes, ties: Ties, solved: GraphSolution) -> bool:
    """Tell whether the ties fit a mirror image of the recorded positions much better than these, as when lat and lon
    are exchanged or a sign is lost. Places on one straight line cannot tell, and neither can groups of few places."""
    some = slice(_MAX_MIRROR_PLACES)
    misses = _compute_misfit(recorded, solved, some)
    if misses < _MIN_MISFIT:
        return False
    within = (ties.query < _MAX_MIRROR_PLACES) & (ties.place < _MAX_MIRROR_PLACES)
    fewer = Ties(**{each.name: getattr(ties, each.name)[within] for each in fields(Ties)})
    lat_deg, lon_deg = np.array([(position.lat_deg, position.lon_deg) for position in recorded_at[some]]).T
    mirrored = [recorded[some].conj()]
    if abs(lon_deg).max() < 90:  # exchanging lat and lon also changes the proportions of the track
        east_m, north_m = project_to_metres(lon_deg, lat_deg)
        mirrored.append(east_m + 1j * north_m)
    limit = _MAX_MIRRORED_RATIO * misses
    return any(_compute_misfit(each, solve_graph(each, fewer), some) < limit for each in mirrored)


def _compute_misfit(recorded: Complexes, solved: GraphSolution, some: slice) -> float:
    """Return by how much the recorded positions of `some` places miss the solved ones (median), as a share of the
    spread of the recorded ones. Only groups of enough places, connected by ties, count; 0 if there is none."""
    component, here = solved.component[some], recorded[some]
    members = np.bincount(component)
    counts = members[component] >= _MIN_GROUP
    if not counts.any():
        return 0.0
    middle = (np.bincount(component, here.real) + 1j * np.bincount(component, here.imag)) / np.maximum(members, 1)
    off_m, spread_m = abs(solved.position[some] - here)[counts], abs(here - middle[component])[counts]
    return float(np.median(off_m) / max(np.median(spread_m), 1e-9))


def _read_places(place_map: PlaceMap) -> Iterator[Place]:
    for place_id, *_ in place_map.read_outlines():
        with suppress(PlaceError):
            yield from place_map.read_places([place_id])


def _write_poses(
    place_map: PlaceMap, placed: list[Place], recorded_at: list[Position], solved: GraphSolution, sure: Bools
) -> None:
    """Write the solved positions and poses to the map for the places where `sure`, bool (N,), is True. The others get
    their recorded positions again, and no pose."""
    origin = recorded_at[0]
    with place_map.transaction():
        for at, place in enumerate(placed):
            position, pose = recorded_at[at], None
            if sure[at]:
                var_m2, offset_m = float(solved.position_var[at]) / 2, solved.position[at]
                position = Position(*offset_position(origin.lat_deg, origin.lon_deg, offset_m.real, offset_m.imag))
                pose = Pose(
                    up_deg=float(-np.degrees(solved.log[at].imag)) % 360,
                    footprint_m=float(np.exp(solved.log[at].real)),
                    covariance_m2=(var_m2, 0.0, var_m2),
                    recorded=recorded_at[at],
                )
            if pose or place.pose is None or place.pose.recorded:
                place_map.move_place(place.place_id, position, pose)


def _find_median(values: Floats) -> float | None:
    return float(np.median(values)) if len(values) else None


def _find_likely_pairs(recorded: Complexes) -> list[Pair]:
    """Return the pairs of places that may overlap. `recorded`: positions, complex (N,) metres, in the order mapped."""
    count = len(recorded)
    pairs = {(at, at - before) for before in range(1, _PREVIOUS_PLACES + 1) for at in range(before, count)}
    return sorted(pairs | {(at, other) for at, other, _ in _pair_nearest(recorded, _NEAREST_PLACES)})


def _find_overlapping_pairs(position: Complexes, log: Complexes, of: Bools) -> list[Pair]:
    """Return the pairs of places that overlap according to a solved graph. `position` and `log` are those of
    `graph.GraphSolution`; only places where `of`, bool (N,), is True are considered."""
    members, footprint_m = np.flatnonzero(of), np.exp(log.real[of])
    near = _pair_nearest(position[members], _MAX_OVERLAPPING)
    return sorted(
        {
            (int(members[at]), int(members[other]))
            for at, other, away_m in near
            if away_m <= _MAX_OVERLAP_DISTANCE * min(footprint_m[at], footprint_m[other])
        }
    )


def _pair_nearest(position: Complexes, most: int) -> Iterator[tuple[int, int, float]]:
    """Pair each of N places, at `position`, complex (N,) metres, with the `most` places nearest to it. Yields (number
    of the later place, number of the earlier one, metres between them) for each pair; some pairs come twice."""
    if len(position) > 1:
        points = np.stack([position.real, position.imag], axis=1)
        away_m, near = cKDTree(points).query(points, k=min(most + 1, len(points)))
        for (at, nth), other in np.ndenumerate(near):
            if other != at:
                yield max(at, int(other)), min(at, int(other)), float(away_m[at, nth])


def _to_ties(tie_of: dict[Pair, Tie]) -> Ties:
    """Convert ties to the arrays that `graph.solve` takes."""
    query, place = np.array(list(tie_of), np.intp).reshape(-1, 2).T
    step, turn, step_sd, turn_sd = np.array(list(tie_of.values()), complex).reshape(-1, 4).T
    return Ties(query=query, place=place, step=step, turn=turn, step_sd=step_sd.real, turn_sd=turn_sd.real)


def _make_comparer(
    place_map: PlaceMap, technique: Technique, places: list[Place], images: str | Path | None
) -> ComparePair:
    """Return the function that compares two of `places`, given by their indices in this list, and returns their tie
    (None: none is found). `images` is the folder of their pictures (None: they are not at hand, so only landmarks are
    compared)."""
    paths = {decode_name(path.name): path for path in list_images(images)} if images else {}
    coarse = {place_id: part for place_id, *_, part in place_map.read_coarse_parts()}

    @lru_cache(_CACHED_LANDMARKS)
    def landmarks(at: int) -> Landmarks | None:
        try:
            blob = place_map.read_landmarks(places[at].place_id)
            return unpack_bytes(blob) if blob else None
        except (EdgevprError, ValueError):
            return None

    @lru_cache(_CACHED_DESCRIPTORS)
    def descriptor(at: int) -> Descriptor | None:
        if (path := paths.get(places[at].source_image)) is None:
            return None
        try:
            found = technique.encode(read_image(path))
        except EdgevprError:
            return None
        return found if place_map.has_descriptor(places[at].place_id, found.coarse) else None

    def compare_landmarks(query: int, place: int, expected: Overlay | None, least: int) -> Tie | None:
        one, other = landmarks(query), landmarks(place)
        found = None if one is None or other is None else measure_agreement(one, other, expected)
        if found is None or found.inliers < least or found.shift_share is None or found.rotation_deg is None:
            return None
        overlay = Overlay(found.shift_share, found.rotation_deg, found.scale)
        return Tie(*overlay.relative_pose, *_LANDMARK_SDS)

    def compare_pair(query: int, place: int) -> Tie | None:
        if tie := compare_landmarks(query, place, None, MIN_PROVEN_INLIERS):
            return tie
        asking, part = descriptor(query), coarse.get(places[place].place_id)
        if asking is None or part is None:
            return None
        try:
            fine, _ = place_map.read_fine_part(places[place].place_id)
        except EdgevprError:
            return None
        match = technique.match(asking, fine, _rank_hypotheses(technique, asking, part))
        if match.score < _MIN_SCORE:
            return None
        (dx, dy), cells = match.shift_cells or (0.0, 0.0), technique.spec.cells or 1
        vote = Overlay((dx / cells, dy / cells), match.rotation_deg or 0.0, match.height_ratio)
        tie = compare_landmarks(query, place, vote, MIN_CONFIRMED_INLIERS)
        return tie or (Tie(*vote.relative_pose, *_VOTE_SDS) if match.score >= _MIN_VOTE_SCORE else None)

    return compare_pair


def _rank_hypotheses(technique: Technique, query: Descriptor, coarse: Array) -> list[int]:
    """Return the hypotheses of rotation and height under which `Technique.match` should compare a query with a place,
    by its coarse part: the eight with the best scores, as numbers, the best first."""
    _, by_hypothesis = technique.score_places(query, coarse[None], None)
    assert by_hypothesis is not None  # set by techniques for a camera that looks down
    best = np.argsort(-by_hypothesis[0], kind="stable")[:_MAX_HYPOTHESES]
    ranked: list[int] = best[np.isfinite(by_hypothesis[0][best])].tolist()
    return ranked
