"""The flags of `edgevpr map build` for a map without a mapping flight: of an orthophoto."""

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Collection
from typing import TYPE_CHECKING

from edgevpr.core.errors import UsageError

if TYPE_CHECKING:
    from edgevpr.mapmaking.cuttings import OrthophotoSource

TECHNIQUE = "cohog"
_FLAGS = ("footprint_m", "spacing_m", "area", "margin_m")
_OF_A_RECORDING = ("positions", "rate_hz")


def add(build: ArgumentParser) -> None:
    """Add the flags."""
    flags = build.add_argument_group("of an orthophoto, in place of --images")
    flags.add_argument(
        "--orthophoto",
        metavar="FILE",
        help="GeoTIFF, VRT, MBTiles, or a folder of tiles (z/x/y.png)",
    )
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


def require_one_source(args: Namespace) -> None:
    """Raise UsageError where both or none of a recording and an orthophoto are named, or flags of the other."""
    if (args.source is None) == (args.orthophoto is None):
        raise UsageError("Give either --images (pictures of a flight) or --orthophoto: a map is made of one of them.")
    others = _FLAGS if args.orthophoto is None else _OF_A_RECORDING
    if said := [name for name in others if getattr(args, name, None) is not None]:
        source = "--orthophoto" if args.orthophoto is None else "--images"
        raise UsageError(f"--{said[0].replace('_', '-')} goes with {source}: leave it out.")


def camera_of(camera: str | None) -> str:
    """Return the camera of an orthophoto. Raises UsageError for one that looks elsewhere."""
    if camera not in (None, "nadir"):
        raise UsageError(f"--camera {camera}: an orthophoto shows the ground from above: give nadir, or leave it out.")
    return "nadir"


def open_cuttings(args: Namespace, only: Collection[str] | None = None) -> "OrthophotoSource":
    """Open the orthophoto and lay the grid of its places; those of the names in `only` are cut (None: all). Raises
    SourceError, and UsageError for what does not fit."""
    if args.footprint_m is None or args.spacing_m is None:
        raise UsageError("--orthophoto needs --footprint-m (ground along a picture's longest side) and --spacing-m.")
    if args.margin_m is not None and not (args.area and 0 <= args.margin_m < float("inf")):
        raise UsageError(f"--margin-m {args.margin_m:g}: give 0 or more, with --area.")
    from edgevpr.mapmaking.cuttings import OrthophotoSource
    from edgevpr.mapmaking.lattice import lattice_of
    from edgevpr.mapmaking.missions import read_area
    from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or says that it is missing

    area = read_area(args.area) if args.area else None
    margin_m = args.footprint_m if args.margin_m is None else args.margin_m
    orthophoto = Orthophoto(args.orthophoto)
    lattice = lattice_of(orthophoto, args.footprint_m, args.spacing_m, area, margin_m)
    return OrthophotoSource(orthophoto, lattice, args.footprint_m, time.monotonic, only=only)
