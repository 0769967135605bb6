"""Reads ground truths that number their images, from 0 in counting order of the file names (2.png before 10.png).

* GT.npz: VPR_Tutorial (Schubert et al., 2023); pairs in GThard are right, those in GTsoft only are ignored.
* ground_truth_new.npy: VPR-Bench (Zaffar et al., IJCV 2021); a row for each query, its number and the numbers of the
  right references.
"""

import pickle
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.files import arrays_of, open_file, read_file
from edgevpr.lab.evaluate.dataset import NOT_SCORED, GroundTruth, Judged

WHAT_IT_IS = {".npz": "GT.npz of VPR_Tutorial", ".npy": "ground truth of VPR-Bench"}
_MOST_BYTES = 4_000_000_000
_Row = tuple[int, Any, Any]  # numbers: of a query, of its right references, of those that are ignored


def read_numbered(path: Path, queries: Sequence[str], references: Sequence[str]) -> GroundTruth:
    """Read a GT.npz, or a .npy of VPR-Bench, for the images of these names, in the order of their numbers. Raises
    UsageError for a file that is neither, or that numbers other images."""
    truth = dict.fromkeys(queries, NOT_SCORED)
    what = WHAT_IT_IS[path.suffix.lower()]
    try:
        rows = _of_matrices(path, (len(references), len(queries))) if what.startswith("GT") else _of_rows(path)
        for query, *both in rows:
            right, ignored = (frozenset(references[number] for number in each) for each in both)
            truth[queries[query]] = Judged(right, ignored)
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror or error}): give a {what}.") from error
    except IndexError as error:
        raise UsageError(
            f"{path} numbers more than {len(queries)} queries and {len(references)} references: bring all of them."
        ) from error
    except (ValueError, TypeError, EOFError, AttributeError, pickle.UnpicklingError) as error:
        raise UsageError(f"{path} is no {what} ({error}): bring the one of the data set.") from error
    return truth


def _of_matrices(path: Path, counts: tuple[int, int]) -> Iterator[_Row]:
    arrays = arrays_of(read_file(path, _MOST_BYTES), _MOST_BYTES)
    if missing := [name for name in ("GThard", "GTsoft") if name not in arrays]:
        raise ValueError(f"it has no `{missing[0]}`")
    hard, soft = (arrays[name].astype(bool) for name in ("GThard", "GTsoft"))
    if not hard.shape == soft.shape == counts:
        raise ValueError(
            f"GThard is {hard.shape}, GTsoft {soft.shape}, and there are {counts[0]} references (the first folder by "
            f"name) and {counts[1]} queries"
        )
    for query in np.flatnonzero(hard.any(axis=0)):
        yield int(query), np.flatnonzero(hard[:, query]), np.flatnonzero(soft[:, query] & ~hard[:, query])


def _of_rows(path: Path) -> Iterator[_Row]:
    with open_file(path, _MOST_BYTES) as handle:
        version = np.lib.format.read_magic(handle)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        if not read(handle)[2].hasobject:
            raise ValueError("it holds no lists")
        rows: np.ndarray = _NumbersOnly(handle).load()
    for number, right in rows:
        (query,) = _numbers(number)
        yield query, _numbers(right), ()


def _numbers(values: Any) -> list[int]:
    found = np.atleast_1d(np.asarray(values, np.float64))
    if found.ndim != 1 or not (np.isfinite(found) & (found >= 0) & (found == np.floor(found))).all():
        raise ValueError(f"it names image {values!r:.40}")
    return [int(number) for number in found]


class _NumbersOnly(pickle.Unpickler):
    """Unpickler for an array of lists of numbers, as NumPy pickles it. It refuses all else: no foreign code can run."""

    def find_class(self, module: str, name: str) -> Any:
        if name in ("_reconstruct", "scalar") and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return getattr(import_module("numpy._core.multiarray"), name)
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"it holds {module}.{name}")
