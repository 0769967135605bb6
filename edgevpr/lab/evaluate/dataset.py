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

_COLUMNS = ("query_file", "ref_files", "ref_files_loose", "status")
_MAX_FILE_BYTES = 100_000_000  # a million queries


@dataclass(frozen=True, slots=True)
class Judged:
    """Ground truth of one query: file names of the references that are `right` (none: the query is not scored), and of
    those `ignored`, where a match counts as neither right nor wrong. `where` is its file and line, for messages."""

    right: frozenset[str]
    ignored: frozenset[str]
    where: str


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Ground truth of a data set, by the file name of each query, in the order of the file."""

    queries: dict[str, Judged]

    @property
    def scored(self) -> dict[str, Judged]:
        """The queries that have a right reference: only these are scored."""
        return {name: judged for name, judged in self.queries.items() if judged.right}

    @property
    def named(self) -> frozenset[str]:
        """The names of all references that are right or ignored for a scored query."""
        return frozenset().union(*(judged.right | judged.ignored for judged in self.scored.values()))


@dataclass(frozen=True, slots=True)
class ScoredQuery:
    """A query that is scored: the `path` of its image, and the file names of the references that are `right` and of
    those `ignored`, where a match counts as neither right nor wrong."""

    path: Path
    right: frozenset[str]
    ignored: frozenset[str]


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set: its scored `queries`, and the folder `ref_dir` of its references. `references` are the file names of
    all images there, in the order of mapping. `notes` are sentences on what is left out."""

    queries: tuple[ScoredQuery, ...]
    ref_dir: Path
    references: tuple[str, ...]
    notes: tuple[str, ...] = ()


def load_dataset(query_dir: str | Path, ref_dir: str | Path, ground_truth: str | Path) -> Dataset:
    """Read a data set and check it against its folders. Images of queries that `ground_truth` lacks are left out.

    Raises UsageError with file, line, value and what to do, and SourceError for a folder without images.
    """
    paths = {decoded_name(path.name): path for path in list_images(query_dir)}
    references = tuple(decoded_name(path.name) for path in list_images(ref_dir))
    truth, known = read_truth(ground_truth), frozenset(references)
    for name, judged in truth.queries.items():
        if name not in paths:
            raise UsageError(
                f"{judged.where}: the query `{name}` is not in {query_dir}: correct its name, or drop the row."
            )
    for judged in truth.scored.values():
        if unknown := sorted((judged.right | judged.ignored) - known):
            raise UsageError(
                f"{judged.where}: the reference `{unknown[0]}` is not in {ref_dir}: correct its name, or remove it."
            )
    queries = tuple(ScoredQuery(paths[name], judged.right, judged.ignored) for name, judged in truth.scored.items())
    if not queries:
        raise UsageError(f"{ground_truth} scores no query: it needs a row with ref_files (and status `ok`).")
    return Dataset(queries, Path(ref_dir), references)


def read_truth(path: str | Path) -> GroundTruth:
    """Read a CSV with the columns query_file and ref_files (file names separated by spaces). Optional columns are
    ref_files_loose (references to ignore, unless they are in ref_files too) and status (only `ok` is scored). Raises
    UsageError with file, line, value and what to do."""
    queries: dict[str, Judged] = {}
    for where, row in _rows(Path(path)):
        name = row["query_file"]
        if name in queries:
            raise UsageError(f"{where}: the query `{name}` has a row already: keep one, with all its ref_files.")
        right, loose = (frozenset(row.get(key, "").split()) for key in ("ref_files", "ref_files_loose"))
        is_scored = row.get("status", "ok") == "ok"
        if is_scored and not right:
            raise UsageError(
                f"{where}: the query `{name}` has no ref_files: name at least one, or give it a status other than "
                "`ok`, so that it is not scored."
            )
        queries[name] = Judged(right if is_scored else frozenset(), loose - right, where)
    return GroundTruth(queries)


def _rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield for each row of the CSV two parts: its file and line, for messages;
    its values by column, without outer spaces."""
    try:
        reader = csv.DictReader(io.StringIO(read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig"), newline=""))
        columns = list(reader.fieldnames or ())
        for column in _COLUMNS:
            if column in _COLUMNS[:2] and column not in columns:
                raise UsageError(f"{path}: the column `{column}` is missing from its first line: add it.")
            if columns.count(column) > 1:
                raise UsageError(f"{path}: its first line has two columns `{column}`: keep one of them.")
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
