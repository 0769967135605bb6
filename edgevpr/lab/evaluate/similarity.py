"""Measures stored similarities, the scores that a technique gave every reference for every query, without any image.

`edgevpr eval --similarity` uses it. A file has one of three forms: .npy, float (queries, references); .npz with such an
array as `similarity` and, if known, the names as `queries` and `references`; .csv with the references' names in the
first line and a query's name before its scores, or with scores alone. Higher is more alike.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.frames.images import counting_order
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import GroundTruth
from edgevpr.lab.evaluate.metrics import Quality, figures
from edgevpr.lab.evaluate.numbered import Numbered


@dataclass(frozen=True, slots=True)
class Similarities:
    """`scores`, float (queries, references), and the names of `queries` and `references`; None: the file has none."""

    scores: np.ndarray
    queries: tuple[str, ...] | None
    references: tuple[str, ...] | None


def read_similarities(path: str | Path) -> Similarities:
    """Read a file of similarities. Raises UsageError for one that holds no similarities, or NaN among them."""
    path = Path(path)
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                named = [tuple(map(str, stored[key])) if key in stored else None for key in ("queries", "references")]
                found = Similarities(np.asarray(stored["similarity"]), *named)
        elif path.suffix == ".csv":
            found = _of_csv(path)
        else:
            found = Similarities(np.load(path, allow_pickle=False), None, None)
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read ({error.strerror or error}): give a .npy, .npz or .csv file."
        ) from error
    except (ValueError, KeyError, EOFError, csv.Error) as error:
        raise UsageError(f"{path} holds no similarities ({error}): give a .npy, .npz or .csv file of them.") from error
    scores = found.scores
    if scores.ndim != 2 or not scores.size or not np.issubdtype(scores.dtype, np.number):
        raise UsageError(
            f"{path} holds {scores.dtype} of shape {scores.shape}: similarities have a row for each query and a column "
            "for each reference."
        )
    scores = scores.astype(np.float64)
    if np.isnan(scores).any():
        raise UsageError(f"{path} holds scores that are no numbers (NaN): give each pair a score.")
    for names, count, what in (
        (found.queries, len(scores), "queries"),
        (found.references, scores.shape[1], "references"),
    ):
        if names is not None and (len(names) != count or len(set(names)) != count):
            raise UsageError(f"{path} names {len(set(names))} {what}, and has scores of {count}: name each once.")
    return Similarities(scores, found.queries, found.references)


def measure(
    label: str,
    found: Similarities,
    truth: GroundTruth | Numbered,
    references: Sequence[str] | None = None,
    queries: Sequence[str] | None = None,
) -> Quality:
    """Compute the quality of the similarities `found` by the ground truth `truth`. `label` names them in messages.

    If the file has no names, its rows are `queries` (None: the queries of `truth`, in their order), and its columns
    `references` (None: all that `truth` names, in counting order). A ground truth of numbers numbers `queries` and
    `references`; where one is None, the names in the file, or else its rows or columns. Raises UsageError where names
    and counts do not fit together.
    """
    listed = queries
    if isinstance(truth, Numbered):
        truth, references = _named(label, found, truth, references, queries)
    elif listed and (missing := sorted(truth.scored.keys() - set(listed))):
        raise UsageError(f"{label}: the ground truth names the query `{missing[0]}`, which is not in --query.")
    queries = found.queries or listed or tuple(truth.queries)
    names = found.references or references or tuple(sorted(truth.named, key=counting_order))
    rows, columns = found.scores.shape
    if len(queries) != rows:
        raise UsageError(
            f"{label} has scores of {rows} queries, and {'--query' if listed else 'the ground truth'} names "
            f"{len(queries)}: give the one that belongs to it, or a file that names its queries."
        )
    if len(names) != columns:
        raise UsageError(
            f"{label} has scores of {columns} references, and {len(names)} are named: name the folder of all of them "
            "with --ref, or give a file that names them."
        )
    at = {name: column for column, name in enumerate(names)}
    if missing := sorted(truth.named - at.keys()):
        raise UsageError(f"{label}: the ground truth names the reference `{missing[0]}`, of which there are no scores.")
    scored, scores, ranks = truth.scored, [], []
    for row, name in zip(found.scores, queries, strict=True):
        if (query := scored.get(name)) is None:
            continue
        right, ignored = np.zeros(columns, bool), np.zeros(columns, bool)
        right[[at[each] for each in query.right]] = True
        ignored[[at[each] for each in query.ignored]] = True
        ranked = np.argsort(-row, kind="stable")
        ranked = ranked[metrics.counting(ranked, ignored)]
        scores.append(row[ranked[0]])
        ranks.append(metrics.first_right(ranked, right))
    if not scores:
        raise UsageError(f"{label}: the ground truth scores none of its queries: give the one that belongs to it.")
    return Quality(
        technique=label, queries=len(scores), references=columns, **figures(np.array(scores), np.array(ranks))
    )


def _named(
    label: str,
    found: Similarities,
    truth: Numbered,
    references: Sequence[str] | None,
    queries: Sequence[str] | None,
) -> tuple[GroundTruth, Sequence[str]]:
    """Return two parts: `truth` with names in place of numbers;
    the names of all references, in the order of the numbers."""
    rows, columns = found.scores.shape
    queries = queries or _in_order(label, found.queries, "queries", "--query") or tuple(map(str, range(rows)))
    references = (
        references or _in_order(label, found.references, "references", "--ref") or tuple(map(str, range(columns)))
    )
    count = len(references), len(queries)
    fits = truth.shape == count if truth.is_whole else all(np.less_equal(truth.shape, count))
    if not fits:
        least = "" if truth.is_whole else "at least "
        raise UsageError(
            f"{label} is of {count[1]} queries and {count[0]} references, and {truth.path} numbers {least}"
            f"{truth.shape[1]} and {truth.shape[0]}: give the one that belongs to it."
        )
    return truth.named(queries, references), references


def _in_order(label: str, names: tuple[str, ...] | None, what: str, flag: str) -> tuple[str, ...] | None:
    """Return `names` (None: the file has none). Raises UsageError if they are not in counting order, as the numbers of
    a ground truth are; the message names `what` they are and the `flag` that helps."""
    if names and list(names) != sorted(names, key=counting_order):
        raise UsageError(
            f"{label} does not name its {what} in the order in which a ground truth numbers them: name the folder of "
            f"all of them with {flag}."
        )
    return names


def _of_csv(path: Path) -> Similarities:
    with open(path, encoding="utf-8-sig", newline="") as handle:
        rows = [row for row in csv.reader(handle) if row]
    if not rows:
        raise ValueError("it is empty")
    try:
        return Similarities(np.array(rows, np.float64), None, None)
    except ValueError:
        names, *rest = rows
        scores = np.array([row[1:] for row in rest], np.float64)
        return Similarities(scores, tuple(row[0] for row in rest), tuple(names[1:]))
