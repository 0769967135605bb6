"""Reads ground truths that number their images, from 0 in counting order of the file names (2.png before 10.png).

* GT.npz: VPR_Tutorial (Schubert et al., 2023); pairs in GThard are right, those in GTsoft only are ignored.
* ground_truth_new.npy: VPR-Bench (Zaffar et al., IJCV 2021); a row for each query, its number and the numbers of the
  right references.
"""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.files import arrays_of, open_file, read_file
from edgevpr.lab.evaluate.dataset import GroundTruth, Judged, read_truth

_MATRICES = ("GThard", "GTsoft")
_MOST_BYTES = 4_000_000_000
_WHAT_IT_IS = {".npz": "GT.npz of VPR_Tutorial", ".npy": "ground truth of VPR-Bench"}


@dataclass(frozen=True, slots=True)
class Numbered:
    """A ground truth with numbers for images. `judged` has, by the number of each scored query, (the numbers of the
    right references; those of the ignored ones). `shape` is (references, queries): how many images there are if
    `is_whole`, else how many there must be at least. `path` is its file."""

    path: Path
    judged: dict[int, tuple[tuple[int, ...], tuple[int, ...]]]
    shape: tuple[int, int]
    is_whole: bool

    def named(self, queries: Sequence[str], references: Sequence[str]) -> GroundTruth:
        """Return this ground truth with names in place of numbers. `queries` and `references` are all file names in the
        order of the numbers, at least as many as `shape` says."""
        found = dict.fromkeys(queries, Judged(frozenset(), frozenset(), str(self.path)))
        for number, both in self.judged.items():
            right, ignored = (frozenset(references[each] for each in part) for part in both)
            found[queries[number]] = Judged(right, ignored, str(self.path))
        return GroundTruth(found)


def truth_in(path: str | Path) -> GroundTruth | Numbered:
    """Read a ground truth: .npz and .npy by `read_numbered`, others as CSV. Raises UsageError if it cannot be read."""
    return read_numbered(path) if Path(path).suffix.lower() in _WHAT_IT_IS else read_truth(path)


def read_numbered(path: str | Path) -> Numbered:
    """Read a GT.npz, or a .npy of VPR-Bench. Raises UsageError for a file that is neither."""
    path = Path(path)
    kind = path.suffix.lower()
    try:
        return _of_matrices(path) if kind == ".npz" else _of_rows(path)
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror or error}): give a {_WHAT_IT_IS[kind]}.") from error
    except (ValueError, TypeError, EOFError, IndexError, AttributeError, pickle.UnpicklingError) as error:
        raise UsageError(f"{path} is no {_WHAT_IT_IS[kind]} ({error}): bring the one of the data set.") from error


def _of_matrices(path: Path) -> Numbered:
    arrays = arrays_of(read_file(path, _MOST_BYTES), _MOST_BYTES)
    if missing := [name for name in _MATRICES if name not in arrays]:
        raise ValueError(f"it has no `{missing[0]}`")
    hard, soft = (arrays[name] for name in _MATRICES)
    if hard.ndim != 2 or soft.shape != hard.shape or not all(each.dtype.kind in "biuf" for each in (hard, soft)):
        raise ValueError(f"GThard is {hard.dtype} {hard.shape} and GTsoft {soft.dtype} {soft.shape}")
    hard = hard.astype(bool)
    soft_only = soft.astype(bool) & ~hard
    judged = {
        query: (tuple(np.flatnonzero(hard[:, query]).tolist()), tuple(np.flatnonzero(soft_only[:, query]).tolist()))
        for query in np.flatnonzero(hard.any(axis=0)).tolist()
    }
    return Numbered(path, judged, hard.shape, True)


def _of_rows(path: Path) -> Numbered:
    judged: dict[int, tuple[tuple[int, ...], tuple[int, ...]]] = {}
    references = queries = 0
    seen = set()
    for number, right in _objects(path):
        (query,), right = _numbers(number), _numbers(right)
        if query in seen:
            raise ValueError(f"it has two rows of query {query}")
        seen.add(query)
        queries, references = max(queries, query + 1), max(references, *(each + 1 for each in right), 0)
        if right:
            judged[query] = right, ()
    return Numbered(path, judged, (references, queries), False)


def _numbers(values: Any) -> tuple[int, ...]:
    found = np.atleast_1d(np.asarray(values, np.float64))
    if found.ndim != 1 or not (np.isfinite(found) & (found >= 0) & (found == np.floor(found))).all():
        raise ValueError(f"it names image {values!r:.40}")
    return tuple(dict.fromkeys(found.astype(int).tolist()))


class _NumbersOnly(pickle.Unpickler):
    """Unpickler for an array of lists of numbers, as NumPy pickles it. It refuses all else: no foreign code can run."""

    def find_class(self, module: str, name: str) -> Any:
        if name in ("_reconstruct", "scalar") and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return getattr(import_module("numpy._core.multiarray"), name)
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"it holds {module}.{name}")


def _objects(path: Path) -> np.ndarray:
    """Read the array of objects, shape (queries, 2), in a .npy file. Raises ValueError where there is none."""
    with open_file(path, _MOST_BYTES) as handle:
        version = np.lib.format.read_magic(handle)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(handle)
        if not dtype.hasobject:
            raise ValueError("it holds no lists")
        found: np.ndarray = _NumbersOnly(handle).load()
    if np.ndim(found) != 2 or shape[1] != 2:
        raise ValueError(f"its shape is {shape}, and (queries, 2) is meant")
    return found
