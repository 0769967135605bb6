"""`edgevpr map build`, `map refine` and `map calibrate`: make a map from a recording or an orthophoto, correct the
positions of its pictures, and calibrate the confidence of matches in it."""

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import (
    add_json,
    add_keys,
    add_parameters,
    add_recording,
    command,
    config_of,
    exit_code,
    leave_out,
    parameters_of,
    path_of,
    positive,
    print_json,
)
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import shown

if TYPE_CHECKING:
    from edgevpr.mapmaking.making import Cuttings, FlownPictures, MadeMap
    from edgevpr.mapmaking.refine import Refined


_WITHOUT_POSITIONS = (
    "no place has a position, and a map without positions sends no fixes: it only says which place is recognised. Give "
    "pictures with GPS in their EXIF data, or a positions.csv beside them (file,lat,lon[,alt,...], --positions); of a "
    "video, give --positions with time,lat,lon, in seconds from its first frame"
)
_OF_AN_ORTHOPHOTO = ("footprint_m", "spacing_m", "area", "margin_m")
_OF_A_RECORDING = ("positions", "rate_hz")


def add(maps: Any) -> None:
    """Add these commands and their flags to `maps`, the commands of `edgevpr map`."""
    build = command(maps, "build", map_build, "make a map of a flight, or of an orthophoto")
    build.add_argument("map", metavar="MAP", help="the map file to make, e.g. valley.gpkg")
    _add_pictures(build)
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
    calibrate = command(maps, "calibrate", map_calibrate, "find out how sure a map can be, with the pictures it is of")
    calibrate.add_argument("map", metavar="MAP")
    _add_pictures(calibrate)
    calibrate.add_argument("--config", metavar="FILE", help="that of the flight: its camera, mask and precision")
    add_keys(calibrate, "source.mask", "source.fov_deg", "source.up_deg")
    add_json(calibrate)


def _add_pictures(parser: ArgumentParser) -> None:
    """Add the flags for the pictures to make a map of: those of a recording, and those of an orthophoto."""
    add_recording(parser, required=False)
    flags = parser.add_argument_group("of an orthophoto, in place of --images")
    flags.add_argument("--orthophoto", metavar="FILE", help="GeoTIFF, VRT, MBTiles, or a folder of tiles (z/x/y.png)")
    flags.add_argument(
        "--footprint-m", type=float, metavar="M", help="ground along the longest side of a picture in flight"
    )
    flags.add_argument("--spacing-m", type=float, metavar="M", help="ground from place to place, e.g. a quarter")
    flags.add_argument(
        "--area", metavar="FILE", help="only over this: a mission (waypoints, QGC .plan) or GeoJSON (default: all)"
    )
    flags.add_argument(
        "--margin-m", type=float, metavar="M", help="this far beside the path of --area (default: the footprint)"
    )


def _pictures(args: Namespace) -> "FlownPictures | Cuttings":
    """Return the pictures that the flags name. Raises UsageError if they name neither a recording nor an orthophoto, or
    both, or have a flag that goes with the one not named."""
    from edgevpr.mapmaking.making import Cuttings, FlownPictures

    if (args.source is None) == (args.orthophoto is None):
        raise UsageError("Give either --images (pictures of a flight) or --orthophoto: a map is made of one of them.")
    others = _OF_AN_ORTHOPHOTO if args.orthophoto is None else _OF_A_RECORDING
    if given := [name for name in others if getattr(args, name, None) is not None]:
        source = "--orthophoto" if args.orthophoto is None else "--images"
        raise UsageError(f"--{given[0].replace('_', '-')} goes with {source}: leave it out.")
    if args.source is not None:
        rate_hz = getattr(args, "rate_hz", None)
        return FlownPictures(source=args.source, positions=path_of(args.positions), rate_hz=rate_hz)
    if args.footprint_m is None or args.spacing_m is None:
        raise UsageError("--orthophoto needs --footprint-m (ground along a picture's longest side) and --spacing-m.")
    if args.margin_m is not None and not (args.area and 0 <= args.margin_m < float("inf")):
        raise UsageError(f"--margin-m {args.margin_m:g}: give 0 or more, with --area.")
    return Cuttings(
        orthophoto=args.orthophoto,
        footprint_m=args.footprint_m,
        spacing_m=args.spacing_m,
        area=args.area,
        margin_m=args.margin_m,
    )


def map_build(args: Namespace) -> int:
    """Run `map build`: make a map from a recording or an orthophoto, or add to one."""
    from edgevpr.core.text import progress
    from edgevpr.mapmaking.making import MapOrder, make_map

    config = config_of(args, args.config)
    order = MapOrder(
        path=args.map,
        pictures=_pictures(args),
        technique=args.technique,
        parameters=parameters_of(args.param),
        board=args.board,
        append=args.append,
        refine=args.refine,
        calibrate=args.calibrate,
    )
    unusable: list[ImageError] = []
    made = make_map(order, config, lambda error: leave_out(error, unusable), progress)
    if args.json:
        more: dict[str, Any] = {"refined": asdict(made.refined)} if made.refined else {}
        more |= {"calibration": made.calibration.figures()} if made.calibration else {}
        more |= {} if made.without_data is None else {"without_data": made.without_data}
        about = {"map": args.map, "technique": made.technique, "places": made.places}
        print_json({**about, **asdict(made.result), **more})
    else:
        _print_made(args.map, made)
    return exit_code(unusable)


def _print_made(path: str, made: "MadeMap") -> None:
    result = made.result
    print(f"{path}: {result.added} places added ({result.without_position} without a position), {made.places} in all")
    if result.already_here:
        print(f"  {result.already_here} images were in the map already")
    if result.not_memorable:
        lacking = ", ".join(f"{count} for want of {what}" for what, count in result.not_memorable.items())
        print(f"  left out: {lacking}")
    if made.without_data is not None:
        print(f"  left out: {made.without_data} for want of data, {result.says_nothing} for want of texture")
    if result.of_low_quality:
        print(f"  {result.of_low_quality} of the places are of low quality, kept to bound the gaps")
    if made.refined:
        _print_refined(path, made.refined, made.cells)
    if made.calibration:
        print(f"expect: {made.calibration.described()}")
    if made.places and not made.with_position:
        print(f"{path}: {_WITHOUT_POSITIONS}")


def map_refine(args: Namespace) -> int:
    """Run `map refine`: correct the positions of a map's pictures by comparing them, and print the result."""
    from edgevpr.core.text import progress
    from edgevpr.mapmaking.making import refine_map
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.recognise.opening import technique_of

    with PlaceMap.open_for_adding(args.map) as place_map:
        technique = technique_of(place_map)
        refined = refine_map(place_map, technique, args.images, progress)
    if args.json:
        print_json({"map": args.map, **asdict(refined)})
    else:
        _print_refined(args.map, refined, technique.spec.cells)
    return 0


def map_calibrate(args: Namespace) -> int:
    """Run `map calibrate`: calibrate the confidence of matches in a map, and print what to expect of the map."""
    from edgevpr.core.text import progress
    from edgevpr.mapmaking.making import calibrate_map
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.recognise.opening import technique_of

    config, pictures = config_of(args, args.config), _pictures(args)
    with PlaceMap.open_for_adding(args.map) as place_map:
        found = calibrate_map(place_map, technique_of(place_map), config, pictures, progress)
    if args.json:
        print_json({"map": args.map, "calibration": found.figures()})
    else:
        print(f"{args.map}: calibrated: {found.described()}")
    return 0


def _print_refined(path: str, refined: "Refined", cells: int | None) -> None:
    if refined.without_position == refined.places:
        print("  not refined: no place has a position")
        return
    print(f"{path}: {refined.refined} of {refined.places} places refined, by {refined.ties} ties between pictures")
    if refined.footprint_m and cells:
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
