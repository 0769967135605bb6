"""A data set: a folder of queries, a folder of references, and a ground truth that says which references are right."""

from dataclasses import dataclass
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.text import decoded_name
from edgevpr.frames.images import list_images
from edgevpr.lab.evaluate.truth import read_truth


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
    `ref_dir`, in the order in which they are mapped. `notes` say what of it is left out."""

    queries: tuple[Query, ...]
    ref_dir: Path
    references: tuple[str, ...]
    notes: tuple[str, ...] = ()


def load_dataset(query_dir: str | Path, ref_dir: str | Path, ground_truth: str | Path) -> Dataset:
    """Read a data set and check it against its folders. Queries that the ground truth does not name are left alone.

    Raises UsageError with file, line, value and what to do, and SourceError for a folder without images.
    """
    paths = {decoded_name(path.name): path for path in list_images(query_dir)}
    references = tuple(decoded_name(path.name) for path in list_images(ref_dir))
    truth, known = read_truth(ground_truth), frozenset(references)
    for name, where in truth.places.items():
        if name not in paths:
            raise UsageError(f"{where}: the query `{name}` is not in {query_dir}: correct its name, or drop the row.")
    for judged in truth.scored.values():
        if unknown := sorted((judged.right | judged.ignored) - known):
            raise UsageError(
                f"{judged.where}: the reference `{unknown[0]}` is not in {ref_dir}: correct its name, or remove it."
            )
    queries = tuple(Query(paths[name], judged.right, judged.ignored) for name, judged in truth.scored.items())
    if not queries:
        raise UsageError(f"{ground_truth} scores no query: it needs a row with ref_files (and status `ok`).")
    return Dataset(queries, Path(ref_dir), references)
