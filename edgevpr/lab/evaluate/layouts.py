"""Reads data sets in the layouts in which they are published. A layout is recognised by its files:

* query/, ref/ and ground_truth.csv: edgevpr's own.
* query/, ref/ and ground_truth_new.npy: VPR-Bench (see `numbered`).
* GT.npz and two folders, that of the references first by name: VPR_Tutorial (see `numbered`).
* database/ and queries/, or images/test/ with both: file names like @EASTING@NORTHING@...jpg, metres of UTM (Pitts30k,
  GSV-Cities and others in that form). References near the query are right (`Nearness`).
* query/ and ref/ with positions (positions.csv or EXIF): references near the query are right.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.config import bounded
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_m, shorter_deg
from edgevpr.core.text import decoded_name
from edgevpr.core.types import Position
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import GeoTag
from edgevpr.frames.source import tags_of
from edgevpr.lab.evaluate.dataset import Dataset, GroundTruth, Judged, joined, load_dataset
from edgevpr.lab.evaluate.numbered import load_numbered

Tags = dict[Path, GeoTag]  # of the pictures of a folder
_FORMS = "query/, ref/ and ground_truth.csv, ground_truth_new.npy or positions.csv; GT.npz; or database/ and queries/"


@dataclass(frozen=True, slots=True, kw_only=True)
class Nearness:
    """Rule by which a reference is right for a query: it was taken within `within_m` metres of it, and the headings
    differ by at most `within_deg` degrees (None: whatever the headings)."""

    within_m: float = bounded(0.01, 1_000_000, default=25.0)
    within_deg: float | None = bounded(0.1, 180, default=None)


def open_folder(folder: str | Path, rule: Nearness) -> Dataset:
    """Read the data set in `folder`, in any layout above. Raises UsageError for an unknown layout or parts that do not
    fit together, and SourceError for a folder without images."""
    folder = Path(folder)
    query, ref = folder / "query", folder / "ref"
    if (truth := folder / "ground_truth.csv").is_file():
        return load_dataset(query, ref, truth)
    if (numbers := folder / "ground_truth_new.npy").is_file():
        return load_numbered(query, ref, numbers)
    if (matrices := folder / "GT.npz").is_file():
        inner = sorted(path for path in folder.iterdir() if path.is_dir())
        if len(inner) != 2:
            raise UsageError(f"{folder} has not two folders beside GT.npz: use --query, --ref and --ground-truth.")
        return load_numbered(inner[1], inner[0], matrices)
    for outer in (folder, folder / "test", folder / "images" / "test"):
        if (outer / "database").is_dir() and (outer / "queries").is_dir():
            return _of_utm(outer / "queries", outer / "database", rule)
    if query.is_dir() and ref.is_dir():
        return of_positions(query, ref, rule)
    raise UsageError(f"{folder} is no folder of a data set that is known: it needs {_FORMS}.")


def of_positions(
    query: str | Path, ref: str | Path, rule: Nearness, pictures: Callable[[Path], Path] = Path
) -> Dataset:
    """Make a data set of two folders of images, or videos, with positions; pictures without one are left out.
    `pictures` returns the folder of pictures of a side (query or ref), given the path of a folder or a video (default:
    the path itself, for sets without videos). Raises UsageError where there are no positions, and what `pictures`
    raises."""
    # One side after the other: an error in the first shows before the video of the second is decoded.
    query_dir = pictures(Path(query))
    queries = _tagged(query_dir)
    ref_dir = pictures(Path(ref))
    references = _tagged(ref_dir)
    if not queries or not references:
        raise UsageError(
            "There are no positions to tell which places are right: give --ground-truth, or positions.csv."
        )
    origin = next(tag.position for tag in references.values() if tag.position)
    truth = _near(queries, _offsets_m(queries, origin), references, _offsets_m(references, origin), rule)
    return joined(query_dir, ref_dir, truth, query_dir)


def _of_utm(query_dir: Path, ref_dir: Path, rule: Nearness) -> Dataset:
    queries, references = ({path: GeoTag() for path in list_images(each)} for each in (query_dir, ref_dir))
    query_m, reference_m = (np.array([_utm_m(path) for path in each]) for each in (queries, references))
    truth = _near(queries, query_m, references, reference_m, Nearness(within_m=rule.within_m))
    return joined(query_dir, ref_dir, truth, query_dir)


def _utm_m(path: Path) -> tuple[float, float]:
    try:
        _, east, north, *_ = path.name.split("@")
        return float(east), float(north)
    except ValueError:
        raise UsageError(
            f"{path}: its name does not say @EASTING@NORTHING@ in metres: rename it, or leave it out."
        ) from None


def _tagged(folder: Path) -> Tags:
    """Return the tags of the pictures of a folder that have a position."""
    return {path: tag for path, tag in tags_of(folder).items() if tag.position}


def _offsets_m(tags: Tags, origin: Position) -> Doubles:
    """Return where pictures were taken, (N, 2) metres east and north of `origin`."""
    there = [(tag.position.lat_deg, tag.position.lon_deg) for tag in tags.values() if tag.position]
    return np.transpose(offset_m(origin.lat_deg, origin.lon_deg, *np.transpose(there)))


def _near(queries: Tags, query_m: Doubles, references: Tags, reference_m: Doubles, rule: Nearness) -> GroundTruth:
    """Return the ground truth: for each query with a right reference by `rule`, the names of its right references. The
    other queries are left out. `query_m` and `reference_m`, (N, 2), are metres east and north of a common origin.
    Raises UsageError if no query has a right reference."""
    truth = {}
    for (path, tag), at_m in zip(queries.items(), query_m, strict=True):
        near = np.hypot(*(reference_m - at_m).T) <= rule.within_m
        if rule.within_deg is not None:
            near &= [_apart_deg(tag, other) <= rule.within_deg for other in references.values()]
        if near.any():
            names = (decoded_name(other.name) for other, is_near in zip(references, near, strict=True) if is_near)
            truth[decoded_name(path.name)] = Judged(frozenset(names))
    if not truth:
        raise UsageError(f"No query was taken within {rule.within_m:g} m of a reference: allow more with --within-m.")
    return truth


def _apart_deg(one: GeoTag, other: GeoTag) -> float:
    if one.heading_deg is None or other.heading_deg is None:
        raise UsageError("--within-deg needs the heading of every picture (yaw_deg in positions.csv): leave it out.")
    return abs(shorter_deg(one.heading_deg - other.heading_deg))
