"""A data set: a folder of queries, a folder of references (the images to map), and a ground truth, which names the
right references of each query. `evaluate` measures techniques on it; `layouts` reads other forms of data sets."""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file
from edgevpr.core.text import decoded_name
from edgevpr.frames.images import list_images

_MAX_FILE_BYTES = 100_000_000  # a million queries


@dataclass(frozen=True, slots=True)
class Judged:
    """Ground truth of one query: file names of the references that are `right` (none: the query is not scored), and of
    those `ignored`, where a match counts as neither right nor wrong."""

    right: frozenset[str] = frozenset()
    ignored: frozenset[str] = frozenset()


NOT_SCORED = Judged()
GroundTruth = dict[str, Judged]  # by the file name of each query, in the order of the file


@dataclass(frozen=True, slots=True)
class ScoredQuery:
    """A query that is scored: the `path` of its image, and the file names of the references that are `right` and of
    those `ignored`, as in `Judged`."""

    path: Path
    right: frozenset[str]
    ignored: frozenset[str]


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set: its scored `queries`, and the folder `ref_dir` of its references. `references` are the file names of
    all images there, in the order of mapping."""

    queries: tuple[ScoredQuery, ...]
    ref_dir: Path
    references: tuple[str, ...]


def load_dataset(query_dir: str | Path, ref_dir: str | Path, ground_truth: str | Path) -> Dataset:
    """Read a data set and check it against its folders. Images of queries that `ground_truth` lacks are left out.

    Raises UsageError with file, name and what to do, and SourceError for a folder without images.
    """
    return joined(query_dir, ref_dir, read_truth(ground_truth), ground_truth)


def joined(query_dir: str | Path, ref_dir: str | Path, truth: GroundTruth, origin: str | Path) -> Dataset:
    """Make a data set of two folders of images and the ground truth that was read from `origin`. Raises UsageError for
    a name that is not in its folder, and where no query is scored."""
    paths = {decoded_name(path.name): path for path in list_images(query_dir)}
    references = names_in(ref_dir)
    known = frozenset(references)
    for name, judged in truth.items():
        if name not in paths:
            raise UsageError(f"{origin}: the query `{name}` is not in {query_dir}: correct its name, or drop the row.")
        if judged.right and (unknown := sorted((judged.right | judged.ignored) - known)):
            raise UsageError(f"{origin}: the reference `{unknown[0]}` is not in {ref_dir}: correct its name.")
    queries = tuple(ScoredQuery(paths[name], each.right, each.ignored) for name, each in truth.items() if each.right)
    if not queries:
        raise UsageError(f"{origin} scores no query: it needs a row with ref_files (and status `ok`).")
    return Dataset(queries, Path(ref_dir), references)


def names_in(folder: str | Path) -> tuple[str, ...]:
    """Return the names of all images in a folder, in counting order (2.png before 10.png)."""
    return tuple(decoded_name(path.name) for path in list_images(folder))


def read_truth(path: str | Path) -> GroundTruth:
    """Read a CSV with the columns query_file and ref_files (file names separated by spaces). Optional columns are
    ref_files_loose (references to ignore, unless they are in ref_files too) and status (only `ok` is scored). Raises
    UsageError with file, line, value and what to do."""
    truth: GroundTruth = {}
    for where, row in _rows(Path(path)):
        name = row["query_file"]
        if name in truth:
            raise UsageError(f"{where}: the query `{name}` has a row already: keep one, with all its ref_files.")
        right, loose = (frozenset(row.get(key, "").split()) for key in ("ref_files", "ref_files_loose"))
        is_scored = row.get("status", "ok") == "ok"
        if is_scored and not right:
            raise UsageError(f"{where}: the query `{name}` has no ref_files: name one, or give it another status.")
        truth[name] = Judged(right, loose - right) if is_scored else NOT_SCORED
    return truth


def _rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield for each row its file and line, for messages, and its values by column, without outer spaces."""
    try:
        reader = csv.DictReader(io.StringIO(read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig"), newline=""))
        if missing := [name for name in ("query_file", "ref_files") if name not in (reader.fieldnames or ())]:
            raise UsageError(f"{path}: the column `{missing[0]}` is missing from its first line: add it.")
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            if None in row or None in row.values():
                raise UsageError(
                    f"{where}: the row has not as many fields as the first line: separate columns by commas, and file "
                    "names inside a column by spaces."
                )
            yield where, {column: value.strip() for column, value in row.items()}
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror}): give the path of a CSV file.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path} is not a CSV file in UTF-8 ({error}): save it as one.") from error
