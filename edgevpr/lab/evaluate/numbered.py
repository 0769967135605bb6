"""Reads ground truths that number their images, from 0 in counting order of the file names (2.png before 10.png).

* GT.npz: VPR_Tutorial (Schubert et al., 2023); pairs in GThard are right, those in GTsoft only are ignored.
* ground_truth_new.npy: VPR-Bench (Zaffar et al., IJCV 2021); a row for each query, its number and the numbers of the
  right references (-1: there is none). It is a pickle, of which nothing but numbers is read: no foreign code can run.
"""

import operator
import pickle
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.files import open_file
from edgevpr.lab.evaluate.dataset import NOT_SCORED, Dataset, GroundTruth, Judged, joined, names_in

KINDS = {".npz": "GT.npz of VPR_Tutorial", ".npy": "ground_truth_new.npy of VPR-Bench"}  # by the ending of the name
_MOST_BYTES = 4_000_000_000
_DAMAGED = (pickle.UnpicklingError, zipfile.BadZipFile, zlib.error, EOFError, MemoryError, RuntimeError)
_Row = tuple[int, Iterable[int], Iterable[int]]  # numbers: of a query, of its right references, of those ignored


def load_numbered(query_dir: str | Path, ref_dir: str | Path, path: str | Path) -> Dataset:
    """Read a data set of two folders of images and a ground truth of numbers. Raises UsageError as `read_numbered`
    does, and SourceError for a folder without images."""
    return joined(query_dir, ref_dir, read_numbered(path, names_in(query_dir), names_in(ref_dir)), path)


def read_numbered(path: str | Path, queries: Sequence[str], references: Sequence[str]) -> GroundTruth:
    """Read a file of one of the `KINDS` for the images of these names, in the order of their numbers. Raises UsageError
    for a file that is neither, or that numbers other images."""
    truth = dict.fromkeys(queries, NOT_SCORED)
    path = Path(path)
    what = KINDS[path.suffix]
    try:
        rows = _of_matrices(path, (len(references), len(queries))) if path.suffix == ".npz" else _of_pickle(path)
        for query, *both in rows:
            right, ignored = (frozenset(references[number] for number in each) for each in both)
            truth[queries[query]] = Judged(right, ignored)
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror or error}): give a {what}.") from error
    except IndexError as error:
        raise UsageError(
            f"{path} numbers more than {len(queries)} queries and {len(references)} references: bring all of them."
        ) from error
    except (ValueError, TypeError, KeyError, AttributeError, *_DAMAGED) as error:
        raise UsageError(f"{path} is no {what} ({error}): bring the one of the data set.") from error
    return truth


def _of_matrices(path: Path, counts: tuple[int, int]) -> Iterator[_Row]:
    with open_file(path, _MOST_BYTES) as handle, np.lib.npyio.NpzFile(handle) as file:
        hard, soft = (file[name].astype(bool) for name in ("GThard", "GTsoft"))
    if not hard.shape == soft.shape == counts:
        raise ValueError(
            f"GThard is {hard.shape}, GTsoft {soft.shape}, and there are {counts[0]} references and {counts[1]} "
            "queries; --data takes the first folder by name for the references"
        )
    for query in np.flatnonzero(hard.any(axis=0)):
        yield int(query), np.flatnonzero(hard[:, query]), np.flatnonzero(soft[:, query] & ~hard[:, query])


def _of_pickle(path: Path) -> Iterator[_Row]:
    with open_file(path, _MOST_BYTES) as handle:
        np.lib.format.read_magic(handle)
        np.lib.format.read_array_header_1_0(handle)
        pairs = _NumbersOnly(handle).load().content()
    for number, right in zip(pairs[::2], pairs[1::2], strict=True):
        (query,) = _numbers(number)
        yield query, _numbers(right), ()


def _numbers(value: Any) -> list[int]:
    """Return the numbers of an image or of several, without -1."""
    if isinstance(value, _Pickled):
        value = value.content()
    if isinstance(value, (list, tuple)):
        return [number for each in value for number in _numbers(each)]
    number = operator.index(value)
    if number < -1:
        raise ValueError(f"it names image {number}")
    return [number] if number >= 0 else []


class _Pickled:
    """Stand-in for an array, a number or a dtype of NumPy in a pickle. NumPy itself would believe what a pickle says of
    the memory of an array."""

    def __init__(self, *made_of: Any) -> None:
        self.made_of = made_of
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def content(self) -> Any:
        """Return what an array holds, flat, or the number in a list. Raises ValueError and TypeError."""
        if self.state is None:
            dtype, content = self.made_of
        else:
            _, _, dtype, _, content = self.state
        if not isinstance(content, bytes):
            return content
        return np.frombuffer(content, dtype.state[1] + dtype.made_of[0]).tolist()  # "<" + "i8"


class _NumbersOnly(pickle.Unpickler):
    """Unpickler for an array of lists of numbers, as NumPy pickles it. It refuses all else."""

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] == "numpy" and name in ("_reconstruct", "scalar", "ndarray", "dtype"):
            return _Pickled
        raise pickle.UnpicklingError(f"it holds {module}.{name}")
