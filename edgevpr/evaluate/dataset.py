"""A data set: a folder of queries, a folder of references, and a CSV that says which references are right."""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edgevpr.errors import UsageError
from edgevpr.frames.images import list_images
from edgevpr.helpers.files import read_file
from edgevpr.helpers.text import decoded_name

_COLUMNS = ("query_file", "ref_files", "ref_files_loose", "status")
_MAX_FILE_BYTES = 100_000_000  # a million queries


@dataclass(frozen=True, slots=True)
class Query:
    """A query that is scored: `right` are file names of references that count as correct; a match in `ignored` is
    neither right nor wrong."""

    path: Path
    right: frozenset[str]
    ignored: frozenset[str]


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set: its scored queries and the folder of its references. `references` are the names of all images of
    `ref_dir`, in the order in which they are mapped."""

    queries: tuple[Query, ...]
    ref_dir: Path
    references: tuple[str, ...]


def load_dataset(query_dir: str | Path, ref_dir: str | Path, ground_truth: str | Path) -> Dataset:
    """Read a data set and check it against its folders.

    Columns of the CSV are query_file and ref_files (names separated by spaces). Optional are ref_files_loose (ignored
    unless they are in ref_files too) and status (only `ok` is scored). Other columns, and queries that the CSV does not
    name, are left alone. Raises UsageError with file, line, value and what to do, and SourceError for a folder without
    images.
    """
    query_paths = {decoded_name(path.name): path for path in list_images(query_dir)}
    references = tuple(decoded_name(path.name) for path in list_images(ref_dir))
    known = frozenset(references)
    queries: dict[str, Query | None] = {}
    for where, row in _rows(Path(ground_truth)):
        name = row["query_file"]
        if name not in query_paths:
            raise UsageError(f"{where}: the query `{name}` is not in {query_dir}: correct its name, or drop the row.")
        if name in queries:
            raise UsageError(f"{where}: the query `{name}` has a row already: keep one, with all its ref_files.")
        right = _names(row["ref_files"], known, ref_dir, where)
        loose = _names(row.get("ref_files_loose", ""), known, ref_dir, where)
        scored = row.get("status", "ok") == "ok"
        if scored and not right:
            raise UsageError(
                f"{where}: the query `{name}` has no ref_files: name at least one, or give it a status other than "
                "`ok`, so that it is not scored."
            )
        queries[name] = Query(query_paths[name], right, loose - right) if scored else None
    scored_queries = tuple(query for query in queries.values() if query)
    if not scored_queries:
        raise UsageError(f"{ground_truth} scores no query: it needs a row with ref_files (and status `ok`).")
    return Dataset(scored_queries, Path(ref_dir), references)


def _rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield each row of the CSV, stripped, with its place in the file for messages."""
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


def _names(text: str, known: frozenset[str], ref_dir: str | Path, where: str) -> frozenset[str]:
    names = frozenset(text.split())
    if unknown := sorted(names - known):
        raise UsageError(f"{where}: the reference `{unknown[0]}` is not in {ref_dir}: correct its name, or remove it.")
    return names
