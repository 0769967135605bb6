"""`edgevpr fleet`: maps larger than an aircraft, a folder of tiles made by many workers."""

from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.cli.maps import add_orthophoto, parse_cuttings
from edgevpr.cli.shared import add_json, add_keys, command, count, group, lines_of, load_command_config, report, show
from edgevpr.core.errors import UsageError
from edgevpr.core.text import progress

_PLACES_PER_TILE = 10_000
_MAX_SHOWN = 10  # problems: a store that is away causes the same one for each tile


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    fleet = group(commands, "fleet", "build maps too large for one aircraft")
    build = command(fleet, "build", fleet_build, "build one map per tile, with several workers")
    build.add_argument("out", metavar="MAPS", help="folder of the maps; resume if it exists")
    build.add_argument(
        "--images",
        metavar="SOURCE",
        nargs="+",
        help="folders of photographs, or tables (.csv) of files with positions",
    )
    add_orthophoto(build)
    build.add_argument("--config", metavar="FILE", help="configuration of the flights: camera, mask, salience")
    add_keys(build, "source.camera", "source.mask", "source.lens", "source.fov_deg", "source.up_deg")
    add_count = partial(build.add_argument, type=count, metavar="N")
    add_count("--places-per-tile", default=_PLACES_PER_TILE, help="most places of a tile (default: %(default)s)")
    add_count("--workers", help="workers on this computer (default: one a core)")
    build.add_argument("--scheduler", metavar="ADDRESS", help="of Dask, tcp://HOST:8786 (default: this computer)")
    build.add_argument("--no-refine", dest="refine", action="store_false", help="keep positions as recorded")
    build.add_argument("--no-calibrate", dest="calibrate", action="store_false", help="do not calibrate confidence")
    add_json(build)


def fleet_build(args: Namespace) -> int:
    """Run `fleet build`: make or continue a folder of maps, and print what was done."""
    try:
        from edgevpr.fleet import building
        from edgevpr.fleet.grid import parse_zoom
        from edgevpr.fleet.photos import list_photos
        from edgevpr.fleet.worker import FleetOrder
    except ModuleNotFoundError as error:
        raise UsageError(f"A fleet's maps need more packages ({error}): `pip install 'edgevpr[fleet]'`.") from error

    config, out = load_command_config(args, args.config), Path(args.out)
    if (args.images is None) == (args.orthophoto is None):
        raise UsageError("Give either --images (photographs of flights) or --orthophoto: maps are made of one of them.")
    zoom = next((parse_zoom(path.stem) for path in building.list_maps(out)), None)
    camera = config.source.camera
    without_position = 0
    if args.orthophoto:
        tasks, camera = building.tasks_of_orthophoto(parse_cuttings(args), args.places_per_tile, zoom), "nadir"
    elif camera is None:
        raise UsageError("Where did the camera look? Give --camera nadir (straight down) or --camera forward.")
    else:
        tasks, without_position = building.tasks_of_photos(list_photos(args.images), args.places_per_tile, zoom)
    out = out.absolute()
    order = FleetOrder(out=out, config=config, camera=camera, refine=args.refine, calibrate=args.calibrate)
    done = list(building.build(order, tasks, args.scheduler, args.workers, progress))
    mapped = [each for each in done if each.places]
    unusable = [text for each in done for text in each.unusable]
    problems = {each.name: each.problem for each in done if each.problem}
    result: dict[str, Any] = {
        "maps": str(out),
        "tiles": len(mapped),
        "mapped_now": sum(each.is_new for each in done),
        "places": sum(each.places for each in mapped),
        "not_calibrated": sum(not each.is_calibrated for each in mapped),
        "without_position": without_position,
        "unusable": unusable,
        "problems": problems,
    }
    text = {**result, "unusable": unusable[:_MAX_SHOWN], "problems": dict(list(problems.items())[:_MAX_SHOWN])}
    show({**result, "new": [each.name for each in done if each.is_new]}, args.json, lines_of(text))
    if more := max(len(unusable), len(problems), _MAX_SHOWN) - _MAX_SHOWN:
        report(f"{more} more problems are not shown: --json has all")
    return 1 if problems or unusable else 0
