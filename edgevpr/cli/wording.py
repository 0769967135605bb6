"""Texts of the results that people read most: of building and checking maps, and of replays. Each function yields the
lines of one result; JSON has the same values by name (see `print_result`)."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from edgevpr.core.text import format_offset, sanitize

if TYPE_CHECKING:
    from edgevpr.mapmaking.making import BuiltMap
    from edgevpr.mapmaking.moving import MapMove
    from edgevpr.mapmaking.refine import Refinement
    from edgevpr.places.examine import MapCheck
    from edgevpr.places.mapinfo import MapInfo
    from edgevpr.review.compare import LineComparison, PacketComparison
    from edgevpr.review.replay import ReplayResult

NO_POSITIONS_NOTE = (
    "no place has a position, so flights with this map send no fixes and only report which place was recognised. Give "
    "pictures with GPS in their EXIF data, or a positions.csv next to them (file,lat,lon[,alt,...], --positions); for "
    "a video, give --positions with time,lat,lon, the time in seconds from its first frame"
)
# Figures from benchmarks/results/from_space.md, with a raster of half a metre per pixel.
_OTHER_SEASON_NOTE = (
    "fewer on another day: months and an earthquake later 48 % of single images were accepted with heading and height "
    "known (3 to 8 of twelve in a row), 23 % without (0 to 6); to measure this ground, `match` images that `simulate "
    "flight` generates from another orthophoto"
)
_MAX_DIFFERENCES = 20  # maximum number of replay differences printed


def format_build(path: str, built_map: "BuiltMap", from_orthophoto: bool) -> Iterator[str]:
    """Yield what `map build` has built, and what to expect from the map. `from_orthophoto`: it was cut from one."""
    result = built_map.result
    places = f"{result.added} places added ({result.without_position} without a position)"
    yield f"{path}: {places}, {built_map.places} in total"
    if result.already_here:
        yield f"  {result.already_here} images were already in the map"
    if result.tilted:
        yield f"  left out: {result.tilted} tilted by more than 63 degrees (without --fov-deg or --lens: 20)"
    if result.without_heading:
        yield f"  left out: {result.without_heading} tilted by more than 20 degrees, heading unknown (add yaw_deg)"
    if result.not_memorable:
        yield f"  left out: {result.not_memorable} not memorable"
    if result.without_data or result.low_texture:
        yield f"  left out: {result.without_data} without data, {result.low_texture} with too little texture"
    if result.white:
        yield f"  {result.white} of the places are at least a third white: clouds and snow do not last"
    if result.of_low_quality:
        yield f"  {result.of_low_quality} of the places are of low quality, kept to limit the gaps"
    if built_map.refined:
        yield from format_refinement(path, built_map.refined)
    if built_map.calibration:
        yield f"expect: {built_map.calibration.describe()}"
        if from_orthophoto:
            yield f"  {_OTHER_SEASON_NOTE}"
    yield from (f"  {sentence}" for sentence in built_map.not_done)
    if built_map.places and not built_map.with_position:
        yield f"{path}: {NO_POSITIONS_NOTE}"


def format_refinement(path: str, refined: "Refinement") -> Iterator[str]:
    """Yield the lines of a refined map: how many places moved, by how far, and which were recorded far off."""
    if refined.without_position == refined.places:
        yield "  not refined: no place has a position"
        return
    yield f"{path}: {refined.refined} of {refined.places} places refined, using {refined.ties} links between images"
    if refined.footprint_m:
        moved = f"corrected by {refined.moved_m:.1f} m, now accurate to {refined.position_sd_m:.1f} m (medians)"
        yield f"  position    {moved}; the GPS tags scatter by {refined.recorded_sd_m:.1f} m"
        yield f"  footprint   an image shows {refined.footprint_m:.0f} m of ground along its longest side (median)"
    if refined.surveyed:
        yield f"  surveyed    {refined.surveyed} cut from an orthophoto keep their position"
    if not_tied := refined.places - refined.without_position - refined.surveyed - refined.refined:
        yield f"  not linked  {not_tied} keep their recorded position, height and heading, which are less accurate"
    for place_id, image, distance_m in refined.contradictory:
        yield f"  GPS tag     place {place_id} ({sanitize(image)}): {distance_m:.0f} m from its refined position"


def format_info(info: "MapInfo", confidence: str | None, ram_mb: float) -> Iterator[str]:
    """Yield what a map contains. `confidence`: a sentence on the confidence of its matches (None: they are judged by
    fixed limits). `ram_mb`: memory that the map needs in flight."""
    spec = info.spec
    settings = ", ".join(f"{key} {value}" for key, value in spec.parameters.items())
    yield f"{info.path}: {info.places} places, {info.with_position} with a position"
    yield f"  technique   {spec.name} ({settings})" + (f", model {spec.model_sha256}" if spec.model_sha256 else "")
    if info.extent:
        south, west, north, east = info.extent
        yield f"  extent      {south:.6f}..{north:.6f} north, {west:.6f}..{east:.6f} east"
    if info.first_time:
        yield f"  time        {info.first_time} to {info.last_time}"
    if info.with_pose:
        lengths = " or ".join(f"{footprint_m:.0f}" for footprint_m in info.footprints_m)
        footprint = f"an image shows {lengths} m of ground along its longest side"
        yield f"  pose        {info.with_pose} places, accurate to {info.position_sd_m:.1f} m; {footprint}"
    if info.of_low_quality:
        yield f"  salience    {info.of_low_quality} of low quality, kept to limit the gaps"
    if info.one_way_deg is not None:
        yield f"  one way     {info.one_way_warning}"
    if info.attribution:
        yield f"  cut from    {info.attribution}"
    if confidence:
        yield f"  confidence  {confidence}"
    yield f"  size        {info.file_bytes / 1e6:.1f} MB on disk, {ram_mb:.2f} MB in RAM"


def format_move(path: str, move: "MapMove") -> Iterator[str]:
    """Yield how `map move` moved a map."""
    yield f"{path}: {move.places} places moved {format_offset(move.east_m, move.north_m)}, +-{move.sd_m:.1f} m"
    if move.scale is not None:
        yield f"  scale       divided by {1 + move.scale:.4f}, about {move.middle[0]:.6f}, {move.middle[1]:.6f}"


def format_check(result: "MapCheck") -> Iterator[str]:
    """Yield the result of `map check`: how many places can be read, and what is damaged."""
    yield f"{result.path}: {result.places} of {result.total} places can be read"
    yield from (f"  damaged     place {place_id}: {problem}" for place_id, problem in result.damaged)
    yield from (f"  SQLite      {fault}" for fault in result.faults or ("the file is intact",))


def format_replay(replay: "ReplayResult", lines: "LineComparison", packets: "PacketComparison") -> Iterator[str]:
    """Yield how a replay differs from its flight: in the `lines` of its log, the `packets` it sent, and its end."""
    differences = [*map(_format_difference, lines.others), *packets.others]
    yield from differences[:_MAX_DIFFERENCES]
    if (omitted := len(differences) - _MAX_DIFFERENCES) > 0:
        yield f"... and {omitted} more (--json has all)"
    yield from (f"The program differs: {name} was {old}, is {new}" for name, (old, new) in lines.program.items())
    yield f"{sum(line.get('kind') == 'query' for line in replay.lines)} queries replayed"
    yield f"log      {lines.alike} lines are equal, {len(lines.others)} differ"
    yield f"MAVLink  {packets.alike} packets are equal, {len(packets.others)} differ"
    if replay.guessed:
        yield f"{replay.guessed} inputs were not recorded where this version reads them, so their values were guessed."
    if replay.why_ended:
        yield f"The replay ended before the flight: {replay.why_ended}; the flight has {lines.after} more lines."
    elif lines.after:
        yield f"{lines.after} lines of the flight are missing from the replay."


def _format_difference(difference: dict[str, Any]) -> str:
    where = f"{difference['t_mono_s']:.3f} s, {difference['query'] or difference['kind']}"
    if "only_in" in difference:
        return f"{where}: only in the {difference['only_in']}"
    return f"{where}: {', '.join(f'{name} was {old}, is {new}' for name, (old, new) in difference['fields'].items())}"
