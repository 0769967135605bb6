"""Reads a data set: a folder of queries, a folder of references (the images to map), and a ground truth that lists the
correct references of each query; a query without any is off the map. `open_folder` recognises these layouts of
published data sets by their files:

* query/, ref/ and ground_truth.csv: edgevpr's own layout.
* database/ and queries/, or images/test/ with both: file names like @EASTING@NORTHING@...jpg, in UTM metres (Pitts30k,
  GSV-Cities and others in that form). References near the query are correct.
* query/ and ref/ with positions (positions.csv or EXIF): references near the query are correct."""

import csv
import hashlib
import io
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file
from edgevpr.core.geodesy import offset_between_m
from edgevpr.core.text import decode_name
from edgevpr.frames.images import list_images
from edgevpr.frames.source import read_tags

_MAX_FILE_BYTES = 100_000_000  # a million queries
_LAYOUTS = "query/, ref/ and ground_truth.csv or positions.csv; or database/ and queries/"
_SCORED_STATUSES = ("ok", "novel")  # statuses of a scored query; novel: its place is not in the map
# Maps the file name of each query, in file order, to the file names of its correct references (none: the query is off
# the map) and of the ignored ones, where a match counts as neither correct nor wrong. None: the query is not scored.
GroundTruth = dict[str, tuple[frozenset[str], frozenset[str]] | None]
PointsByPath = dict[Path, tuple[float, float]]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ScoredQuery:
    """A query that is scored: the `path` of its image, the file names of the `correct` references (none: its
    place is not in the map), and those of the `ignored` ones, where a match counts as neither correct nor wrong."""

    path: Path
    correct: frozenset[str]
    ignored: frozenset[str]


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set: its scored `queries`, and the folder `ref_dir` of its references. `references` are the file names of
    all images in that folder, in mapping order. `unscored`: number of query images without ground truth.
    `copied`: number of scored queries whose file is also a reference, so that they test nothing."""

    queries: tuple[ScoredQuery, ...]
    ref_dir: Path
    references: tuple[str, ...]
    unscored: int = 0
    copied: int = 0


def load_dataset(query_dir: str | Path, ref_dir: str | Path, ground_truth: str | Path) -> Dataset:
    """Read a data set and check it against its folders. Query images missing from `ground_truth` are not scored.

    Raises UsageError with file, name and remedy, and SourceError for a folder without images."""
    return make_dataset(query_dir, ref_dir, read_truth(ground_truth), ground_truth)


def make_dataset(query_dir: str | Path, ref_dir: str | Path, truth: GroundTruth, origin: str | Path) -> Dataset:
    """Make a data set from two folders of images and the ground truth read from `origin`. Raises UsageError if a name
    is not in its folder, or if no query is scored."""
    paths = {decode_name(path.name): path for path in list_images(query_dir)}
    references = list_names(ref_dir)
    for name, answers in truth.items():
        if name not in paths:
            raise UsageError(f"{origin}: query `{name}` is not in {query_dir}: correct its name, or remove the row.")
        if answers and (unknown := sorted(frozenset.union(*answers).difference(references))):
            raise UsageError(f"{origin}: reference `{unknown[0]}` is not in {ref_dir}: correct its name.")
    queries = tuple(ScoredQuery(paths[name], *answers) for name, answers in truth.items() if answers)
    if not queries:
        raise UsageError(f"{origin} has no query to score: add a row with the status `ok` or `novel`.")
    copied = _count_copies((query.path for query in queries), list_images(ref_dir))
    return Dataset(queries, Path(ref_dir), references, len(paths) - len(queries), copied)


def _count_copies(queries: Iterable[Path], references: Iterable[Path]) -> int:
    """Return the number of `queries` whose file has the same content as one of `references`."""
    reference_sizes, query_sizes = ({path: path.stat().st_size for path in paths} for paths in (references, queries))
    sizes = {*reference_sizes.values()} & {*query_sizes.values()}  # only files of equal size are read
    digests = {_compute_digest(path) for path, size in reference_sizes.items() if size in sizes} - {None}
    return sum(_compute_digest(path) in digests for path, size in query_sizes.items() if size in sizes)


def _compute_digest(path: Path) -> bytes | None:
    """Return the SHA-256 of a file; None if it is unreadable, which is reported when its image is needed."""
    try:
        return hashlib.sha256(path.read_bytes()).digest()
    except OSError:
        return None


def list_names(folder: str | Path) -> tuple[str, ...]:
    """Return the names of all images in a folder, in natural order (2.png before 10.png)."""
    return tuple(decode_name(path.name) for path in list_images(folder))


def read_truth(path: str | Path) -> GroundTruth:
    """Read a CSV file with the columns query_file and ref_files (file names separated by spaces; none: the query is off
    the map). Optional columns are ref_files_loose (references to ignore, unless in ref_files too) and status (`ok`, or
    `novel` for a query off the map; others are not scored). Raises UsageError with file, line, value and remedy."""
    truth: GroundTruth = {}
    for where, row in _read_rows(Path(path)):
        name = row["query_file"]
        if name in truth:
            raise UsageError(f"{where}: query `{name}` already has a row: keep one row with all its ref_files.")
        correct, loose = (frozenset(row.get(key, "").split()) for key in ("ref_files", "ref_files_loose"))
        status = row.get("status", "").casefold() or "ok"
        if correct and status == "novel":
            raise UsageError(f"{where}: query `{name}` is `novel` but has ref_files: remove them, or write `ok`.")
        truth[name] = (correct, loose - correct) if status in _SCORED_STATUSES else None
    return truth


def _read_rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """For each row, yield its file and line, for messages, and its values by column, stripped of surrounding spaces."""
    try:
        reader = csv.DictReader(io.StringIO(read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig"), newline=""))
        if missing := [name for name in ("query_file", "ref_files") if name not in (reader.fieldnames or ())]:
            raise UsageError(f"{path}: the first line lacks the column `{missing[0]}`: add it.")
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            if None in row or None in row.values():
                raise UsageError(
                    f"{where}: this row and the first line have different numbers of fields: separate columns with "
                    "commas, and file names inside a column with spaces."
                )
            yield where, {column: value.strip() for column, value in row.items()}
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror}): pass the path of a CSV file.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path} is not a UTF-8 CSV file ({error}): save it as one.") from error


def open_folder(folder: str | Path, within_m: float) -> Dataset:
    """Read the data set in `folder`, in any of the layouts above. Without a ground truth, references within `within_m`
    metres of a query are correct. Raises UsageError for an unknown layout or parts that do not match, and SourceError
    for a folder without images."""
    folder = Path(folder)
    query, ref = folder / "query", folder / "ref"
    if (truth := folder / "ground_truth.csv").is_file():
        return load_dataset(query, ref, truth)
    for parent in (folder, folder / "test", folder / "images" / "test"):
        if (parent / "database").is_dir() and (parent / "queries").is_dir():
            folders = parent / "queries", parent / "database"
            queries_m, references_m = ({path: _parse_utm_m(path) for path in list_images(each)} for each in folders)
            return _match_near(*folders, queries_m, references_m, within_m)
    if query.is_dir() and ref.is_dir():
        return match_positions(query, ref, within_m)
    raise UsageError(f"{folder} does not have the layout of a data set: it needs {_LAYOUTS}.")


def match_positions(query_dir: Path, ref_dir: Path, within_m: float) -> Dataset:
    """Make a data set from two folders of images with positions; queries without a position are not scored. Raises
    UsageError if there are no positions, or if no reference is near a query."""
    queries, references = (
        {path: tag.position for path, tag in read_tags(folder).items() if tag.position}
        for folder in (query_dir, ref_dir)
    )
    if not queries or not references:
        raise UsageError("No positions and no ground truth found: pass --ground-truth, or add a positions.csv.")
    origin = next(iter(references.values()))
    queries_m, references_m = (
        {path: offset_between_m(origin, position) for path, position in positions.items()}
        for positions in (queries, references)
    )
    return _match_near(query_dir, ref_dir, queries_m, references_m, within_m)


def _parse_utm_m(path: Path) -> tuple[float, float]:
    try:
        _, east, north, *_ = path.name.split("@")
        return float(east), float(north)
    except ValueError:
        raise UsageError(f"{path}: its name lacks @EASTING@NORTHING@ in metres: rename or remove the file.") from None


def _match_near(
    query_dir: Path, ref_dir: Path, queries_m: PointsByPath, references_m: PointsByPath, within_m: float
) -> Dataset:
    """Make a data set in which the references within `within_m` metres of a query are correct. `queries_m` and
    `references_m` are their positions, metres east and north of a common origin. Raises UsageError if no query has a
    correct reference. References without a position are ignored: a match with one may be right."""
    names, truth = [decode_name(path.name) for path in references_m], GroundTruth()
    unplaced = frozenset(list_names(ref_dir)) - set(names)
    if unplaced:
        text = "%d of %d references have no position: a match with one of them counts as neither right nor wrong"
        _log.warning(text, len(unplaced), len(unplaced) + len(names))
    points_m = np.array(list(references_m.values()))
    for path, query_m in queries_m.items():
        near = np.flatnonzero(np.hypot(*(points_m - query_m).T) <= within_m)
        truth[decode_name(path.name)] = frozenset(names[index] for index in near), unplaced
    if not any(answers and answers[0] for answers in truth.values()):
        raise UsageError(f"No query was taken within {within_m:g} m of a reference: pass a larger --within-m.")
    return make_dataset(query_dir, ref_dir, truth, query_dir)
