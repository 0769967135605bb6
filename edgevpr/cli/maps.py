"""`edgevpr map`: look into, check, repair, merge and shrink place maps (`building` makes them); and `edgevpr
salience`: print how memorable, static and full of information a picture is."""

from argparse import ArgumentTypeError, Namespace
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli import building
from edgevpr.cli.shared import add_json, command, config_of, group, positive, print_json, watched
from edgevpr.core.errors import UsageError

if TYPE_CHECKING:
    from edgevpr.places.examine import MapCheck


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    maps = group(commands, "map", "build, look into, check, repair, merge and shrink place maps")
    building.add(maps)
    info = command(maps, "info", map_info, "say what a map holds")
    info.add_argument("map", metavar="MAP")
    add_json(info)
    check = command(maps, "check", map_check, "read everything in a map, and say what is damaged")
    check.add_argument("map", metavar="MAP")
    add_json(check)
    repair = command(maps, "repair", map_repair, "drop what is damaged; the original is kept as MAP.damaged")
    repair.add_argument("map", metavar="MAP")
    merge = command(maps, "merge", map_merge, "make one map of several of the same technique")
    merge.add_argument("out", metavar="OUT", help="the map file to make")
    merge.add_argument("maps", metavar="MAP", nargs="+")
    smaller = command(maps, "shrink", map_shrink, "keep only the best places, spread over the map")
    smaller.add_argument("map", metavar="MAP")
    smaller.add_argument("out", metavar="OUT", help="the map file to make")
    size = smaller.add_mutually_exclusive_group(required=True)
    size.add_argument("--places", type=_number_of_places, metavar="N", help="as many places")
    size.add_argument("--mb", type=positive, metavar="MB", help="as many as such a file holds, MB of 10^6 bytes")
    worth = command(commands, "salience", run_salience, "say what of a picture is worth remembering")
    worth.add_argument("image", metavar="IMAGE")
    worth.add_argument("--out", metavar="PNG", help="draw the picture with its three maps")
    worth.add_argument("--config", metavar="FILE", help="YAML; its section `salience` counts")
    worth.add_argument("--network", metavar="NAME", help="the card of the network of memorability")
    worth.add_argument("--detector", metavar="NAME", help="the card of the object detector")
    add_json(worth)


def _number_of_places(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"`{text}` is no number of places: give 1 or more")
    return int(text)


def map_info(args: Namespace) -> int:
    """Run `map info`: print what a map holds."""
    from edgevpr.places.index import bytes_per_place
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.places.mapinfo import info_of
    from edgevpr.runtime.recognise.evidence import WITH_CONFIDENCE, calibration_of, not_calibrated

    with PlaceMap.open(args.map) as place_map:
        info, calibration = info_of(place_map), calibration_of(place_map)
    spec = info.spec
    ram_mb = info.places * bytes_per_place(spec) / 1e6
    if args.json:
        known = {"calibration": calibration.figures() if calibration else None}
        print_json({**asdict(info), **known, "bytes_per_place": bytes_per_place(spec), "ram_mb": ram_mb})
        return 0
    settings = ", ".join(f"{key} {value}" for key, value in spec.parameters.items())
    print(f"{info.path}: {info.places} places, {info.with_position} with a position")
    print(f"  technique   {spec.name} ({settings})" + (f", model {spec.model_sha256}" if spec.model_sha256 else ""))
    if info.extent:
        south, west, north, east = info.extent
        print(f"  extent      {south:.6f}..{north:.6f} north, {west:.6f}..{east:.6f} east")
    if info.first_time:
        print(f"  time        {info.first_time} to {info.last_time}")
    if info.mean_quality is not None:
        print(f"  quality     {info.mean_quality:.2f} on average (share of the image that says anything)")
    if info.with_pose:
        print(
            f"  pose        of {info.with_pose} places, known to {info.position_sd_m:.1f} m; a picture shows "
            f"{info.footprint_m:.0f} m of ground along its longest side"
        )
    if info.of_low_quality:
        print(f"  salience    {info.of_low_quality} of low quality, kept to bound the gaps")
    if calibration:
        print(f"  confidence  calibrated {calibration.made}: {calibration.described()}")
    elif spec.name == WITH_CONFIDENCE:
        print(f"  confidence  {not_calibrated(info.places)}")
    print(f"  size        {info.file_bytes / 1e6:.1f} MB on disk, {ram_mb:.2f} MB in RAM ({info.made_by})")
    return 0


def map_check(args: Namespace) -> int:
    """Run `map check`: read everything in a map and print what is damaged. The exit code is 1 if anything is."""
    from edgevpr.places.examine import check

    found = check(args.map, watched("checking"))
    if args.json:
        print_json({**asdict(found), "is_whole": found.is_whole})
    else:
        _print_check(found)
    return 0 if found.is_whole else 1


def map_repair(args: Namespace) -> int:
    """Run `map repair`: drop what is damaged in a map, and keep the original file."""
    from edgevpr.places.examine import check, repair

    found = check(args.map, watched("checking"))
    _print_check(found)
    if found.is_whole:
        print("nothing is damaged: the map is as it was")
        return 0
    original = repair(args.map, watched("copying"))
    print(f"{args.map}: repaired, {found.places} places kept, {len(found.damaged)} dropped; the original is {original}")
    return 0


def _print_check(found: "MapCheck") -> None:
    print(f"{found.path}: {found.places} of {found.places + len(found.damaged)} places can be read")
    for place_id, problem in found.damaged:
        print(f"  damaged     place {place_id}: {problem}")
    for fault in found.faults:
        print(f"  SQLite      {fault}")
    if not found.faults:
        print("  SQLite      the file is sound")
    lacking = f"{found.without_checksums} places lack some: damage of those cannot be seen"
    print(f"  checksums   {lacking if found.without_checksums else 'all match'}")


def map_merge(args: Namespace) -> int:
    """Run `map merge`: make one map of several. If that fails, no map is written."""
    from edgevpr.places.examine import absorb
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.places.mapfiles import map_path, whole_or_none
    from edgevpr.runtime.recognise.opening import technique_of

    out = map_path(args.out)
    with ExitStack() as stack:
        unfinished = stack.enter_context(whole_or_none(out))
        inputs = [stack.enter_context(PlaceMap.open(path)) for path in args.maps]
        technique_of(inputs[0])
        for other in inputs[1:]:
            other.require(inputs[0].spec)
        masks = {each.mask_sha256 for each in inputs}
        with PlaceMap.create(unfinished, inputs[0].spec) as merged:
            if len(masks) == 1:
                merged.record_mask(*masks)
            for path, place_map in zip(args.maps, inputs, strict=True):
                copied, already_here = absorb(merged, place_map)
                print(f"{path}: {copied} places copied" + (f", {already_here} there already" if already_here else ""))
            places = len(merged)
            were_calibrated = any(each.calibration is not None for each in inputs)
    print(f"{out}: {places} places")
    if were_calibrated:
        print(f"  not calibrated: how sure the maps were does not hold for it; run `edgevpr map calibrate {out}`")
    return 0


def map_shrink(args: Namespace) -> int:
    """Run `map shrink`: make a smaller map of the most useful places of a map."""
    from edgevpr.places.examine import places_in, shrink
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.places.mapfiles import map_path

    count = args.places
    if count is None:
        with PlaceMap.open(args.map) as place_map:
            count = places_in(int(args.mb * 1e6), place_map)
        if count < 1:
            raise UsageError(f"--mb {args.mb:g}: not one place of {args.map} fits: give more.")
    kept, places = shrink(args.map, map_path(args.out), count)
    print(f"{args.out}: {kept} of {places} places")
    return 0


def run_salience(args: Namespace) -> int:
    """Run `salience`: print the salience scores of a picture (see the glossary), and draw the maps of them (--out)."""
    from edgevpr.core.files import require_folder, write_whole
    from edgevpr.frames.images import read_image
    from edgevpr.runtime.recognise.opening import gate_of
    from edgevpr.runtime.recognise.salience_gate import drawn_as_png, scores_of, worth_of

    asked = {"salience.use": True, "salience.network": args.network, "salience.detector": args.detector}
    gate = gate_of(config_of(args, args.config, **asked).salience)
    assert gate is not None  # salience.use is set
    if args.out:
        require_folder(Path(args.out))
    image = read_image(Path(args.image))
    maps = gate.maps(image)
    worth = worth_of(scores_of(maps), gate.thresholds)
    if args.out:
        write_whole(Path(args.out), lambda path: path.write_bytes(drawn_as_png(image, maps, worth.salience)))
    if args.json:
        print_json(
            {"image": args.image, **asdict(worth.salience), "kept": worth.reason is None, "reason": worth.reason}
        )
    else:
        for name, score in worth.salience.scores.items():
            print(f"{name:<13} {'off' if score is None else f'{score:.2f}'}")
        print(worth.reason or "worth remembering")
    return 0
