"""Data sets as they lie on a researcher's disk: each layout is told by its files.

* query/, ref/ and ground_truth.csv: edgevpr's own.
* query/, ref/ and ground_truth_new.npy: VPR-Bench (Zaffar et al., IJCV 2021); a row for each query, its number and the
  numbers of the right references.
* two folders of images and GT.npz: VPR_Tutorial (Schubert et al., 2023); GThard is right, and what is in GTsoft only
  does not count. The first folder by name is the map's.
* database/ and queries/, or images/test/ with both: file names like @EASTING@NORTHING@...jpg, metres of UTM (Pitts30k,
  GSV-Cities and others in that form); right is what is near.
* query/ and ref/ with positions (positions.csv or EXIF): right is what is near. Either may be a video with positions
  beside it, query.mp4 with query.csv, or a folder that holds one.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import GeoTag, find_positions, read_positions
from edgevpr.lab.evaluate.dataset import Dataset, Query, load_dataset
from edgevpr.lab.evaluate.nearby import Nearness, nearby
from edgevpr.lab.evaluate.numbered import Numbered, read_numbered
from edgevpr.lab.evaluate.truth import Judged
from edgevpr.lab.evaluate.videos import side_of, without_position

_FORMS = "query/, ref/ and ground_truth.csv; ground_truth_new.npy; GT.npz; database/ and queries/; or positions"


def open_folder(folder: str | Path, rule: Nearness, pictures: Callable[[Path], Path] = Path) -> Dataset:
    """Read the data set in a folder, whatever its layout. `pictures` finds the folder of pictures of a side that may be
    a video (default: there are none). Raises UsageError for one that is none of them, or does not
    fit together, and SourceError for a folder without images."""
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(f"{folder}: there is no such folder: give one of a data set ({_FORMS}).")
    query, ref = folder / "query", folder / "ref"
    if (truth := folder / "ground_truth.csv").is_file():
        return load_dataset(query, ref, truth)
    if (numbers := folder / "ground_truth_new.npy").is_file():
        return _of_numbers(folder, numbers)
    if (matrices := folder / "GT.npz").is_file():
        return _of_matrices(folder, matrices)
    for inner in (folder, folder / "test", folder / "images" / "test"):
        if (inner / "database").is_dir() and (inner / "queries").is_dir():
            return _of_utm(inner / "queries", inner / "database", rule)
    sides = [side_of(folder, name) for name in ("query", "ref")]
    if all(sides):
        return of_positions(*sides, rule, pictures)
    raise UsageError(f"{folder} is no data set that is known: it needs {_FORMS}.")


def of_positions(
    query: str | Path, ref: str | Path, rule: Nearness, pictures: Callable[[Path], Path] = Path
) -> Dataset:
    """Make the data set of two folders of images, or videos, with positions; `pictures` as of `open_folder`. Raises
    UsageError where there are no positions, and what `pictures` raises."""
    given = Path(query), Path(ref)
    # One side after the other: nobody waits for the pictures of a video to hear that the other side is not there.
    folders, images = zip(*((folder, list_images(folder)) for folder in map(pictures, given)), strict=True)
    tags = tuple(map(_tags, folders, images))
    dataset = _dataset(*images, nearby(*images, tags, rule), folders[1])
    return replace(dataset, notes=tuple(_notes(given, folders)))


def _notes(given: Iterable[Path], folders: Iterable[Path]) -> Iterator[str]:
    for each, folder in zip(given, folders, strict=True):
        if each != folder:
            without, count = without_position(folder)
            if without:
                yield f"{each}: {without} of {count} frames have no position, and are left out"


def _of_numbers(folder: Path, path: Path) -> Dataset:
    query_dir, ref_dir = folder / "query", folder / "ref"
    queries, references, numbered = list_images(query_dir), list_images(ref_dir), read_numbered(path)
    for images, count in zip((references, queries), numbered.shape, strict=True):
        if count > len(images):
            raise UsageError(
                f"{path} names image {count - 1} of {images[0].parent}, which has {len(images)}: bring all of them."
            )
    return _dataset(queries, references, _judged(numbered, queries, references), ref_dir)


def _of_matrices(folder: Path, path: Path) -> Dataset:
    ref_dir, query_dir = _two_folders(folder)
    queries, references, numbered = list_images(query_dir), list_images(ref_dir), read_numbered(path)
    if numbered.shape != (len(references), len(queries)):
        raise UsageError(
            f"{path} judges {numbered.shape} pairs, and there are {len(references)} images in {ref_dir} and "
            f"{len(queries)} in {query_dir}: the first folder by name must be that of the map."
        )
    return _dataset(queries, references, _judged(numbered, queries, references), ref_dir)


def _judged(numbered: Numbered, queries: list[Path], references: list[Path]) -> dict[str, Judged]:
    return numbered.named([path.name for path in queries], [path.name for path in references]).scored


def _of_utm(query_dir: Path, ref_dir: Path, rule: Nearness) -> Dataset:
    queries, references = list_images(query_dir), list_images(ref_dir)
    here, there = (np.array([_utm_m(path) for path in paths]) for paths in (queries, references))
    judged = {}
    for query, at in zip(queries, here, strict=True):
        near = np.flatnonzero(np.hypot(*(there - at).T) <= rule.within_m)
        if len(near):
            judged[query.name] = Judged(frozenset(references[each].name for each in near), frozenset(), str(query))
    if not judged:
        raise UsageError(f"No query was taken within {rule.within_m:g} m of a reference: allow more with --within-m.")
    return _dataset(queries, references, judged, ref_dir)


def _dataset(queries: list[Path], references: list[Path], judged: dict[str, Judged], ref_dir: Path) -> Dataset:
    scored = tuple(
        Query(path, judged[path.name].right, judged[path.name].ignored) for path in queries if path.name in judged
    )
    return Dataset(scored, ref_dir, tuple(path.name for path in references))


def _two_folders(folder: Path) -> list[Path]:
    found = sorted(each for each in folder.iterdir() if each.is_dir())
    if len(found) != 2:
        raise UsageError(
            f"{folder} has {len(found)} folders beside GT.npz: it needs two, that of the map first by name."
        )
    return found


def _tags(folder: Path, images: Iterable[Path]) -> dict[str, GeoTag]:
    csv_path = find_positions(folder)
    known = read_positions(csv_path) if csv_path else {}
    return {path.name: known.get(path.name) or read_exif(path) for path in images}


def _utm_m(path: Path) -> tuple[float, float]:
    try:
        _, east, north, *_ = path.name.split("@")
        return float(east), float(north)
    except ValueError:
        raise UsageError(
            f"{path}: its name does not say @EASTING@NORTHING@ in metres: rename it, or leave it out."
        ) from None
