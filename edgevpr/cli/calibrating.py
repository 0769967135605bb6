"""`edgevpr map calibrate`, and the calibration that ends `map build`: how sure a map can be."""

import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from edgevpr.cli import orthophotos
from edgevpr.cli.shared import (
    add_json,
    add_keys,
    add_recording,
    command,
    config_of,
    path_of,
    print_json,
    read_to_end,
    watched,
)  # fmt: skip
from edgevpr.core.errors import EdgevprError, UsageError

if TYPE_CHECKING:
    from edgevpr.core.config import MatchConfig
    from edgevpr.core.contract import Technique
    from edgevpr.core.types import Frame
    from edgevpr.mapmaking.mapping import Preparation
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.meter import QueryMeter
    from edgevpr.runtime.recognise.stored_confidence import Calibration


def add(maps: Any) -> None:
    """Add the command and its flags to those of maps."""
    calibrate = command(maps, "calibrate", map_calibrate, "find out how sure a map can be, with the pictures it is of")
    calibrate.add_argument("map", metavar="MAP")
    add_recording(calibrate, required=False)
    orthophotos.add(calibrate)
    calibrate.add_argument("--config", metavar="FILE", help="that of the flight: its camera, mask and precision")
    add_keys(calibrate, "source.mask", "source.fov_deg", "source.up_deg")
    add_json(calibrate)


def map_calibrate(args: Namespace) -> int:
    """Calibrate a map, and say what to expect of it."""
    from edgevpr.frames.mask import mask_of
    from edgevpr.mapmaking.mapping import Preparation
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.recognise.levelling import NoLevelling, levelling_of
    from edgevpr.runtime.recognise.opening import meter_of, technique_of

    config = config_of(args, args.config)
    orthophotos.require_one_source(args)
    mask = mask_of(None if args.orthophoto else config.source.mask)
    with PlaceMap.open_for_adding(args.map) as place_map:
        technique = technique_of(place_map)
        levelling = NoLevelling() if args.orthophoto else levelling_of(config.source, technique, below=True)
        meter = meter_of(config, load_board("this"))
        found = calibrated(args, place_map, technique, config.match, meter, Preparation(mask=mask, levelling=levelling))
    if args.json:
        print_json({"map": args.map, "calibration": found.figures()})
    else:
        print(f"{args.map}: calibrated: {found.said()}")
    return 0


def calibrated_after(technique: "Technique", calibrate: "Callable[[], Calibration]") -> "Calibration | None":
    """Calibrate a map that has just been built, where its technique has a confidence; the map is whole without it."""
    from edgevpr.runtime.recognise.evidence import kinds_of

    if not kinds_of(technique.spec):
        return None
    try:
        return calibrate()
    except EdgevprError as error:
        print(f"edgevpr: the map is not calibrated: {error}", file=sys.stderr)
        return None


def calibrated(
    args: Namespace,
    place_map: "PlaceMap",
    technique: "Technique",
    config: "MatchConfig",
    meter: "QueryMeter",
    preparation: "Preparation",
) -> "Calibration":
    """Calibrate an open map with the pictures that the flags name. Raises UsageError where that cannot be done, and
    where SciPy is missing."""
    try:
        from edgevpr.mapmaking.calibrate import calibrate
    except ModuleNotFoundError as error:
        raise UsageError(
            f"Calibrating a map needs SciPy ({error}): install it on the machine that builds maps, with "
            "`pip install 'edgevpr[maps]'`, and run `edgevpr map calibrate`."
        ) from error

    def pictures(names: Sequence[str]) -> "Iterator[Frame]":
        return _pictures(args, names)

    return calibrate(technique, place_map, config, meter, pictures, watched("calibrating"), preparation)


def _pictures(args: Namespace, names: Sequence[str]) -> "Iterator[Frame]":
    """Yield the frames of these names. One that cannot be read is left out."""
    from edgevpr.frames.source import open_source

    if args.orthophoto is not None:
        source = orthophotos.open_cuttings(args, names)
    else:
        source = open_source(args.source, positions=path_of(args.positions), live=False, only=names)
    yield from filter(None, read_to_end(source, lambda error: None))
