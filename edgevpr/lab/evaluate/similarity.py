"""Measures stored similarities (a technique's scores of all references for each query) without the images.

`edgevpr eval --similarity` uses it. A file is a .npy array, float (queries, references); higher is more similar.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.errors import UsageError
from edgevpr.frames.images import make_sort_key
from edgevpr.lab.evaluate.dataset import GroundTruth
from edgevpr.lab.evaluate.metrics import Quality, compute_quality, rank_of_first_correct


def read_similarities(path: str | Path) -> Doubles:
    """Read a file of similarities, float64 (queries, references). Raises UsageError if the file contains none."""
    try:
        scores = np.load(path, allow_pickle=False)
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror or error}): pass a .npy file.") from error
    except (ValueError, EOFError) as error:
        raise UsageError(f"{path} contains no similarities ({error}): pass a .npy file.") from error
    is_matrix = isinstance(scores, np.ndarray) and scores.ndim == 2 and scores.dtype.kind in "biuf"
    if not is_matrix or np.isnan(scores).any():
        raise UsageError(f"{path} must be a matrix without NaN: one row per query, one column per reference.")
    return np.asarray(scores, np.float64)


def add_unscored(truth: GroundTruth, queries: Sequence[str]) -> GroundTruth:
    """Return `truth` with an entry for each of `queries`, the names of all query images, in that order. Raises
    UsageError if `truth` contains other names."""
    if missing := sorted(truth.keys() - set(queries)):
        raise UsageError(f"The ground truth contains the query `{missing[0]}`, which is not in --query.")
    return {name: truth.get(name) for name in queries}


def assess_quality(label: str, scores: Doubles, truth: GroundTruth, references: Sequence[str] | None = None) -> Quality:
    """Compute the quality of `scores`, float (queries, references); `label` is their name in messages. Rows are the
    queries of `truth`, in its order, and columns are `references` (None: all names in `truth`, in natural order).
    Raises UsageError if the numbers do not match."""
    truth_names = frozenset[str]().union(*(names for answers in truth.values() for names in answers or ()))
    names = list(references or sorted(truth_names, key=make_sort_key))
    if scores.shape != (len(truth), len(names)) or not truth_names <= set(names):
        raise UsageError(
            f"{label} has scores for {scores.shape[0]} queries and {scores.shape[1]} references, but the ground truth "
            f"has {len(truth)} and {len(names)}: pass the matching file, or all images with --query and --ref."
        )
    rows = []
    for row, answers in zip(scores, truth.values(), strict=True):
        if answers:
            correct, ignored = (np.array([name in group for name in names], bool) for group in answers)
            ranked = np.argsort(-row, kind="stable")
            ranked = ranked[~ignored[ranked]]
            score = row[ranked[0]] if len(ranked) else -math.inf
            rows.append((score, rank_of_first_correct(ranked, correct), bool(correct.any())))
    if not rows:
        raise UsageError(f"{label}: the ground truth answers none of its queries: pass the matching ground truth.")
    columns = map(np.array, zip(*rows, strict=True))
    return Quality(technique=label, references=len(names), unscored=len(truth) - len(rows), **compute_quality(*columns))
