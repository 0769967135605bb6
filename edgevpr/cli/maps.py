"""`edgevpr map`: build, refine, move, calibrate, inspect, check, repair, merge and cut maps; and `edgevpr salience`:
print how memorable, static and rich in information an image is."""

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli import shared
from edgevpr.cli.wording import format_build, format_check, format_info, format_move, format_refinement
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import progress

if TYPE_CHECKING:
    from edgevpr.mapmaking.pictures import FlightPictures, OrthophotoGrid

_ORTHOPHOTO_FLAGS = ("footprint_m", "spacing_m", "area", "attribution")
_RECORDING_FLAGS = ("positions", "rate_hz")
_MISSION_MARGIN_M = 500.0


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    maps = shared.add_group(commands, "map", "build, refine, calibrate, inspect, check, repair, merge and cut maps")

    def add_to_map(name: str, run: shared.Run, text: str, map_help: str = "") -> ArgumentParser:
        parser = shared.add_command(maps, name, run, text)
        parser.add_argument("map", metavar="MAP", help=map_help or None)
        return parser

    build = add_to_map("build", run_map_build, "build a map from images or from an orthophoto", "map to write (.gpkg)")
    _add_build(build)
    refine = add_to_map("refine", run_map_refine, "refine the positions of the places by matching their images")
    refine.add_argument("--images", metavar="DIR", help="images that the map was built from")
    shared.add_json(refine)
    move = add_to_map("move", run_map_move, "shift a map by the offset from GPS that a flight measured")
    move.add_argument("--by", metavar="LOG", required=True, help="log of a flight with this map and with GPS")
    shared.add_json(move)
    calibrate = add_to_map("calibrate", run_map_calibrate, "calibrate match confidence from the map's own images")
    _add_pictures(calibrate)
    calibrate.add_argument("--config", metavar="FILE", help="configuration (only `source` and precision are used)")
    shared.add_keys(calibrate, "source.mask", "source.lens", "source.fov_deg", "source.up_deg")
    shared.add_json(calibrate)
    info = add_to_map("info", run_map_info, "print what a map contains, or write it as an HTML page")
    info.add_argument("--page", metavar="FILE", help="write an HTML page that opens offline")
    shared.add_map_images(info)
    info.add_argument("--config", metavar="FILE", help="configuration of the mapping flight (only its lens)")
    shared.add_keys(info, "source.lens", "source.fov_deg", "source.up_deg")
    shared.add_json(info)
    shared.add_json(add_to_map("check", run_map_check, "read the whole map and report what is damaged"))
    shared.add_json(add_to_map("repair", run_map_repair, "remove damaged places; keep the original as MAP.damaged"))
    merge = shared.add_command(maps, "merge", run_map_merge, "merge maps of the same technique")
    merge.add_argument("out", metavar="OUT", help="map to write")
    merge.add_argument("maps", metavar="MAP", nargs="+")
    shared.add_json(merge)
    _add_subset(add_to_map("subset", run_map_subset, "cut out the part that a mission needs", "map, or folder of maps"))
    salience = shared.add_command(commands, "salience", run_salience, "print how memorable an image is")
    salience.add_argument("image", metavar="IMAGE")
    salience.add_argument("--config", metavar="FILE", help="configuration file; its section `salience` is used")
    shared.add_json(salience)


def _add_build(build: ArgumentParser) -> None:
    _add_pictures(build)
    build.add_argument("--technique", metavar="NAME", help="technique (default: cohog)")
    shared.add_parameters(build, "set a parameter of the technique")
    build.add_argument("--config", metavar="FILE", help="configuration (only `source` and salience are used)")
    shared.add_keys(
        build, "source.camera", "source.mask", "source.lens", "source.fov_deg", "source.up_deg", "salience.use"
    )
    build.add_argument("--rate-hz", type=shared.parse_positive, metavar="HZ", help="places per second of a video")
    build.add_argument("--no-refine", dest="refine", action="store_false", help="keep the recorded positions")
    build.add_argument("--no-calibrate", dest="calibrate", action="store_false", help="skip the confidence calibration")
    build.add_argument("--attribution", metavar="TEXT", help="attribution that the orthophoto's licence requires")
    build.add_argument("--append", action="store_true", help="add to an existing map, or resume an interrupted build")
    shared.add_json(build)


def _add_subset(parser: ArgumentParser) -> None:
    text = "Mission Planner waypoints, QGroundControl .plan, or LAT,LON,RADIUS_M"
    parser.add_argument("--mission", metavar="FILE", required=True, help=text)
    parser.add_argument("--out", metavar="MAP", required=True, help="map to write")
    text = "margin around the mission in metres (default: %(default)g)"
    parser.add_argument("--margin-m", type=shared.parse_positive, metavar="M", default=_MISSION_MARGIN_M, help=text)
    parser.add_argument("--mb", type=shared.parse_positive, metavar="MB", help="maximum size in MB (default: no limit)")
    shared.add_json(parser)


def _add_pictures(parser: ArgumentParser) -> None:
    """Add the flags for the pictures of a map: those for a recording and those for an orthophoto."""
    shared.add_recording(parser, required=False)
    flags = parser.add_argument_group("from an orthophoto, instead of --images")
    flags.add_argument("--orthophoto", metavar="FILE", help="GeoTIFF, VRT or MBTiles file")
    text = "ground covered by the longest side of an image, in metres; a list for several heights: 75,105,150"
    flags.add_argument("--footprint-m", type=_parse_lengths, metavar="M", help=text)
    text = "distance between places in metres, for example a quarter of the footprint"
    flags.add_argument("--spacing-m", type=float, metavar="M", help=text)
    text = "area to map: a mission (its path and a footprint on either side), or LAT,LON,RADIUS_M"
    flags.add_argument("--area", metavar="AREA", help=text)


def _parse_lengths(text: str) -> tuple[float, ...]:
    """Parse "75,105,150"; the `type` of a flag. Raises ArgumentTypeError for any other text."""
    try:
        return tuple(map(float, text.split(",")))
    except ValueError:
        raise ArgumentTypeError(f"`{text}` is not a length in metres or a comma-separated list of lengths") from None


def _parse_pictures(args: Namespace) -> "FlightPictures | OrthophotoGrid":
    """Return the pictures given by the flags: those of a recording or of an orthophoto. Raises UsageError."""
    from edgevpr.mapmaking.pictures import FlightPictures, OrthophotoGrid

    if (args.source is None) == (args.orthophoto is None):
        raise UsageError("Pass either --images (pictures of a flight) or --orthophoto: a map is built from one.")
    inapplicable = _ORTHOPHOTO_FLAGS if args.orthophoto is None else _RECORDING_FLAGS
    if misplaced := [name for name in inapplicable if getattr(args, name, None) is not None]:
        source = "--orthophoto" if args.orthophoto is None else "--images"
        raise UsageError(f"--{misplaced[0].replace('_', '-')} applies only to {source}: leave it out.")
    if args.source is not None:
        rate_hz = getattr(args, "rate_hz", None)
        return FlightPictures(source=args.source, positions=shared.to_path(args.positions), rate_hz=rate_hz)
    if args.footprint_m is None or args.spacing_m is None:
        raise UsageError("--orthophoto needs --footprint-m (ground along a picture's longest side) and --spacing-m.")
    options: dict[str, Any] = {name: getattr(args, name, None) for name in _ORTHOPHOTO_FLAGS}
    return OrthophotoGrid(orthophoto=args.orthophoto, **options)


def run_map_build(args: Namespace) -> int:
    """Run `map build`: build a map from a recording or an orthophoto, or add to an existing map."""
    from edgevpr.mapmaking.making import MapPlan, make_map

    config = shared.make_config(args, args.config)
    plan = MapPlan(
        path=args.map,
        pictures=_parse_pictures(args),
        technique=args.technique,
        parameters=shared.parse_parameters(args.param),
        append=args.append,
        refine=args.refine,
        calibrate=args.calibrate,
    )
    unusable: list[ImageError] = []
    built_map = make_map(plan, config, lambda error: shared.skip_image(error, unusable), progress)
    parts = {
        "covered": built_map.covered and asdict(built_map.covered),
        "refined": built_map.refined and asdict(built_map.refined),
        "calibration": built_map.calibration and built_map.calibration.figures(),
        "not_done": built_map.not_done,
    }
    fields = {"map": args.map, "technique": built_map.technique, "places": built_map.places, **asdict(built_map.result)}
    fields |= {name: part for name, part in parts.items() if part}
    shared.print_result(fields, args.json, format_build(args.map, built_map, args.orthophoto is not None))
    return shared.report_unusable(unusable)


def run_map_refine(args: Namespace) -> None:
    """Run `map refine`: correct the positions of a map's places by matching their pictures, and print the result."""
    from edgevpr.mapmaking.finishing import refine_map
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.recognise.opening import create_technique

    with PlaceMap.open_for_writing(args.map) as place_map:
        refined = refine_map(place_map, create_technique(place_map), args.images, progress)
    shared.print_result({"map": args.map, **asdict(refined)}, args.json, format_refinement(args.map, refined))


def run_map_move(args: Namespace) -> None:
    """Run `map move`: move the places of a map by the offset from GPS that a flight measured, and print the move."""
    from edgevpr.mapmaking.moving import move_map
    from edgevpr.places.mapfile import PlaceMap

    with PlaceMap.open_for_writing(args.map) as place_map:
        move = move_map(place_map, args.by)
    shared.print_result({"map": args.map, **asdict(move)}, args.json, format_move(args.map, move))


def run_map_calibrate(args: Namespace) -> None:
    """Run `map calibrate`: calibrate the confidence of matches in a map, and print what to expect from the map."""
    from edgevpr.mapmaking.finishing import calibrate_map, make_encoder
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.recognise.opening import create_technique

    config, pictures = shared.make_config(args, args.config), _parse_pictures(args)
    with PlaceMap.open_for_writing(args.map) as place_map:
        encoder = make_encoder(config.source, pictures, create_technique(place_map))
        calibration = calibrate_map(place_map, encoder, config.match, pictures, progress)
    fields = {"map": args.map, "calibration": calibration.figures()}
    shared.print_result(fields, args.json, [f"{args.map}: calibrated: {calibration.describe()}"])


def run_map_info(args: Namespace) -> None:
    """Run `map info`: print what a map contains and its size on disk and in RAM; with --page, make an HTML page too."""
    from edgevpr.places.index import compute_place_bytes
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.places.mapinfo import describe_map
    from edgevpr.runtime.recognise.calibration import explain_not_calibrated, read_calibration_for
    from edgevpr.techniques import CONFIDENCE_TECHNIQUE

    if args.page:
        shared.check_output(args.page, args.map)
    with PlaceMap.open(args.map) as place_map:
        info, calibration = describe_map(place_map), read_calibration_for(place_map)
    place_bytes = compute_place_bytes(info.spec)
    if calibration:
        confidence: str | None = f"calibrated {calibration.made}: {calibration.describe()}"
    else:
        confidence = explain_not_calibrated(info.spec, info.places) if info.spec.name == CONFIDENCE_TECHNIQUE else None
    ram_mb = info.places * place_bytes / 1e6
    figures = {"calibration": calibration.figures() if calibration else None, "bytes_per_place": place_bytes}
    lines = list(format_info(info, confidence, ram_mb))
    shared.print_result({**asdict(info), **figures, "ram_mb": ram_mb}, args.json, lines)
    if args.page:
        _write_page(args, lines, calibration.recognisable if calibration else {})


def _write_page(args: Namespace, lines: list[str], recognisable: Mapping[int, float]) -> None:
    """Write the page of a map. `lines`: the output of `map info`."""
    from edgevpr.mapmaking.look_alikes import find_look_alikes
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.review.album import make_map_album
    from edgevpr.review.mappage import MAX_QUERIES, make_map_page
    from edgevpr.runtime.recognise.levelling import read_camera_lens

    lens = read_camera_lens(shared.make_config(args, args.config).source)
    with PlaceMap.open(args.map) as place_map:
        places = list(place_map.read_places())
        upright = place_map.spec.parameters.get("camera") != "nadir"
        pictures = make_map_album(args.map_images, places, upright=upright)
        queried = places[:: -(-len(places) // MAX_QUERIES) or 1] if pictures else []
        queries = (
            (place.place_id, picture.image, picture.mask)
            for place in progress(queried, len(queried), "look-alikes")
            if (picture := pictures.level_picture(place, lens))
        )
        look_alikes = list(find_look_alikes(place_map, queries))
    page = make_map_page(Path(args.map).name, lines, places, recognisable, look_alikes, pictures, lens)
    shared.write_output(args.page, args.map, page)
    if not args.json:
        print(f"{args.page}: {len(places)} places of {args.map}")


def run_map_check(args: Namespace) -> int:
    """Run `map check`: read the whole map and print what is damaged. The exit code is 1 if anything is damaged."""
    from edgevpr.places.examine import check_map

    result = check_map(args.map, progress)
    shared.print_result({**asdict(result), "is_whole": result.is_intact}, args.json, format_check(result))
    return 0 if result.is_intact else 1


def run_map_repair(args: Namespace) -> None:
    """Run `map repair`: remove the damaged places of a map, and keep the original file."""
    from edgevpr.places.examine import check_map, repair_map

    result = check_map(args.map, progress)
    original = None if result.is_intact else repair_map(args.map, progress)
    dropped = result.total - result.places
    fields = {"path": args.map, "kept": result.places, "dropped": dropped, "original": original and str(original)}
    repaired = f"{args.map}: repaired, {result.places} places kept, {dropped} removed; the original is now {original}"
    text = "no damage: the map is unchanged" if original is None else repaired
    shared.print_result(fields, args.json, [*format_check(result), text])


def run_map_merge(args: Namespace) -> None:
    """Run `map merge`: merge several maps into one."""
    from edgevpr.places.examine import merge_maps
    from edgevpr.places.mapfiles import parse_map_path

    counts, were_calibrated = merge_maps(args.maps, parse_map_path(args.out), progress)
    parts = [
        {"map": path, "copied": copied, "already_here": already_here}
        for path, (copied, already_here) in zip(args.maps, counts, strict=True)
    ]
    merged = {"map": args.out, "places": sum(copied for copied, _ in counts), "of": parts}
    text = [f"{part['map']}: {part['copied']} places copied, {part['already_here']} already there" for part in parts]
    text.append(f"{args.out}: {merged['places']} places")
    text += shared.describe_lost_calibration(args.out, were_calibrated)
    shared.print_result({**merged, "lost_calibration": were_calibrated}, args.json, text)


def run_map_subset(args: Namespace) -> None:
    """Run `map subset`: cut out the map of a mission, and print what is left out."""
    from edgevpr.mapmaking.missions import read_area
    from edgevpr.mapmaking.subset import make_subset
    from edgevpr.places.mapfiles import parse_map_path

    area, out = read_area(args.mission), parse_map_path(args.out)
    result = make_subset(Path(args.map), area, args.margin_m, out, args.mb and 1e6 * args.mb, progress)
    fields = {"map": str(out), **asdict(result)}
    text = [*shared.format_fields(fields), *shared.describe_lost_calibration(str(out), result.lost_calibration)]
    shared.print_result(fields, args.json, text)


def run_salience(args: Namespace) -> None:
    """Run `salience`: print the salience scores of a picture (see the glossary)."""
    from edgevpr.frames.images import read_image
    from edgevpr.runtime.recognise.opening import open_salience_gate
    from edgevpr.runtime.recognise.salience_gate import judge_scores

    gate = open_salience_gate(shared.make_config(args, args.config, **{"salience.use": True}).salience)
    assert gate is not None  # salience.use is set
    judgement = judge_scores(gate.scores(read_image(Path(args.image))), gate.config)
    outcome = {"kept": judgement.reason is None, "reason": judgement.reason and judgement.reason.fields()}
    shared.print_result({"image": args.image, **asdict(judgement.scores), **outcome}, args.json)
