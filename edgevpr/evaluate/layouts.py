"""Data sets as they lie on a researcher's disk: each layout is told by its files.

* query/, ref/ and ground_truth.csv: edgevpr's own.
* query/, ref/ and ground_truth_new.npy: VPR-Bench (Zaffar et al., IJCV 2021); a row for each query, its number and the
  numbers of the right references.
* two folders of images and GT.npz: VPR_Tutorial (Schubert et al., 2023); GThard is right, and what is in GTsoft only
  does not count. The first folder by name is the map's.
* database/ and queries/, or images/test/ with both: file names like @EASTING@NORTHING@...jpg, metres of UTM (Pitts30k,
  GSV-Cities and others in that form); right is what is near.
* query/ and ref/ with positions (positions.csv or EXIF): right is what is near.
"""

import pickle
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.errors import UsageError
from edgevpr.evaluate.dataset import Dataset, Query, load_dataset
from edgevpr.evaluate.nearby import Nearness, nearby
from edgevpr.evaluate.truth import Judged
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import GeoTag, find_positions, read_positions

_FORMS = "query/, ref/ and ground_truth.csv; ground_truth_new.npy; GT.npz; database/ and queries/; or positions"


def open_folder(folder: str | Path, rule: Nearness) -> Dataset:
    """Read the data set in a folder, whatever its layout. Raises UsageError for one that is none of them, or does not
    fit together, and SourceError for a folder without images."""
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(f"{folder}: there is no such folder: give one of a data set ({_FORMS}).")
    query, ref = folder / "query", folder / "ref"
    if (truth := folder / "ground_truth.csv").is_file():
        return load_dataset(query, ref, truth)
    if (numbers := folder / "ground_truth_new.npy").is_file():
        return _of_numbers(query, ref, numbers)
    if (matrices := folder / "GT.npz").is_file():
        return _of_matrices(folder, matrices)
    for inner in (folder, folder / "test", folder / "images" / "test"):
        if (inner / "database").is_dir() and (inner / "queries").is_dir():
            return _of_utm(inner / "queries", inner / "database", rule)
    if query.is_dir() and ref.is_dir():
        return of_positions(query, ref, rule)
    raise UsageError(f"{folder} is no data set that is known: it needs {_FORMS}.")


def of_positions(query_dir: str | Path, ref_dir: str | Path, rule: Nearness) -> Dataset:
    """Make the data set of two folders of images with positions. Raises UsageError where there are none."""
    queries, references = list_images(query_dir), list_images(ref_dir)
    tags = _tags(Path(query_dir), queries), _tags(Path(ref_dir), references)
    return _dataset(queries, references, nearby(queries, references, tags, rule), Path(ref_dir))


def _of_numbers(query_dir: Path, ref_dir: Path, path: Path) -> Dataset:
    queries, references = list_images(query_dir), list_images(ref_dir)
    judged = {}
    for row in _objects(path):
        number, right = row
        judged[_named(queries, int(number), path)] = Judged(
            frozenset(_named(references, int(each), path) for each in np.atleast_1d(right)), frozenset(), str(path)
        )
    return _dataset(queries, references, judged, ref_dir)


def _of_matrices(folder: Path, path: Path) -> Dataset:
    ref_dir, query_dir = _two_folders(folder)
    queries, references = list_images(query_dir), list_images(ref_dir)
    with np.load(path, allow_pickle=False) as stored:
        hard, soft = (np.asarray(stored[key]).astype(bool) for key in ("GThard", "GTsoft"))
    if hard.shape != (len(references), len(queries)) or soft.shape != hard.shape:
        raise UsageError(
            f"{path} judges {hard.shape} pairs, and there are {len(references)} images in {ref_dir} and "
            f"{len(queries)} in {query_dir}: the first folder by name must be that of the map."
        )
    judged = {}
    for column, query in enumerate(queries):
        right, loose = (
            frozenset(references[row].name for row in np.flatnonzero(each[:, column])) for each in (hard, soft)
        )
        if right:
            judged[query.name] = Judged(right, loose - right, str(path))
    return _dataset(queries, references, judged, ref_dir)


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


def _named(images: list[Path], number: int, path: Path) -> str:
    if not 0 <= number < len(images):
        raise UsageError(
            f"{path} names image {number} of {images[0].parent}, which has {len(images)}: bring all of them."
        )
    return images[number].name


def _utm_m(path: Path) -> tuple[float, float]:
    try:
        _, east, north, *_ = path.name.split("@")
        return float(east), float(north)
    except ValueError:
        raise UsageError(
            f"{path}: its name does not say @EASTING@NORTHING@ in metres: rename it, or leave it out."
        ) from None


class _NumbersOnly(pickle.Unpickler):
    """Reads an array of lists of numbers, as NumPy stores it by pickle, and nothing that could run a program."""

    def find_class(self, module: str, name: str) -> Any:
        if name in ("_reconstruct", "scalar") and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return getattr(np._core.multiarray, name)
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"it holds {module}.{name}")


def _objects(path: Path) -> np.ndarray:
    """Read the array of objects in a .npy file."""
    try:
        with open(path, "rb") as handle:
            version = np.lib.format.read_magic(handle)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(handle)
            if not dtype.hasobject:
                raise ValueError("it holds no lists")
            found = _NumbersOnly(handle).load()
        if found.ndim != 2 or shape[1] != 2:
            raise ValueError(f"its shape is {shape}, and (queries, 2) is meant")
    except (OSError, ValueError, EOFError, IndexError, AttributeError, pickle.UnpicklingError) as error:
        raise UsageError(f"{path} is no ground truth of VPR-Bench ({error}): bring the one of the data set.") from error
    return found
