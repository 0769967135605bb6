"""Measures stored similarities, the scores that a technique gave every reference for every query, without any image.

`edgevpr eval --similarity` uses it. A file is a .npy, float (queries, references); higher is more alike.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.errors import UsageError
from edgevpr.frames.images import counting_order
from edgevpr.lab.evaluate.dataset import NOT_SCORED, GroundTruth, read_truth
from edgevpr.lab.evaluate.metrics import Quality, counting, figures, first_right
from edgevpr.lab.evaluate.numbered import KINDS, read_numbered


def read_similarities(path: str | Path) -> Doubles:
    """Read a file of similarities, float64 (queries, references). Raises UsageError for a file that holds none."""
    try:
        scores = np.load(path, allow_pickle=False)
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror or error}): give a .npy file.") from error
    except (ValueError, EOFError) as error:
        raise UsageError(f"{path} holds no similarities ({error}): give a .npy file of them.") from error
    is_table = isinstance(scores, np.ndarray) and scores.ndim == 2 and scores.size and scores.dtype.kind in "biuf"
    if not is_table or np.isnan(scores).any():
        raise UsageError(f"{path} needs a row of numbers for each query, with one for each reference, and no NaN.")
    return np.asarray(scores, np.float64)


def truth_of(
    path: str | Path, scores: Doubles, queries: Sequence[str] | None, references: Sequence[str] | None
) -> tuple[GroundTruth, Sequence[str] | None]:
    """Read a ground truth with an entry for each row of `scores`, and return it with the names of the columns, for
    `measure`. `queries` and `references` are the names of all images (None: those that a CSV names; elsewhere their
    numbers). Raises UsageError if it names others."""
    if Path(path).suffix in KINDS:
        rows, columns = (list(map(str, range(count))) for count in scores.shape)
        return read_numbered(path, queries or rows, references or columns), references or columns
    truth = read_truth(path)
    if not queries:
        return truth, references
    if missing := sorted(truth.keys() - set(queries)):
        raise UsageError(f"{path} names the query `{missing[0]}`, which is not in --query.")
    return {name: truth.get(name, NOT_SCORED) for name in queries}, references


def measure(label: str, scores: Doubles, truth: GroundTruth, references: Sequence[str] | None = None) -> Quality:
    """Compute the quality of `scores`, float (queries, references), which `label` names in messages. Rows are the
    queries of `truth`, in its order, and columns `references` (None: all that `truth` names, in counting order). Raises
    UsageError where the counts do not fit."""
    named = frozenset().union(*(judged.right | judged.ignored for judged in truth.values()))
    names = list(references or sorted(named, key=counting_order))
    if scores.shape != (len(truth), len(names)) or not named <= set(names):
        raise UsageError(
            f"{label} has scores of {scores.shape[0]} queries and {scores.shape[1]} references, and the ground truth "
            f"is of {len(truth)} and {len(names)}: give the one that belongs to it, or the folders of all images with "
            "--query and --ref."
        )
    best, ranks = [], []
    for row, judged in zip(scores, truth.values(), strict=True):
        if judged.right:
            right, ignored = (np.array([name in each for name in names]) for each in (judged.right, judged.ignored))
            ranked = np.argsort(-row, kind="stable")
            ranked = ranked[counting(ranked, ignored)]
            best.append(row[ranked[0]])
            ranks.append(first_right(ranked, right))
    if not best:
        raise UsageError(f"{label}: the ground truth scores none of its queries: give the one that belongs to it.")
    return Quality(
        technique=label, queries=len(best), references=len(names), **figures(np.array(best), np.array(ranks))
    )
