"""Ground truth: which references are right for a query, by their names."""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file

_COLUMNS = ("query_file", "ref_files", "ref_files_loose", "status")
_MAX_FILE_BYTES = 100_000_000  # a million queries


@dataclass(frozen=True, slots=True)
class Judged:
    """The references that are `right` for a query; a match in `ignored` is neither right nor wrong. `where` it stands
    in the file, for messages."""

    right: frozenset[str]
    ignored: frozenset[str]
    where: str


@dataclass(frozen=True, slots=True)
class Truth:
    """A ground truth: of every query its name, in the order of the file, and None where it is not scored."""

    queries: dict[str, Judged | None]
    places: dict[str, str]  # where each query stands in the file, for messages

    @property
    def scored(self) -> dict[str, Judged]:
        """The queries that are scored."""
        return {name: judged for name, judged in self.queries.items() if judged}

    @property
    def named(self) -> frozenset[str]:
        """All references that it names for queries that are scored."""
        return frozenset().union(*(judged.right | judged.ignored for judged in self.scored.values()))


def read_truth(path: str | Path) -> Truth:
    """Read a CSV with the columns query_file and ref_files (names separated by spaces). Optional are ref_files_loose
    (ignored unless they are in ref_files too) and status (only `ok` is scored). Raises UsageError with file, line,
    value and what to do."""
    queries: dict[str, Judged | None] = {}
    places: dict[str, str] = {}
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
        places[name] = where
        queries[name] = Judged(right, loose - right, where) if is_scored else None
    return Truth(queries, places)


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
