"""Ground truth by where pictures were taken: near enough, in a like direction, with enough ground in common."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file
from edgevpr.core.geodesy import offset_m
from edgevpr.frames.header import read_header
from edgevpr.frames.positions import GeoTag
from edgevpr.lab.evaluate.truth import Judged
from edgevpr.mapmaking.footprint import Footprint, footprint, shared

_HEADER_BYTES = 400_000_000


@dataclass(frozen=True, slots=True)
class Nearness:
    """A reference is right where it was taken within `within_m` metres of the query; where they are given, also with a
    heading within `within_deg`, and with a share of at least `overlap` of the smaller picture's ground in common, by
    height above the ground and `fov_deg`."""

    within_m: float = 25.0
    within_deg: float | None = None
    overlap: float | None = None
    fov_deg: float | None = None


Tags = Mapping[str, GeoTag]


def nearby(
    queries: Sequence[Path], references: Sequence[Path], tags: tuple[Tags, Tags], rule: Nearness
) -> dict[str, Judged]:
    """Return what is right for each query that has a position and any right reference. `tags` are those of the queries
    and of the references, by file name. Raises UsageError where a figure that the rule needs is known of none."""
    here, there = (
        [path for path in paths if path.name in known and known[path.name].position]
        for paths, known in zip((queries, references), tags, strict=True)
    )
    if not here or not there:
        raise UsageError(
            "There are no positions to tell which places are right: give --ground-truth, or positions.csv."
        )
    of_here, of_there = ([known[path.name] for path in paths] for paths, known in zip((here, there), tags, strict=True))
    origin = of_there[0].position
    east_m, north_m = offset_m(
        origin.lat_deg,
        origin.lon_deg,
        np.array([tag.position.lat_deg for tag in of_there]),
        np.array([tag.position.lon_deg for tag in of_there]),
    )
    places = list(zip(east_m.tolist(), north_m.tolist(), strict=True))
    prints: list[Footprint] = []
    if rule.overlap is not None:
        prints = [_print(*each, rule) for each in zip(there, of_there, places, strict=True)]
    found = {}
    for path, tag in zip(here, of_here, strict=True):
        at = offset_m(origin.lat_deg, origin.lon_deg, tag.position.lat_deg, tag.position.lon_deg)
        near = np.hypot(east_m - at[0], north_m - at[1]) <= rule.within_m
        if rule.within_deg is not None:
            near &= [_apart_deg(tag.heading_deg, each.heading_deg) <= rule.within_deg for each in of_there]
        if rule.overlap is not None and near.any():
            own = _print(path, tag, at, rule)
            near &= [bool(ok) and shared(own, each) >= rule.overlap for ok, each in zip(near, prints, strict=True)]
        if near.any():
            names = frozenset(there[slot].name for slot in np.flatnonzero(near))
            found[path.name] = Judged(names, frozenset(), str(path))
    if not found:
        raise UsageError(f"No query was taken within {rule.within_m:g} m of a reference: allow more with --within-m.")
    return found


def _apart_deg(one: float | None, other: float | None) -> float:
    if one is None or other is None:
        raise UsageError("--within-deg needs the heading of every picture (yaw_deg in positions.csv): leave it out.")
    return abs((one - other + 180) % 360 - 180)


def _print(path: Path, tag: GeoTag, at: tuple[float, float], rule: Nearness) -> Footprint:
    if rule.fov_deg is None or tag.height_m is None or tag.heading_deg is None:
        raise UsageError(
            f"{path}: --overlap needs --fov-deg, and height_m and yaw_deg of every picture in positions.csv: leave it "
            "out."
        )
    header = read_header(read_file(path, _HEADER_BYTES))
    if header is None:
        raise UsageError(f"{path} says no size: give a JPEG, PNG, TIFF, BMP or WebP file.")
    middle_m = float(at[0]), float(at[1])
    return footprint(middle_m, tag.height_m, rule.fov_deg, (header.width, header.height), tag.heading_deg)
