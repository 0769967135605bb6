"""`edgevpr map build` and `map refine`: places of a recording or an orthophoto, and where their pictures really lie."""

import sys
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli import calibrating, orthophotos
from edgevpr.cli.shared import (
    add_json,
    add_keys,
    add_parameters,
    add_recording,
    command,
    config_of,
    exit_code,
    frames_of,
    leave_out,
    parameters_of,
    path_of,
    positive,
    print_json,
    watched,
)  # fmt: skip
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.text import shown

if TYPE_CHECKING:
    from edgevpr.core.contract import Technique
    from edgevpr.frames.source import Source
    from edgevpr.mapmaking.refine import Refined
    from edgevpr.places.mapfile import PlaceMap


_WITHOUT_POSITIONS = (
    "no place has a position, and a map without positions sends no fixes: it only says which place is recognised. Give "
    "pictures with GPS in their EXIF data, or a positions.csv beside them (file,lat,lon[,alt,...], --positions); of a "
    "video, give --positions with time,lat,lon, in seconds from its first frame"
)


def add(maps: Any) -> None:
    """Add the commands and their flags to those of maps."""
    build = command(maps, "build", map_build, "make a map of a flight, or of an orthophoto")
    build.add_argument("map", metavar="MAP", help="the map file to make, e.g. valley.gpkg")
    add_recording(build, required=False)
    orthophotos.add(build)
    build.add_argument("--technique", metavar="NAME", help="see `edgevpr profile` (default: by the board)")
    add_parameters(build, "a parameter of the technique")
    build.add_argument(
        "--board", default="this", metavar="NAME", help="the board that will fly (default: this machine)"
    )
    build.add_argument("--config", metavar="FILE", help="that of the flight: its camera, mask and salience")
    add_keys(build, "source.camera", "source.mask", "source.fov_deg", "source.up_deg", "salience.use")
    build.add_argument(
        "--rate-hz", type=positive, metavar="HZ", help="places a second of a video (default: every frame)"
    )
    build.add_argument(
        "--no-refine", dest="refine", action="store_false", help="do not find out where the pictures really lie"
    )
    build.add_argument(
        "--no-calibrate", dest="calibrate", action="store_false", help="do not find out how sure the map can be"
    )
    build.add_argument("--append", action="store_true", help="add to an existing map, going on where it broke off")
    add_json(build)
    refine = command(maps, "refine", map_refine, "find out where the pictures really lie, by matching them")
    refine.add_argument("map", metavar="MAP")
    refine.add_argument(
        "--images", metavar="DIR", help="the images that the map was made of: with them more pictures are tied"
    )
    add_json(refine)


def map_build(args: Namespace) -> int:
    """Make a map of a recording, or continue one."""
    from edgevpr.frames.mask import mask_of
    from edgevpr.mapmaking.mapping import Gaps, Preparation, Selection, build_map
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.places.mapfiles import map_path, remove
    from edgevpr.places.mapinfo import info_of
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.pick import camera_setting, picked_technique
    from edgevpr.runtime.recognise.levelling import NoLevelling, levelling_of
    from edgevpr.runtime.recognise.opening import gate_of, made_for, meter_of, say_other_mask, technique_of

    config = config_of(args, args.config)
    path = map_path(args.map)
    orthophotos.require_one_source(args)
    is_cut = args.orthophoto is not None
    camera = orthophotos.camera_of(config.source.camera) if is_cut else config.source.camera
    source = orthophotos.open_cuttings(args) if is_cut else _recording(args)
    mask = mask_of(None if is_cut else config.source.mask)  # the mask hides parts of the aircraft, not of the ground
    settings, here = parameters_of(args.param), load_board("this")
    gate = gate_of(config.salience, here.threads)
    gaps = Gaps(config.salience.gap_frames, config.salience.gap_m)

    def asked(name: str) -> dict[str, str]:
        said = {"camera": camera} if camera else {}
        return settings | (camera_setting(name, camera) if is_cut else said)

    is_new = not (args.append and path.exists())
    if not is_new:
        place_map = PlaceMap.open_for_adding(path)
        technique = technique_of(place_map, args.technique, asked(args.technique or place_map.spec.name), here)
        say_other_mask(place_map, mask)
    else:
        if name := args.technique or (orthophotos.TECHNIQUE if is_cut else None):
            technique = made_for(here, name, asked(name))
        else:
            name = picked_technique(args.board, source.total or 1, camera)
            technique = made_for(here, name, settings | camera_setting(name, camera))
        place_map = PlaceMap.create(path, technique.spec)
        place_map.record_mask(mask.sha256)
    unusable: list[ImageError] = []
    with place_map:
        frames = frames_of(source, "mapping", unusable)
        meter = meter_of(config, here)
        # What is cut lies on the ground already, and no lens has seen it.
        levelling = NoLevelling() if is_cut else levelling_of(config.source, technique, below=True)
        preparation = Preparation(mask=mask, levelling=levelling)
        try:
            result = build_map(
                frames,
                technique,
                place_map,
                meter,
                preparation,
                Selection(gate=gate, gaps=gaps, min_quality=technique.min_quality if is_cut else 0.0),
                lambda error: leave_out(error, unusable),
            )
        except EdgevprError:
            if is_new and not len(place_map):  # a full disk: an empty map would only stand in the way of the next try
                remove(path)
            raise
        places = len(place_map)
        has_positions = info_of(place_map).with_position > 0
        refined = _refined_after(place_map, technique, args) if args.refine else None
        calibrated = None
        if args.calibrate:
            calibrated = calibrating.calibrated_after(
                technique,
                lambda: calibrating.calibrated(args, place_map, technique, config.match, meter, preparation),
            )
    if args.json:
        more = {"refined": asdict(refined)} if refined else {}
        more |= {"calibration": calibrated.figures()} if calibrated else {}
        more |= {"without_data": source.without_data} if is_cut else {}
        print_json({"map": args.map, "technique": technique.spec.name, "places": places, **asdict(result), **more})
    else:
        print(
            f"{args.map}: {result.added} places added ({result.without_position} without a position), {places} in all"
        )
        if result.already_here:
            print(f"  {result.already_here} images were in the map already")
        if result.not_memorable:
            lacking = ", ".join(f"{count} for want of {what}" for what, count in result.not_memorable.items())
            print(f"  left out: {lacking}")
        if is_cut:
            print(f"  left out: {source.without_data} for want of data, {result.says_nothing} for want of texture")
        if result.of_low_quality:
            print(f"  {result.of_low_quality} of the places are of low quality, kept to bound the gaps")
        if refined:
            _print_refined(args.map, refined, technique.spec.cells)
        if calibrated:
            print(f"expect: {calibrated.said()}")
        if places and not has_positions:
            print(f"{args.map}: {_WITHOUT_POSITIONS}")
    return exit_code(unusable)


def _recording(args: Namespace) -> "Source":
    from edgevpr.frames.source import open_source

    step_s = 1 / args.rate_hz if args.rate_hz else None
    return open_source(args.source, step_s=step_s, positions=path_of(args.positions), live=False)


def map_refine(args: Namespace) -> int:
    """Find out where the pictures of a map really lie, and say it."""
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.recognise.opening import technique_of

    with PlaceMap.open_for_adding(args.map) as place_map:
        technique = technique_of(place_map)
        refined = _refined(place_map, technique, args.images)
    if args.json:
        print_json({"map": args.map, **asdict(refined)})
    else:
        _print_refined(args.map, refined, technique.spec.cells)
    return 0


def _refined_after(place_map: "PlaceMap", technique: "Technique", args: Namespace) -> "Refined | None":
    """Refine a map that has just been built, where anything can be refined; the map is whole without it."""
    if technique.spec.cells is None:
        return None
    try:
        return _refined(place_map, technique, args.source if args.source and Path(args.source).is_dir() else None)
    except EdgevprError as error:
        print(f"edgevpr: the map is not refined: {error}", file=sys.stderr)
        return None


def _refined(place_map: "PlaceMap", technique: "Technique", images: str | None) -> "Refined":
    """Refine an open map. Raises UsageError for one that nothing can be refined of, and where SciPy is missing."""
    if technique.spec.cells is None:
        raise UsageError(
            f"{place_map.path} is of {technique.spec.name}, and not of a camera that looks straight down: only `cohog` "
            "with `--camera nadir` can be refined."
        )
    try:
        from edgevpr.mapmaking.refine import refine
    except ModuleNotFoundError as error:
        raise UsageError(
            f"Refining a map needs SciPy ({error}): install it on the machine that builds maps, with "
            "`pip install 'edgevpr[maps]'`, and run `edgevpr map refine`."
        ) from error
    return refine(place_map, technique, watched("refining"), images)


def _print_refined(path: str, refined: "Refined", cells: int | None) -> None:
    if refined.without_position == refined.places:
        print("  not refined: no place has a position")
        return
    print(f"{path}: {refined.refined} of {refined.places} places refined, by {refined.ties} ties between pictures")
    if refined.refined:
        scatter = f"as recorded they scatter by {refined.recorded_sd_m:.1f} m"
        moved = f"moved by {refined.moved_m:.1f} m, known to {refined.position_sd_m:.1f} m (medians)"
        print(f"  position    {moved}; {scatter}")
        print(f"  footprint   {refined.footprint_m:.0f} m (median), {refined.footprint_m / cells:.2f} m a cell")
    if refined.surveyed:
        print(f"  surveyed    {refined.surveyed} were cut from a geo-referenced picture, and stay as they are")
    if refined.not_tied:
        print(f"  not tied    {refined.not_tied} stay where they were recorded: a fix there is as fine as the spacing")
    if refined.without_position:
        print(f"  no position {refined.without_position} places")
    for place_id, image, off_m in refined.contradictory:
        print(f"  amiss       place {place_id} ({shown(image)}): recorded {off_m:.0f} m from where its picture lies")
